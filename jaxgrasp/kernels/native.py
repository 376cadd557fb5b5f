"""Fused kernels: a batch function as one call of native code, where that can be had.

`fused` takes a function of one problem. Its jaxpr is lowered to vector code, one problem per lane, and called through
XLA's foreign function interface; kernels are kept in the process and on disk. Where anything is missing, XLA runs the
same function instead, with one warning that says why.
"""

import contextlib
import contextvars
import functools
import gc
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import mlir

from jaxgrasp.fence import loops
from jaxgrasp.kernels import cpu, fingerprint, machine, outline
from jaxgrasp.kernels.expressions import Unsupported
from jaxgrasp.kernels.lowering import lowered
from jaxgrasp.kernels.machine import Unavailable

Tree = Any
SETTING = "JAXGRASP_KERNELS"
_allowed = contextvars.ContextVar("allowed", default=True)
_lock = threading.RLock()


@contextlib.contextmanager
def without() -> Iterator[None]:
    """What is traced inside runs on XLA alone."""
    token = _allowed.set(False)
    try:
        yield
    finally:
        _allowed.reset(token)


def fused(
    function: Callable[[list[jax.Array]], Tree],
    leaves: list[jax.Array],
    shared: tuple[bool, ...],
    otherwise: Callable[[list[jax.Array]], Tree],
    known_as: str | None = None,
) -> Tree:
    """Run a function over the leading axis of its arguments.

    Args:
        function: of a list of arrays with one trailing axis of size 1; returns a tree of such arrays.
        leaves: (problems, ...), or without the leading axis where shared.
        shared: for every leaf.
        otherwise: the same function of `leaves`, for XLA, where there is no fused kernel.
        known_as: what tells the function from all others that this package's code can make of the same arguments; it is
            then not even traced where its kernel is on disk. None where nothing does.
    """
    if not _allowed.get() or not usable():
        return otherwise(leaves)
    problems = next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    events = [x.shape if s else x.shape[1:] for x, s in zip(leaves, shared, strict=True)]
    given = [jax.ShapeDtypeStruct((*e, 1), x.dtype) for e, x in zip(events, leaves, strict=True)]
    plan = _planned(function, given, shared, known_as)
    wanted, structure = jax.tree.flatten(plan.out)
    shapes = tuple(jax.core.ShapedArray((problems, *x.shape[:-1]), x.dtype) for x in wanted)
    flat = lambda *leaves: jax.tree.leaves(otherwise(list(leaves)))  # noqa: E731
    return jax.tree.unflatten(structure, _fused_p.bind(*leaves, plan=plan, shapes=shapes, otherwise=flat))


@dataclass(frozen=True, eq=False)
class Plan:
    """A program, which may not have been traced yet.

    key: its name among compiled kernels.
    out: arrays like its results, one trailing axis of size 1.
    trace: makes its jaxpr.
    shared: for every argument, whether all problems share it.
    """

    key: str
    out: Tree
    trace: Callable[[], ClosedJaxpr]
    shared: tuple[bool, ...]


_origins: dict[str, tuple[str, Tree]] = {}


def _planned(
    function: Callable[[list[jax.Array]], Tree],
    given: list[jax.ShapeDtypeStruct],
    shared: tuple[bool, ...],
    known_as: str | None,
) -> Plan:
    @functools.cache
    def traced() -> tuple[ClosedJaxpr, Tree]:
        with loops():
            return jax.make_jaxpr(function, return_shape=True)(given)

    def look() -> tuple[str, Tree]:
        jaxpr, out = traced()
        return fingerprint.of_program(jaxpr, shared), jax.tree.map(lambda x: np.empty(x.shape, x.dtype), out)

    def trace() -> ClosedJaxpr:
        return traced()[0]

    if known_as is None:
        return Plan(*look(), trace, shared)
    origin = fingerprint.of_origin(known_as, given, shared)
    if origin not in _origins:
        kept = machine.cached(origin)
        if kept is None:
            _origins[origin] = look()
            _keep(origin, b"\n".join((_origins[origin][0].encode(), outline.written(_origins[origin][1]))))
        else:
            key, _, out = kept.partition(b"\n")
            _origins[origin] = key.decode(), outline.read(out)
    return Plan(*_origins[origin], trace, shared)


# A primitive, so that kernels whose results nobody uses are never compiled.
_fused_p = Primitive("fused")
_fused_p.multiple_results = True
_fused_p.def_impl(lambda *leaves, **params: jax.jit(functools.partial(_fused_p.bind, **params))(*leaves))
_fused_p.def_abstract_eval(lambda *_, shapes, **__: list(shapes))


def _lower(ctx: Any, *leaves: Any, plan: Plan, shapes: Any, otherwise: Any) -> Any:
    try:
        name = target(plan)
    except Unsupported:
        return mlir.lower_fun(otherwise, multiple_results=True)(ctx, *leaves)
    return jax.ffi.ffi_lowering(name)(ctx, *leaves)


mlir.register_lowering(_fused_p, _lower)


def usable() -> bool:
    """Whether there are fused kernels here; says why not, once."""
    if jax.default_backend() != "cpu":
        return False
    asked = os.environ.get(SETTING, "auto")
    if asked not in ("auto", "xla"):
        raise ValueError(f"{SETTING}: got {asked!r}, wanted auto or xla")
    return asked == "auto" and _works()


@functools.cache
def _works() -> bool:
    """Try the smallest kernel: where XLA's structures differ from what kernels expect, its result stays untouched."""
    try:
        machine.machine()
        start = np.arange(3, dtype=np.float32)
        with _lock:
            name = target(_planned(lambda x: x[0] + 1, [jax.ShapeDtypeStruct((1,), np.float32)], (False,), None))
        with jax.ensure_compile_time_eval():
            out = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), np.float32))(jnp.asarray(start))
        if not np.array_equal(np.asarray(out), start + 1):
            raise Unavailable("this version of XLA hands arrays over in another way")
    except Unavailable as error:
        _tell(str(error))
    except Unsupported:
        pass  # It does not compile, which was told.
    except (RuntimeError, OSError) as error:
        _tell(f"the smallest one fails: {error}")
    else:
        return True
    return False


@functools.cache
def _tell(why: str) -> None:
    warnings.warn(
        f"jaxgrasp's fused kernels are not used, XLA's slower ones are: {why} "
        f"({SETTING}=xla in the environment asks for these, and is quiet)",
        RuntimeWarning,
        stacklevel=2,
    )


_known: dict[str, str | None] = {}


def target(plan: Plan) -> str:
    """The name under which XLA knows a kernel; compiled, or read from disk, where it is new.

    Raises:
        Unsupported: there is none.
    """
    with _lock:
        if plan.key not in _known:
            try:
                _known[plan.key] = _registered(plan)
            except Unsupported:
                _known[plan.key] = None
        name = _known[plan.key]
    if name is None:
        raise Unsupported
    return name


def _registered(plan: Plan) -> str:
    at, name = machine.machine(), f"jaxgrasp_{plan.key[:32]}"
    objects = machine.cached(plan.key)
    if objects is None:
        # A hundred thousand small objects, and no garbage among them.
        collecting = gc.isenabled()
        gc.disable()
        try:
            program = lowered(plan.trace(), list(plan.shared))
            width = at.vector_bytes // program.builder.dtype.itemsize
            objects = machine.compiled(cpu.module(program, name, width, estimates=at.estimates))
        except RuntimeError as error:
            _tell(f"a kernel does not compile: {error}")
            raise Unsupported from None
        finally:
            if collecting:
                gc.enable()
        _keep(plan.key, objects)
    jax.ffi.register_ffi_target(name, machine.capsule(machine.loaded(objects, name)), platform="cpu")
    return name


def _keep(key: str, content: bytes) -> None:
    try:
        machine.keep(key, content)
    except OSError as error:
        _tell_of_disk(str(error))


@functools.cache
def _tell_of_disk(why: str) -> None:
    warnings.warn(
        f"jaxgrasp's kernels cannot be kept on disk, so every process compiles its own: {why}",
        RuntimeWarning,
        stacklevel=2,
    )
