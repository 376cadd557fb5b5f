"""Short vectors by their components, one array of all contacts each.

XLA's code for CPUs runs such arrays through in full vectors, where axes of three or eight at the end would leave these
half empty. What is computed of every contact is fenced off from what follows: else XLA computes it anew for every
contact that a sum takes in.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata

from jaxgrasp import linalg
from jaxgrasp.arrays import fold, fold_last
from jaxgrasp.lanes.fence import fenced

P = ParamSpec("P")
T = TypeVar("T")

sum_last, max_last, min_last, all_last, any_last = (
    partial(fold_last, op) for op in (jnp.add, jnp.maximum, jnp.minimum, jnp.logical_and, jnp.logical_or)
)


def once(function: Callable[P, T]) -> Callable[P, T]:
    """`fenced`, but for what JAX itself makes functions, `jnp.where` for example: these become part of it."""

    def plain(*args: P.args, **kwargs: P.kwargs) -> T:
        with set_xla_metadata(inlineable=None):
            return function(*args, **kwargs)

    return fenced(plain)


def parts_of(x: jax.Array) -> list[jax.Array]:
    """The entries along the last axis."""
    return [x[..., k] for k in range(x.shape[-1])]


def rows_of(x: jax.Array) -> list[list[jax.Array]]:
    """The entries of matrices, by rows."""
    return [parts_of(x[..., k, :]) for k in range(x.shape[-2])]


def inner(a: Sequence[jax.Array], b: Sequence[jax.Array]) -> jax.Array:
    """The inner product."""
    return fold(jnp.add, [x * y for x, y in zip(a, b, strict=True)])


def cross(a: Sequence[jax.Array], b: Sequence[jax.Array]) -> list[jax.Array]:
    """The cross product."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def divided(vectors: Sequence[jax.Array], matrices: list[list[jax.Array]]) -> list[jax.Array]:
    """Q^-1 v by components, by the adjugate, or by elimination for soft contacts."""
    if len(matrices) != 3:
        whole = jnp.stack([jnp.stack(row, -1) for row in matrices], -2)
        return parts_of(linalg.solve_positive(whole, jnp.stack(vectors, -1)[..., None])[..., 0])
    a, b, c = matrices
    # The columns of the adjugate.
    columns = cross(b, c), cross(c, a), cross(a, b)
    determinant = inner(a, columns[0])
    return [inner(row, vectors) / determinant for row in zip(*columns, strict=True)]
