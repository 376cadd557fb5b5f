"""Fused kernels: a batch function as one call of native code, where that can be had.

`fused` takes a function of one problem. Its jaxpr is lowered to vector code, one problem per lane, or to a GPU's, one
problem per thread, and called through XLA's foreign function interface; kernels are kept in the process and on disk.
Where anything is missing, XLA runs the same function instead, with one warning that says why.
"""

import contextlib
import functools
import gc
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive
from jax.interpreters import mlir, xla

from jaxgrasp.kernels.code import llvm as machine
from jaxgrasp.kernels.code.llvm import Unavailable
from jaxgrasp.kernels.cpu import module as cpu
from jaxgrasp.kernels.gpu import module as gpu
from jaxgrasp.kernels.program.expressions import Unsupported
from jaxgrasp.kernels.program.lowering import lowered
from jaxgrasp.kernels.store import fingerprint, folder, outline

Tree = Any
SETTING = "JAXGRASP_KERNELS"
# What the setting may be: fused kernels on CPUs, nowhere, or on GPUs as well.
_SETTINGS = ("auto", "xla", "fused")
# What makes kernels, by the platforms' names in JAX.
_MAKERS: dict[str, Any] = {"cpu": cpu, "cuda": gpu}
# A context of JAX's, so that programs are traced anew where it changes.
_allowed = jax.make_user_context(True)
_trusted = True
_lock = threading.RLock()


@contextlib.contextmanager
def without() -> Iterator[None]:
    """What is traced inside runs on XLA alone, so that `jax.export` can take it to another machine.

    Programs that were traced outside are traced anew inside. They are several times slower on CPUs, and where arrays
    are divided over devices XLA divides each operation as it sees fit.

    Example:
        >>> with jaxgrasp.without_kernels():
        ...     exported = jax.export.export(jax.jit(margin))(positions)
    """
    with _allowed(False):
        yield


def allowed() -> bool:
    """Whether what is traced now may be more than XLA, see `without`."""
    return _allowed.value


def distrust() -> None:
    """Have XLA run whatever is traced from now on: an answer of a kernel was found wrong."""
    global _trusted
    _trusted = False


def fused(
    function: Callable[[list[jax.Array]], Tree],
    leaves: list[jax.Array],
    shared: tuple[bool, ...],
    otherwise: Callable[[list[jax.Array]], Tree],
    known_as: str | None = None,
    platform: str = "cpu",
) -> Tree:
    """Run a function over the leading axis of its arguments.

    Args:
        function: of a list of arrays with one trailing axis of size 1; returns a tree of such arrays.
        leaves: (problems, ...), or without the leading axis where shared.
        shared: for every leaf.
        otherwise: the same function of `leaves`, for XLA, where there is no fused kernel.
        known_as: what tells the function from all others that this package's code can make of the same arguments; it is
            then not even traced where its kernel is on disk. None where nothing does.
        platform: that the call is for, "cpu" or "cuda".
    """
    if not usable(platform):
        return otherwise(leaves)
    problems = next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    events = [x.shape if s else x.shape[1:] for x, s in zip(leaves, shared, strict=True)]
    given = [jax.ShapeDtypeStruct((*e, 1), x.dtype) for e, x in zip(events, leaves, strict=True)]
    plan = _planned(function, given, shared, known_as, platform)
    wanted, structure = jax.tree.flatten(plan.out)
    shapes = tuple(ShapedArray((problems, *x.shape[:-1]), x.dtype) for x in wanted)
    flat = lambda *leaves: jax.tree.leaves(otherwise(list(leaves)))
    return jax.tree.unflatten(structure, _fused_p.bind(*leaves, plan=plan, shapes=shapes, otherwise=flat))


@dataclass(frozen=True, eq=False)
class Plan:
    """A program, which may not have been traced yet.

    key: its name among compiled kernels.
    out: arrays like its results, one trailing axis of size 1.
    trace: makes its jaxpr.
    shared: for every argument, whether all problems share it.
    platform: that it is for, "cpu" or "cuda".
    """

    key: str
    out: Tree
    trace: Callable[[], ClosedJaxpr]
    shared: tuple[bool, ...]
    platform: str


_origins: dict[str, tuple[str, Tree]] = {}


def _planned(
    function: Callable[[list[jax.Array]], Tree],
    given: list[jax.ShapeDtypeStruct],
    shared: tuple[bool, ...],
    known_as: str | None,
    platform: str,
) -> Plan:
    described = _MAKERS[platform].description()

    @functools.cache
    def traced() -> tuple[ClosedJaxpr, Tree]:
        return jax.make_jaxpr(function, return_shape=True)(given)

    def look() -> tuple[str, Tree]:
        jaxpr, out = traced()
        return fingerprint.of_program(jaxpr, shared, described), jax.tree.map(lambda x: np.empty(x.shape, x.dtype), out)

    def trace() -> ClosedJaxpr:
        return traced()[0]

    if known_as is None:
        return Plan(*look(), trace, shared, platform)
    origin = fingerprint.of_origin(known_as, given, shared, described)
    if origin not in _origins:
        kept = folder.cached(origin)
        if kept is None:
            _origins[origin] = look()
            _keep(origin, b"\n".join((_origins[origin][0].encode(), outline.written(_origins[origin][1]))))
        else:
            key, _, out = kept.partition(b"\n")
            _origins[origin] = key.decode(), outline.read(out)
    return Plan(*_origins[origin], trace, shared, platform)


# A primitive, so that kernels whose results nobody uses are never compiled.
_fused_p = Primitive("fused")
_fused_p.multiple_results = True
_fused_p.def_impl(functools.partial(xla.apply_primitive, _fused_p))
_fused_p.def_abstract_eval(lambda *_, shapes, **__: list(shapes))


def _lower(ctx: Any, *leaves: Any, plan: Plan, shapes: Any, otherwise: Any) -> Any:
    if ctx.module_context.lowering_parameters.for_export:
        raise ValueError(
            "jax.export: got a program with jaxgrasp's fused kernels, which are this machine's alone; "
            "export it inside `with jaxgrasp.without_kernels():`"
        )
    try:
        name = target(plan)
    except Unsupported:
        return mlir.lower_fun(otherwise, multiple_results=True)(ctx, *leaves)
    return jax.ffi.ffi_lowering(name)(ctx, *leaves)


mlir.register_lowering(_fused_p, _lower)


def usable(platform: str = "cpu") -> bool:
    """Whether what is traced now becomes fused kernels; says why not, once.

    Args:
        platform: "cpu", or "cuda", where they are used if asked for.

    Raises:
        ValueError: the setting is not known.
    """
    asked = os.environ.get(SETTING, "auto")
    if asked not in _SETTINGS:
        raise ValueError(f"{SETTING}: got {asked!r}, wanted {', '.join(_SETTINGS[:-1])} or {_SETTINGS[-1]}")
    if not _trusted or not _allowed.value or asked == "xla" or (platform == "cuda" and asked != "fused"):
        return False
    return jax.default_backend() == {"cpu": "cpu", "cuda": "gpu"}[platform] and _works(platform)


@functools.cache
def _works(platform: str) -> bool:
    """Try the smallest kernel: where XLA's structures differ from what kernels expect, its result stays untouched."""
    try:
        machine.machine()
        # A thread of its own knows of no mesh, trace or setting of whoever comes first.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(_try, platform).result()
    except Unavailable as error:
        _tell(str(error))
    except Unsupported:
        pass  # It does not compile, which was told.
    except (RuntimeError, OSError) as error:
        _tell(f"the smallest one fails: {error}")
    else:
        return True
    return False


def _try(platform: str) -> None:
    start = np.arange(3, dtype=np.float32)
    one = [jax.ShapeDtypeStruct((1,), np.float32)]
    with _lock:
        name = target(_planned(lambda x: x[0] + 1, one, (False,), None, platform))
    given = jax.device_put(start, jax.local_devices(backend=_MAKERS[platform].PLATFORM.lower())[0])
    out = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), np.float32))(given)
    if not np.array_equal(np.asarray(out), start + 1):
        raise Unavailable("this version of XLA hands arrays over in another way")


@functools.cache
def _tell(why: str) -> None:
    warnings.warn(
        f"jaxgrasp's fused kernels are not used, XLA's are: {why} "
        f"({SETTING}=xla in the environment asks for XLA's, and is quiet)",
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
    maker, name = _MAKERS[plan.platform], f"jaxgrasp_{plan.key[:32]}"
    code = folder.cached(plan.key)
    try:
        if code is None:
            code = _compiled(plan, name)
            _keep(plan.key, code)
        address = maker.handler(code, name)
    except RuntimeError as error:
        _tell(f"a kernel does not compile: {error}")
        raise Unsupported from None
    jax.ffi.register_ffi_target(name, machine.capsule(address), platform=maker.PLATFORM)
    return name


def _compiled(plan: Plan, name: str) -> bytes:
    # A hundred thousand small objects, and no garbage among them.
    collecting = gc.isenabled()
    gc.disable()
    try:
        return _MAKERS[plan.platform].compiled(lowered(plan.trace(), list(plan.shared)), name)
    finally:
        if collecting:
            gc.enable()


def _keep(key: str, content: bytes) -> None:
    try:
        folder.keep(key, content)
    except OSError as error:
        _tell_of_disk(str(error))


@functools.cache
def _tell_of_disk(why: str) -> None:
    warnings.warn(
        f"jaxgrasp's kernels cannot be kept on disk, so every process compiles its own: {why}",
        RuntimeWarning,
        stacklevel=2,
    )
