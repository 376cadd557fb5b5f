"""Direct calls: all arrays are known, on the default CPU, and nobody transforms the call.

NumPy can then lay the arrays out, and nothing is compiled for that; and a batch can be filled up to a size for which
there is a program already.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Tree = Any


def is_direct(leaves: Iterable[Any]) -> bool:
    """True if all arrays are on the default CPU, put there by JAX itself, and nothing traces the call."""
    if jax.default_backend() != "cpu" or not jax.sharding.get_abstract_mesh().empty:
        return False
    # Inside somebody's jit every operation gives a tracer, even one on constants.
    known = all(isinstance(x, jax.Array) and not isinstance(x, Tracer) and not x.committed for x in leaves)
    return known and not isinstance(jnp.zeros(()), Tracer)


def power_of_two(count: int, least: int) -> int:
    """Find the smallest power of two that is at least `count` and at least `least`, a power of two."""
    return max(least, 1 << max(count - 1, 0).bit_length())


def filled(x: jax.Array | np.ndarray, size: int) -> jax.Array:
    """Fill an array (count, ...) up to (size, ...) with copies of its last entry."""
    values = np.asarray(x)
    if len(values) == size:
        return jax.device_put(x)
    padded = np.empty((size, *values.shape[1:]), values.dtype)
    padded[: len(values)] = values
    padded[len(values) :] = values[-1]
    return jax.device_put(padded)


def cut(tree: Tree, count: int) -> Tree:
    """Cut leaves (size, ...) to the (count, ...) that they were before `filled`."""
    return jax.tree.map(lambda x: x if len(x) == count else jax.device_put(np.asarray(x)[:count]), tree)
