"""Keys that compiled kernels are found by on disk: hashes of the program, or of the function that it is traced from."""

import functools
import hashlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxgrasp.kernels.program.entries import aval_of

# Parameters that only matter to XLA, and may differ between traces of the same program.
_INCIDENTAL = {
    *("name", "jvp_jaxpr_fun", "jvp_jaxpr_thunk", "fwd_jaxpr_thunk", "bwd", "ctx_mesh", "donated_invars"),
    *("compiler_options_kvs", "in_shardings", "out_shardings", "in_layouts", "out_layouts"),
    *("sharding", "out_sharding"),
}


def hash_origin(
    known_as: str, arguments: list[jax.ShapeDtypeStruct], shared: tuple[bool, ...], description: str
) -> str:
    """Hash what a program is traced from: a function, by its name, and its arguments' shapes and types.

    The hash depends on the version of JAX and on the source of the whole package, any file of which may be traced.

    Args:
        known_as: the function's name, see `kernels.fused`.
        arguments: shape and type of every argument.
        shared: for every argument, whether all lanes share it.
        description: the target's description of its devices.
    """
    package = _hash_sources(Path(__file__).parents[2])
    signature = [(x.shape, x.dtype.name, s) for x, s in zip(arguments, shared, strict=True)]
    parts = (package, description, jax.__version__, jax.config.read("jax_enable_x64"))
    return hashlib.sha256(repr((*parts, known_as, signature)).encode()).hexdigest()


@functools.cache
def _hash_sources(folder: Path) -> str:
    """Hash all source files of a folder: what is traced or compiled changes only with them."""
    files = sorted(folder.rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def hash_program(jaxpr: ClosedJaxpr, shared: tuple[bool, ...], description: str) -> str:
    """Hash a program; the hash is the same in every process with the same devices.

    Args:
        jaxpr: the program.
        shared: for every argument, whether all lanes share it.
        description: the target's description of its devices.
    """
    room = _hash_sources(Path(__file__).parents[1])
    digest = hashlib.sha256(f"{room} {description} {shared}".encode())
    numbers: dict[Any, int] = {}

    def name(v: Any) -> str:
        if isinstance(v, Literal):
            return f"{v.val!r}:{aval_of(v).dtype}"
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
            digest.update(f"{name(v)}={aval_of(v).dtype}{aval_of(v).shape};".encode())
        for eqn in inner.eqns:
            params = {k: v for k, v in eqn.params.items() if k not in _INCIDENTAL}
            parts = [eqn.primitive.name, *map(name, eqn.invars), *[f"{k}={plain(v)}" for k, v in params.items()]]
            outs = [f"{name(v)}={aval_of(v).dtype}{aval_of(v).shape}" for v in eqn.outvars]
            digest.update((" ".join([*parts, *outs]) + "\n").encode())
        digest.update(("->" + ",".join(map(name, inner.outvars))).encode())

    plain(jaxpr)
    return digest.hexdigest()
