"""Compliance Q (14) and the weighted pseudo-inverse of the grasp map (15).

Rank is decided here. The six rows of G, moments divided by the root-mean-square distance of the contacts, are
orthonormalised; a row that is a combination of the earlier ones to within `RANK_TOLERANCE` of the longest row adds nothing and is dropped.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float
from jaxgrasp.fence import fenced

RANK_TOLERANCE = {"float64": 1e-9, "float32": 1e-4}


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Compliance:
    """One compliance Q_j for each disturbance vertex; a single Q for all is given as a plain array instead."""

    per_vertex: Float[Array, "*batch directions ..."]

    @classmethod
    def per_direction(cls, matrices: ArrayLike) -> "Compliance":
        """Compliances (*batch, n_d, n_c, 3, 3), blocks by contact, or (*batch, n_d, 3 n_c, 3 n_c), full; contact frames, m/N.

        They go with `DisturbanceSet.vertices` alone, in the order of its wrenches: a support function needs one pseudo-inverse.

        Raises:
            ValueError: fewer than three axes.
        """
        return cls(per_vertex=as_float("compliance", matrices, ("n_d", "3 n_c", "3 n_c")))


class Basis(NamedTuple):
    """An orthonormal basis of the row space of some rows, and the row operations that lead to it; lanes trail.

    rows: list of r arrays (k, n, *lanes), orthonormal, or zero where dropped.
    carried: list of r lists of arrays (*lanes), the same row operations done to extra columns: the coordinates of a right-hand side in the basis,
        and where a row was dropped, what is left over of it.
    kept: list of r arrays (*lanes), 1 or 0.
    ratios: list of r arrays (*lanes), what was left of each row by the length of the longest row.
    """

    rows: list
    carried: list
    kept: list
    ratios: list


def row_basis(rows: list[jax.Array], extra: list[list[jax.Array]]) -> Basis:
    """Gram-Schmidt with re-orthogonalisation of rows (k, n, *lanes), done to the extra columns too.

    Two passes of the classical process leave the basis orthonormal to rounding whatever the condition of the rows.
    """
    longest = fenced(lambda rows: jnp.sqrt(_largest([_dot(r, r) for r in rows])))(rows)
    tolerance = RANK_TOLERANCE[rows[0].dtype.name]
    basis, carried, kept, ratios = [], [], [], []

    @fenced
    def remove(row: jax.Array, own: list, basis: list, carried: list) -> tuple:
        shares = [_dot(row, q) for q in basis]
        for share, q in zip(shares, basis, strict=True):
            row = row - share * q
        own = [_subtract(e, shares, [c[j] for c in carried]) for j, e in enumerate(own)]
        return row, own

    @fenced
    def normalise(row: jax.Array, own: list) -> tuple:
        length = jnp.sqrt(_dot(row, row))
        keep = length > tolerance * longest
        inverse = jnp.where(keep, 1 / jnp.where(keep, length, 1), 0)
        return (
            row * inverse,
            [jnp.where(keep, e * inverse, e) for e in own],
            keep.astype(row.dtype),
            length / jnp.where(longest > 0, longest, 1),
        )

    for row, own in zip(rows, extra, strict=True):
        for _ in range(2 if basis else 0):
            row, own = remove(row, own, basis, carried)
        q, c, keep, ratio = normalise(row, own)
        basis.append(q)
        carried.append(c)
        kept.append(keep)
        ratios.append(ratio)
    return Basis(basis, carried, kept, ratios)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b, (0, 1))


def _subtract(entry: jax.Array, shares: list, columns: list) -> jax.Array:
    for share, column in zip(shares, columns, strict=True):
        entry = entry - share * column
    return entry


def _largest(values: list) -> jax.Array:
    best = values[0]
    for value in values[1:]:
        best = jnp.maximum(best, value)
    return best
