"""Names of programs, by which compiled kernels are found again: of what they are, or of what they come from."""

import functools
import hashlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxgrasp.kernels.program.entries import aval_of


def of_origin(known_as: str, given: list[jax.ShapeDtypeStruct], shared: tuple[bool, ...], described: str) -> str:
    """The same for functions that are known by the same name and get the same arguments.

    It holds for one version of JAX and one state of the whole package, any file of which may be what is traced, and
    for the devices that are described.
    """
    package = _source(Path(__file__).parents[2])
    arguments = [(x.shape, x.dtype.name, s) for x, s in zip(given, shared, strict=True)]
    parts = (package, described, jax.__version__, jax.config.read("jax_enable_x64"))
    return hashlib.sha256(repr((*parts, known_as, arguments)).encode()).hexdigest()


@functools.cache
def _source(folder: Path) -> str:
    """Changes whenever a file does, and with it what is traced or compiled."""
    files = sorted(folder.rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def of_program(jaxpr: ClosedJaxpr, shared: tuple[bool, ...], described: str) -> str:
    """The same for programs that are the same, in any process with devices that are described so."""
    room = _source(Path(__file__).parents[1])
    digest = hashlib.sha256(f"{room} {described} {shared}".encode())
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
            # What only matters to XLA, and may differ between traces of the same program.
            params = {k: v for k, v in eqn.params.items() if k not in _INCIDENTAL}
            said = [eqn.primitive.name, *map(name, eqn.invars), *[f"{k}={plain(v)}" for k, v in params.items()]]
            outs = [f"{name(v)}={aval_of(v).dtype}{aval_of(v).shape}" for v in eqn.outvars]
            digest.update((" ".join([*said, *outs]) + "\n").encode())
        digest.update(("->" + ",".join(map(name, inner.outvars))).encode())

    plain(jaxpr)
    return digest.hexdigest()


_INCIDENTAL = {
    *("name", "jvp_jaxpr_fun", "jvp_jaxpr_thunk", "fwd_jaxpr_thunk", "bwd", "ctx_mesh", "donated_invars"),
    *("compiler_options_kvs", "in_shardings", "out_shardings", "in_layouts", "out_layouts"),
    *("sharding", "out_sharding"),
}
