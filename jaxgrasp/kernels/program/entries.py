"""Arrays whose entries are scalars of a kernel, each a `Value` or a NumPy constant."""

from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray

from jaxgrasp.kernels.program.expressions import Value, kind_of


def array(entries: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """Make an array of these entries."""
    out = np.empty(len(entries), object)
    out[:] = entries
    return out.reshape(shape)


def objects(x: np.ndarray) -> np.ndarray:
    """Turn an array into one of dtype object, whose entries are scalars of a kernel."""
    return x if x.dtype == object else array(list(x.ravel()), x.shape)


def fold_constants(x: np.ndarray, dtype: Any) -> np.ndarray:
    """Turn an array whose entries are all constants into one of this dtype; return others as they are."""
    if x.dtype != object or any(type(v) is Value for v in x.flat):
        return x
    return np.array(list(x.flat), dtype).reshape(x.shape)


def kind_of_scalar(v: Any) -> str:
    """Return the type of one scalar."""
    return v.kind if type(v) is Value else kind_of(v.dtype)


def aval_of(variable: Any) -> ShapedArray:
    """Return shape and dtype of a variable of a jaxpr, or of a constant in its place.

    The variables of kernels are arrays; JAX declares no more than that there is an abstract value.
    """
    return variable.aval


def like(aval: Any, dtype: Any) -> Any:
    """Return the same shape with another dtype."""
    return jax.ShapeDtypeStruct(aval.shape, dtype)


def common_kind(x: np.ndarray) -> str:
    """Return the type of all entries; it is "i" if some integers are "u", shared by all lanes, and others are not."""
    if x.dtype != object:
        return kind_of(x.dtype)
    kinds = {kind_of_scalar(v) for v in x.flat}
    kinds = {"i" if k == "u" else k for k in kinds}
    (kind,) = kinds
    return kind
