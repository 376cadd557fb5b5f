"""Options of XLA for whole programs on CPUs, so that they are ready sooner and run faster."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from jaxgrasp import process

# These are internals of XLA. XLA already vectorises loops over lanes, so LLVM's costlier passes take long and gain
# nothing; the widest registers, which LLVM avoids by default, do gain.
_FAST = {"xla_backend_optimization_level": 1, "xla_cpu_prefer_vector_width": 512}
# The older of XLA's two emitters of loops: programs are ready in a third of the time and keep a tenth of the memory,
# which counts where every shape has its own program. Long computations of XLA are up to half slower so.
_BRIEF = _FAST | {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
# Programs are ready in half of that time again, and run several times slower: for a few lanes.
_SOON = _BRIEF | {"xla_backend_optimization_level": 0}
# With at most this many numbers in its arguments, only the time to compile a program counts.
_FEW_NUMBERS = 1 << 14
_PACES = {"fast": (_FAST,), "brief": (_BRIEF, _FAST), "soon": (_SOON, _FAST)}


@contextlib.contextmanager
def own_settings() -> Iterator[None]:
    """Trace with this library's settings of JAX, whatever the user's settings for code of their own."""
    with jax.numpy_rank_promotion("allow"), jax.disable_jit(False):
        yield


def compiled(
    function: Callable[..., Any], static_argnums: tuple[int, ...] = (), pace: Callable[..., str] = lambda *_: "fast"
) -> Callable[..., Any]:
    """Apply `jax.jit` with the options that suit this library's kernels, where it is the outermost one.

    JAX takes options for whole programs only: inside somebody's transformation theirs apply.

    Args:
        function: the function to compile.
        static_argnums: as `jax.jit` takes them.
        pace: takes the arguments of a call and returns the pace to compile it for, see `options`.
    """
    inner = jax.jit(function, static_argnums=static_argnums)

    @functools.cache
    def outer(pace: str) -> Callable[..., Any]:
        return jax.jit(function, static_argnums=static_argnums, compiler_options=options(pace))

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        process.check()
        with own_settings():
            # Inside somebody's jit every operation gives a tracer, even one on constants.
            traced = any(isinstance(x, Tracer) for x in (jnp.zeros(()), *jax.tree.leaves(args)))
            if traced:
                return inner(*args)
            # NaN and infinity are results here, not errors.
            with jax.debug_nans(False), jax.debug_infs(False):
                return outer(pace(*args))(*args)

    return call


def by_size(*args: Any) -> str:
    """Choose the pace of a program that touches every number once."""
    return "soon" if sum(jnp.size(x) for x in jax.tree.leaves(args)) <= _FEW_NUMBERS else "brief"


@functools.cache
def options(pace: str = "fast") -> dict[str, Any] | None:
    """Find `compiler_options` for `jax.jit`: None on other than CPUs, and where XLA no longer knows them.

    Args:
        pace: "fast" runs fast; "brief" is for programs in which XLA computes little, "soon" for those of a few lanes.
    """
    if jax.default_backend() != "cpu":
        return None
    for known in _PACES[pace]:
        try:
            jax.jit(lambda x: x, compiler_options=known).lower(0.0).compile()
        except jax.errors.JaxRuntimeError:
            continue
        return known
    return None
