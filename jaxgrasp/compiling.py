"""Compiling for CPUs: what XLA is told about whole programs, so that they are ready sooner and run faster."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

# Loops over lanes are vectors already as XLA writes them: LLVM's costlier passes take long and gain nothing, while the
# widest registers, which LLVM is shy of, do. Both options are internals of XLA.
_OPTIONS = {"xla_backend_optimization_level": 1, "xla_cpu_prefer_vector_width": 512}


def compiled(function: Callable[..., Any], static_argnums: tuple[int, ...] = ()) -> Callable[..., Any]:
    """`jax.jit` with the options that suit this library's kernels, where it is the outermost one.

    JAX takes options for whole programs only: inside somebody's `jax.jit` or `jax.grad` theirs apply.
    """
    inner = jax.jit(function, static_argnums=static_argnums)

    @functools.cache
    def outer() -> Callable[..., Any]:
        return jax.jit(function, static_argnums=static_argnums, compiler_options=options())

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        # Inside somebody's jit every operation gives a tracer, even one on constants.
        if isinstance(jnp.zeros(()), jax.core.Tracer):
            return inner(*args)
        try:
            return outer()(*args)
        except ValueError as error:
            # So JAX refuses to differentiate a program with options.
            if "compiler_options" not in str(error):
                raise
            return inner(*args)

    return call


@functools.cache
def options() -> dict[str, Any] | None:
    """`compiler_options` for `jax.jit`; None on other than CPUs, and where XLA no longer knows them."""
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda x: x, compiler_options=_OPTIONS).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return _OPTIONS
