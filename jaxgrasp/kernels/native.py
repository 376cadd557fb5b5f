"""Fused kernels: a batch function as one call of native code, where that can be had.

`fused` takes a function of one problem. Its jaxpr is lowered to vector code, one problem per lane, and called through
XLA's foreign function interface; kernels are kept in the process and on disk. Where anything is missing, XLA runs the
same function instead, with one warning that says why.
"""

import contextlib
import contextvars
import functools
import gc
import hashlib
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive
from jax.interpreters import mlir

from jaxgrasp.fence import loops
from jaxgrasp.kernels import cpu, machine
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
) -> Tree:
    """Run a function over the leading axis of its arguments.

    Args:
        function: of a list of arrays with one trailing axis of size 1; returns a tree of such arrays.
        leaves: (problems, ...), or without the leading axis where shared.
        shared: for every leaf.
        otherwise: the same function of `leaves`, for XLA, where there is no fused kernel.
    """
    if not _allowed.get() or not usable():
        return otherwise(leaves)
    problems = next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    events = [x.shape if s else x.shape[1:] for x, s in zip(leaves, shared, strict=True)]
    given = [jax.ShapeDtypeStruct((*e, 1), x.dtype) for e, x in zip(events, leaves, strict=True)]
    with loops():
        jaxpr, out = jax.make_jaxpr(function, return_shape=True)(given)
    wanted, structure = jax.tree.flatten(out)
    shapes = tuple(jax.core.ShapedArray((problems, *x.shape[:-1]), x.dtype) for x in wanted)
    flat = lambda *leaves: jax.tree.leaves(otherwise(list(leaves)))  # noqa: E731
    return jax.tree.unflatten(
        structure, _fused_p.bind(*leaves, jaxpr=jaxpr, shared=shared, shapes=shapes, otherwise=flat)
    )


# A primitive, so that kernels whose results nobody uses are never compiled.
_fused_p = Primitive("fused")
_fused_p.multiple_results = True
_fused_p.def_impl(lambda *leaves, **params: jax.jit(functools.partial(_fused_p.bind, **params))(*leaves))
_fused_p.def_abstract_eval(lambda *_, shapes, **__: list(shapes))


def _lower(ctx: Any, *leaves: Any, jaxpr: ClosedJaxpr, shared: Any, shapes: Any, otherwise: Any) -> Any:
    try:
        name = target(jaxpr, shared)
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
            jaxpr = jax.make_jaxpr(lambda x: x + 1)(jax.ShapeDtypeStruct((1,), np.float32))
            name = target(jaxpr, (False,))
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


def target(jaxpr: ClosedJaxpr, shared: tuple[bool, ...]) -> str:
    """The name under which XLA knows a kernel; compiled, or read from disk, where it is new.

    Raises:
        Unsupported: there is none.
    """
    key = _fingerprint(jaxpr, shared)
    with _lock:
        if key not in _known:
            try:
                _known[key] = _registered(key, jaxpr, shared)
            except Unsupported:
                _known[key] = None
        name = _known[key]
    if name is None:
        raise Unsupported
    return name


def _registered(key: str, jaxpr: ClosedJaxpr, shared: tuple[bool, ...]) -> str:
    at, name = machine.machine(), f"jaxgrasp_{key[:32]}"
    objects = machine.cached(key)
    if objects is None:
        # A hundred thousand small objects, and no garbage among them.
        collecting = gc.isenabled()
        gc.disable()
        try:
            program = lowered(jaxpr, list(shared))
            width = at.vector_bytes // program.builder.dtype.itemsize
            objects = machine.compiled(cpu.module(program, name, width, estimates=at.estimates))
        except RuntimeError as error:
            _tell(f"a kernel does not compile: {error}")
            raise Unsupported from None
        finally:
            if collecting:
                gc.enable()
        try:
            machine.keep(key, objects)
        except OSError as error:
            _tell_of_disk(str(error))
    jax.ffi.register_ffi_target(name, machine.capsule(machine.loaded(objects, name)), platform="cpu")
    return name


@functools.cache
def _tell_of_disk(why: str) -> None:
    warnings.warn(
        f"jaxgrasp's kernels cannot be kept on disk, so every process compiles its own: {why}",
        RuntimeWarning,
        stacklevel=2,
    )


@functools.cache
def _source() -> str:
    """Changes whenever this room does, and with it what is compiled."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _fingerprint(jaxpr: ClosedJaxpr, shared: tuple[bool, ...]) -> str:
    """The same for programs that are the same, in any process on any machine of this kind."""
    digest = hashlib.sha256(f"{_source()} {machine.machine().description} {shared}".encode())
    numbers: dict[Any, int] = {}

    def name(v: Any) -> str:
        if isinstance(v, Literal):
            return f"{v.val!r}:{v.aval.dtype}"
        return str(numbers.setdefault(v, len(numbers)))

    def plain(value: Any) -> str:
        if isinstance(value, ClosedJaxpr):
            for const in value.consts:
                constant(const)
            walk(value.jaxpr)
            return "closed"
        if isinstance(value, Jaxpr):
            walk(value)
            return "open"
        if isinstance(value, tuple | list):
            return ",".join(map(plain, value))
        return getattr(value, "__name__", None) or "" if callable(value) else repr(value)

    def constant(const: Any) -> None:
        array = np.asarray(const)
        digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())

    def walk(inner: Jaxpr) -> None:
        for v in (*inner.constvars, *inner.invars):
            digest.update(f"{name(v)}={v.aval.dtype}{v.aval.shape};".encode())
        for eqn in inner.eqns:
            # What only matters to XLA, and may differ between traces of the same program.
            params = {k: v for k, v in eqn.params.items() if k not in _INCIDENTAL}
            said = [eqn.primitive.name, *map(name, eqn.invars), *[f"{k}={plain(v)}" for k, v in params.items()]]
            outs = [f"{name(v)}={v.aval.dtype}{v.aval.shape}" for v in eqn.outvars]
            digest.update((" ".join([*said, *outs]) + "\n").encode())
        digest.update(("->" + ",".join(map(name, inner.outvars))).encode())

    plain(jaxpr)
    return digest.hexdigest()


_INCIDENTAL = {"name", "jvp_jaxpr_fun", "jvp_jaxpr_thunk", "fwd_jaxpr_thunk", "bwd", "ctx_mesh", "donated_invars"}
_INCIDENTAL |= {
    "compiler_options_kvs",
    "in_shardings",
    "out_shardings",
    "in_layouts",
    "out_layouts",
    "sharding",
    "out_sharding",
}
