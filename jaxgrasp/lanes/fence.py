"""Fences keep XLA's CPU backend from computing the same thing many times.

XLA's CPU fusion copies a cheap producer into every consumer. In a long chain of small dense algebra that multiplies
the work (and the compile time) tenfold, and `lax.optimization_barrier` is gone before fusion runs. A call that is
marked as not inlineable is kept as a function of its own, so its results are computed once.
"""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata

from jaxgrasp.kernels.program.unrolling import STAYS

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")
U = TypeVar("U")

_fences = contextvars.ContextVar("fences", default=False)
_loops = contextvars.ContextVar("loops", default=False)


@contextlib.contextmanager
def fences(on: bool) -> Iterator[None]:
    """Choose whether `fenced` functions traced inside become functions of their own; that is worth it on CPUs alone."""
    token = _fences.set(on)
    try:
        yield
    finally:
        _fences.reset(token)


@contextlib.contextmanager
def loops() -> Iterator[None]:
    """Trace without fences and keep loops as loops, for compilers that choose themselves which to unroll."""
    tokens = _fences.set(False), _loops.set(True)
    try:
        yield
    finally:
        _fences.reset(tokens[0])
        _loops.reset(tokens[1])


def in_loops() -> bool:
    """Tell whether what is traced keeps its loops, see `loops`."""
    return _loops.get()


def fenced(function: Callable[P, T]) -> Callable[P, T]:
    """Compute the results of `function` exactly once, where fences are on. Arguments must be trees of arrays."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        if not _fences.get():
            return function(*args, **kwargs)
        # With a single result that XLA divides over threads, a function inside another one passes for a divided call,
        # which has no symbol to call there. A second result makes it a tuple.
        paired = jax.jit(lambda *args, **kwargs: (function(*args, **kwargs), jnp.zeros((), bool)))
        with set_xla_metadata(inlineable="false"):
            return paired(*args, **kwargs)[0]

    return wrapped


def repeat(count: int, step: Callable[[jax.Array, T], T], state: T) -> T:
    """Apply `step(i, state)` for i = 0 .. count - 1.

    This is a loop where fences are on, since code size is compile time there; else it is unrolled, for fusion.
    """
    if count == 1:
        return step(jnp.asarray(0), state)
    return jax.lax.fori_loop(0, count, step, state, unroll=None if _fences.get() or _loops.get() else True)


def in_turn(step: Callable[[S, T], tuple[S, U]], state: S, parts: T) -> tuple[S, U]:
    """Go through parts as `lax.scan`, in a loop that kernels do not write out, though it is short.

    For what is done many times over, where code that is written out would compile for too long. For XLA the parts are
    worked on at once where there is no state, None.
    """
    if state is None and not in_loops():
        return state, jax.vmap(lambda part: step(state, part)[1])(parts)

    def in_turn(state: S, part: T) -> tuple[S, U]:
        return step(state, part)

    assert in_turn.__name__ == STAYS
    return jax.lax.scan(jax.jit(in_turn), state, parts)


def each(function: Callable[[T], U], parts: T) -> U:
    """Apply a function to every entry along the leading axis and stack the results.

    The entries are worked on one after the other where fences are on, else all at once.
    """
    return jax.lax.map(function, parts) if _fences.get() else jax.vmap(function)(parts)
