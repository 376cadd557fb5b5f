"""Arrays whose entries are scalars of a kernel: `Value`s or NumPy's constants."""

from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray

from jaxgrasp.kernels.program.expressions import Value, kind_of


def array(entries: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """An array of these entries."""
    out = np.empty(len(entries), object)
    out[:] = entries
    return out.reshape(shape)


def objects(x: np.ndarray) -> np.ndarray:
    """As an array of scalars; constants are NumPy's."""
    return x if x.dtype == object else array(list(x.ravel()), x.shape)


def known(x: np.ndarray, dtype: Any) -> np.ndarray:
    """A typed array where all entries are constants."""
    if x.dtype != object or any(type(v) is Value for v in x.flat):
        return x
    return np.array(list(x.flat), dtype).reshape(x.shape)


def kind_of_scalar(v: Any) -> str:
    """The type of one scalar."""
    return v.kind if type(v) is Value else kind_of(v.dtype)


def aval_of(variable: Any) -> ShapedArray:
    """Shape and type of a variable, or of a constant in its place: kernels are of arrays, and have no other variables.

    JAX declares no more than that there is an abstract value.
    """
    return variable.aval


def like(aval: Any, dtype: Any) -> Any:
    """Shape and type of a result of another type."""
    return jax.ShapeDtypeStruct(aval.shape, dtype)


def kinds_of(x: np.ndarray) -> str:
    """The type of all entries; integers differ between problems as soon as one does."""
    if x.dtype != object:
        return kind_of(x.dtype)
    kinds = {kind_of_scalar(v) for v in x.flat}
    kinds = {"i" if k == "u" else k for k in kinds}
    (kind,) = kinds
    return kind
