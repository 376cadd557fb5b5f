"""Run a function over a batch as one call of native code, where there can be a kernel for it.

`fused` takes a function of one lane of the batch. Its jaxpr is compiled to vector code, one lane of the batch per SIMD
lane, or to a GPU's code, one lane per thread, and called through XLA's foreign function interface. Kernels are kept in
the process and on disk. Where something is missing, XLA runs the same function instead, with one warning that says why.
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

from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.code.llvm import Unavailable
from jaxgrasp.kernels.code.target import Target
from jaxgrasp.kernels.cpu import module as cpu
from jaxgrasp.kernels.gpu import module as gpu
from jaxgrasp.kernels.program.expressions import Unsupported
from jaxgrasp.kernels.program.lowering import lower
from jaxgrasp.kernels.store import fingerprint, folder, treedef

Tree = Any
SETTING = "JAXGRASP_KERNELS"
# What the setting may be: "auto" (as when it is unset), kernels on CPUs; "xla", no kernels; "fused", kernels on CPUs
# and on NVIDIA's GPUs.
_SETTINGS = ("auto", "xla", "fused")
# By the platforms' names in JAX.
_TARGETS: dict[str, Target] = {"cpu": cpu, "cuda": gpu}
# A context of JAX's, so that programs are traced anew where it changes.
_allowed = jax.make_user_context(True)
_trusted = True
_lock = threading.RLock()


@contextlib.contextmanager
def without() -> Iterator[None]:
    """Run what is traced inside on XLA alone, so that `jax.export` can take it to another machine.

    Programs that were traced outside are traced anew inside. They are several times slower on CPUs, and where arrays
    are divided over devices XLA divides each operation as it sees fit.

    Example:
        >>> with jaxgrasp.without_kernels():
        ...     exported = jax.export.export(jax.jit(margin))(positions)
    """
    with _allowed(False):
        yield


def allowed() -> bool:
    """Tell whether what is traced now may call kernels; it may not inside `without`."""
    return _allowed.value


def distrust() -> None:
    """Have XLA run whatever is traced from now on, because an answer of a kernel was found wrong."""
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
        leaves: (lanes, ...), or without the leading axis where shared.
        shared: for every leaf, whether all lanes share it.
        otherwise: the same function of `leaves`, for XLA, where there is no kernel.
        known_as: a key that identifies the function for these arguments; with it a kernel on disk is loaded without
            tracing. None: always trace.
        platform: "cpu" or "cuda", the devices that the call is for.
    """
    if not usable(platform):
        return otherwise(leaves)
    lanes = next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    events = [x.shape if s else x.shape[1:] for x, s in zip(leaves, shared, strict=True)]
    arguments = [jax.ShapeDtypeStruct((*e, 1), x.dtype) for e, x in zip(events, leaves, strict=True)]
    plan = _make_plan(function, arguments, shared, known_as, platform)
    out, structure = jax.tree.flatten(plan.out)
    shapes = tuple(ShapedArray((lanes, *x.shape[:-1]), x.dtype) for x in out)
    flat = lambda *leaves: jax.tree.leaves(otherwise(list(leaves)))
    return jax.tree.unflatten(structure, _fused_p.bind(*leaves, plan=plan, shapes=shapes, otherwise=flat))


@dataclass(frozen=True, eq=False)
class Plan:
    """A program that a kernel is wanted for; it may not have been traced yet.

    key: the name of the compiled kernel on disk.
    out: arrays like the results of one lane, with one trailing axis of size 1.
    trace: returns the program's jaxpr.
    shared: for every argument, whether all lanes share it.
    platform: "cpu" or "cuda".
    """

    key: str
    out: Tree
    trace: Callable[[], ClosedJaxpr]
    shared: tuple[bool, ...]
    platform: str


# Key and results of programs by their origins, see `fingerprint.hash_origin`.
_origins: dict[str, tuple[str, Tree]] = {}


def _make_plan(
    function: Callable[[list[jax.Array]], Tree],
    arguments: list[jax.ShapeDtypeStruct],
    shared: tuple[bool, ...],
    known_as: str | None,
    platform: str,
) -> Plan:
    description = _TARGETS[platform].description()

    @functools.cache
    def trace_with_results() -> tuple[ClosedJaxpr, Tree]:
        return jax.make_jaxpr(function, return_shape=True)(arguments)

    def identify() -> tuple[str, Tree]:
        jaxpr, out = trace_with_results()
        empty = jax.tree.map(lambda x: np.empty(x.shape, x.dtype), out)
        return fingerprint.hash_program(jaxpr, shared, description), empty

    def trace() -> ClosedJaxpr:
        return trace_with_results()[0]

    if known_as is None:
        return Plan(*identify(), trace, shared, platform)
    origin = fingerprint.hash_origin(known_as, arguments, shared, description)
    if origin not in _origins:
        kept = folder.read(origin)
        if kept is None:
            _origins[origin] = identify()
            _keep(origin, b"\n".join((_origins[origin][0].encode(), treedef.write(_origins[origin][1]))))
        else:
            key, _, out = kept.partition(b"\n")
            _origins[origin] = key.decode(), treedef.read(out)
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
        name = register(plan)
    except Unsupported:
        return mlir.lower_fun(otherwise, multiple_results=True)(ctx, *leaves)
    return jax.ffi.ffi_lowering(name)(ctx, *leaves)


mlir.register_lowering(_fused_p, _lower)


def usable(platform: str = "cpu") -> bool:
    """Tell whether what is traced now becomes fused kernels; where it does not for want of something, warn once.

    The environment's JAXGRASP_KERNELS decides first: "auto", as when it is unset, asks for kernels on CPUs; "xla" for
    none, without a warning; "fused" for kernels on CPUs and on NVIDIA's GPUs.

    Args:
        platform: "cpu" or "cuda".

    Raises:
        ValueError: JAXGRASP_KERNELS has another value.
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
        llvm.processor()
        # A thread of its own knows of no mesh, trace or setting of whoever comes first.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(_try, platform).result()
    except Unavailable as error:
        _warn(str(error))
    except Unsupported:
        pass  # It does not compile, and the warning has said so.
    except (RuntimeError, OSError) as error:
        _warn(f"the smallest one fails: {error}")
    else:
        return True
    return False


def _try(platform: str) -> None:
    start = np.arange(3, dtype=np.float32)
    one = [jax.ShapeDtypeStruct((1,), np.float32)]
    with _lock:
        name = register(_make_plan(lambda x: x[0] + 1, one, (False,), None, platform))
    argument = jax.device_put(start, jax.local_devices(backend=_TARGETS[platform].PLATFORM.lower())[0])
    out = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((3,), np.float32))(argument)
    if not np.array_equal(np.asarray(out), start + 1):
        raise Unavailable("this version of XLA hands arrays over in another way")


@functools.cache
def _warn(why: str) -> None:
    warnings.warn(
        f"jaxgrasp's fused kernels are not used, XLA's are: {why} "
        f"({SETTING}=xla in the environment asks for XLA's, and is quiet)",
        RuntimeWarning,
        stacklevel=2,
    )


# What is kept on disk for a program that there is no kernel for: to find that out takes seconds.
_NONE = b""
# Names of the kernels of this process by the keys of their plans; None where there is no kernel.
_registered: dict[str, str | None] = {}


def register(plan: Plan) -> str:
    """Make a kernel known to XLA, once; it is compiled, or read from disk. Returns the name that XLA knows it by.

    Raises:
        Unsupported: there is no kernel for the program.
    """
    with _lock:
        if plan.key not in _registered:
            try:
                _registered[plan.key] = _load(plan)
            except Unsupported:
                _registered[plan.key] = None
        name = _registered[plan.key]
    if name is None:
        raise Unsupported
    return name


def _load(plan: Plan) -> str:
    target, name = _TARGETS[plan.platform], f"jaxgrasp_{plan.key[:32]}"
    code = folder.read(plan.key)
    if code == _NONE:
        raise Unsupported("known from an earlier process")
    try:
        if code is None:
            try:
                code = _compile(plan, name)
            except Unsupported:
                _keep(plan.key, _NONE)
                raise
            _keep(plan.key, code)
        address = target.load_handler(code, name)
    except RuntimeError as error:
        _warn(f"a kernel does not compile: {error}")
        raise Unsupported from None
    jax.ffi.register_ffi_target(name, llvm.capsule(address), platform=target.PLATFORM)
    return name


def _compile(plan: Plan, name: str) -> bytes:
    # A hundred thousand small objects, and no garbage among them.
    collecting = gc.isenabled()
    gc.disable()
    try:
        return _TARGETS[plan.platform].compile_program(lower(plan.trace(), list(plan.shared)), name)
    finally:
        if collecting:
            gc.enable()


def _keep(key: str, content: bytes) -> None:
    try:
        folder.keep(key, content)
    except OSError as error:
        _warn_of_disk(str(error))


@functools.cache
def _warn_of_disk(why: str) -> None:
    warnings.warn(
        f"jaxgrasp's kernels cannot be kept on disk, so every process compiles its own: {why}",
        RuntimeWarning,
        stacklevel=2,
    )
