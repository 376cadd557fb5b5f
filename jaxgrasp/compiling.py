"""Compiling for CPUs: what XLA is told about whole programs, so that they are ready sooner and run faster."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from jaxgrasp import process

# Loops over lanes are vectors already as XLA writes them: LLVM's costlier passes take long and gain nothing, while the
# widest registers, which LLVM is shy of, do. Both options are internals of XLA.
_OPTIONS = {"xla_backend_optimization_level": 1, "xla_cpu_prefer_vector_width": 512}
# A third of the time to compile, six times as long to run: for what has little to run.
_SOON = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


@contextlib.contextmanager
def own_settings() -> Iterator[None]:
    """What is traced inside is this library's own, whatever a user of JAX asks of code of his."""
    with jax.numpy_rank_promotion("allow"), jax.disable_jit(False):
        yield


def compiled(
    function: Callable[..., Any], static_argnums: tuple[int, ...] = (), soon: bool = False
) -> Callable[..., Any]:
    """`jax.jit` with the options that suit this library's kernels, where it is the outermost one.

    JAX takes options for whole programs only: inside somebody's transformation theirs apply.

    Args:
        function: what to compile.
        static_argnums: as for `jax.jit`.
        soon: compile fast rather than well.
    """
    inner = jax.jit(function, static_argnums=static_argnums)

    @functools.cache
    def outer() -> Callable[..., Any]:
        return jax.jit(function, static_argnums=static_argnums, compiler_options=options(soon))

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        process.check()
        with own_settings():
            # Inside somebody's jit every operation gives a tracer, even one on constants.
            traced = any(isinstance(x, jax.core.Tracer) for x in (jnp.zeros(()), *jax.tree.leaves(args)))
            if traced:
                return inner(*args)
            # NaN and infinity are answers here.
            with jax.debug_nans(False), jax.debug_infs(False):
                return outer()(*args)

    return call


@functools.cache
def options(soon: bool = False) -> dict[str, Any] | None:
    """`compiler_options` for `jax.jit`; None on other than CPUs, and where XLA no longer knows them."""
    wanted = _SOON if soon else _OPTIONS
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda x: x, compiler_options=wanted).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return wanted
