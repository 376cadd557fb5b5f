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

    per_vertex: Float[Array, "..."]

    @classmethod
    def per_direction(cls, matrices: ArrayLike) -> "Compliance":
        """Compliances (*batch, n_d, n_c, 3, 3), blocks by contact, or (*batch, n_d, 3 n_c, 3 n_c), full; contact frames, m/N.

        They go with `DisturbanceSet.vertices` alone, in the order of its wrenches: a support function needs one pseudo-inverse.

        Raises:
            ValueError: fewer than three axes.
        """
        return cls(per_vertex=as_float("compliance", matrices, ("n_d", "3 n_c", "3 n_c")))


class Basis(NamedTuple):
    """An orthonormal basis of the row space of six (or more) rows, and the row operations T that lead to it; lanes trail.

    rows: list of r arrays (k, n, *lanes), T times the given rows: orthonormal, or zero where dropped.
    operations: list of r lists, T's lower triangle, arrays (*lanes); a dropped row of T is a vector that the given rows do not reach.
    kept: list of r arrays (*lanes), 1 or 0.
    ratios: list of r arrays (*lanes), what was left of each row, in lengths of the longest row.
    """

    rows: list
    operations: list
    kept: list
    ratios: list

    @property
    def rank(self) -> jax.Array:
        """Number of rows kept."""
        return sum(self.kept[1:], self.kept[0])

    def coordinates(self, wrench: jax.Array) -> list[jax.Array]:
        """T w for w (r, *lanes): coordinates in the basis where kept, what lies outside the range where dropped."""
        return [_combine(row, wrench) for row in self.operations]


def row_basis(rows: list[jax.Array]) -> Basis:
    """Gram-Schmidt with re-orthogonalisation of rows (k, n, *lanes).

    Two passes of the classical process leave the basis orthonormal to rounding whatever the condition of the rows.
    """
    longest = fenced(lambda rows: jnp.sqrt(_largest([_dot(r, r) for r in rows])))(rows)
    tolerance = RANK_TOLERANCE[rows[0].dtype.name]
    basis, operations, kept, ratios = [], [], [], []

    @fenced
    def remove(row: jax.Array, own: list, basis: list, operations: list) -> tuple:
        shares = [_dot(row, q) for q in basis]
        for share, q in zip(shares, basis, strict=True):
            row = row - share * q
        own = list(own)
        for share, other in zip(shares, operations, strict=True):
            for column, entry in enumerate(other):
                own[column] = own[column] - share * entry
        return row, own

    @fenced
    def normalise(row: jax.Array, own: list, longest: jax.Array) -> tuple:
        length = jnp.sqrt(_dot(row, row))
        keep = length > tolerance * longest
        inverse = jnp.where(keep, 1 / jnp.where(keep, length, 1), 0)
        own = [jnp.where(keep, entry * inverse, entry) for entry in own]
        return row * inverse, own, keep.astype(row.dtype), length / jnp.where(longest > 0, longest, 1)

    for index, row in enumerate(rows):
        own = [jnp.full_like(longest, float(column == index)) for column in range(index + 1)]
        for _ in range(2 if basis else 0):
            row, own = remove(row, own, basis, operations)
        q, own, keep, ratio = normalise(row, own, longest)
        basis.append(q)
        operations.append(own)
        kept.append(keep)
        ratios.append(ratio)
    return Basis(basis, operations, kept, ratios)


def inverse_root(compliance: jax.Array | None, contacts: int) -> tuple[jax.Array | None, jax.Array]:
    """M with M M' = Q^-1, lanes trailing, and whether Q is symmetric positive definite.

    Args:
        compliance: None for Q = I; blocks (n, 3, 3, *lanes) or full (3 n, 3 n, *lanes).
        contacts: n.

    Returns:
        blocks (n, 3, 3, *lanes) or full (3 n, 3 n, *lanes), the identity where Q is not sound, None for Q = I; and bool (*lanes).
    """
    if compliance is None:
        return None, jnp.array(True)
    full = compliance.shape[:2] == (3 * contacts, 3 * contacts)
    axes = (0, 1) if full else (1, 2)
    matrices = jnp.moveaxis(compliance, axes, (-2, -1))
    skew = jnp.abs(matrices - jnp.swapaxes(matrices, -1, -2)).max((-2, -1))
    symmetric = skew <= 1e-5 * jnp.abs(matrices).max((-2, -1))
    lower = jnp.linalg.cholesky(matrices, symmetrize_input=True)
    sound = symmetric & jnp.isfinite(lower).all((-2, -1))
    eye = jnp.broadcast_to(jnp.eye(matrices.shape[-1], dtype=matrices.dtype), matrices.shape)
    lower = jnp.where(sound[..., None, None], lower, eye)
    half = jnp.swapaxes(jax.scipy.linalg.solve_triangular(lower, eye, lower=True), -1, -2)
    return jnp.moveaxis(half, (-2, -1), axes), sound if full else sound.all(0)


def pseudo_inverse(columns: jax.Array, half: jax.Array | None) -> tuple[jax.Array, Basis]:
    """G* = Q^-1 G' (G Q^-1 G')^+ (15), on the range of G; lanes trail.

    Args:
        columns: (6, 3, n, *lanes), blocks of G, zero where absent.
        half: from `inverse_root`.

    Returns:
        (3, 6, n, *lanes), blocks of G*, and the basis of the rows of G.
    """
    basis = row_basis(list(_times_half(columns, half)))
    rows = _half_times(jnp.stack(basis.rows), half)

    @fenced
    def assemble(rows: jax.Array, operations: list) -> jax.Array:
        out = []
        for wrench in range(6):
            total = rows[wrench] * operations[wrench][wrench]
            for r in range(wrench + 1, 6):
                total = total + rows[r] * operations[r][wrench]
            out.append(total)
        return jnp.stack(out, 1)

    return assemble(rows, basis.operations), basis


def _times_half(columns: jax.Array, half: jax.Array | None) -> jax.Array:
    """G M, (6, 3, n, *lanes)."""
    if half is None:
        return columns
    if half.shape[:2] != (3 * columns.shape[2],) * 2:
        return jnp.einsum("rcn...,nca...->ran...", columns, half)
    tall = jnp.einsum("rp...,pq...->rq...", _flatten(columns), half)
    return _unflatten(tall)


def _half_times(rows: jax.Array, half: jax.Array | None) -> jax.Array:
    """M q for every basis row q, (6, 3, n, *lanes)."""
    if half is None:
        return rows
    if half.shape[:2] != (3 * rows.shape[2],) * 2:
        return jnp.einsum("nac...,rcn...->ran...", half, rows)
    return _unflatten(jnp.einsum("pq...,rq...->rp...", half, _flatten(rows)))


def _flatten(blocks: jax.Array) -> jax.Array:
    """(6, 3, n, *lanes) -> (6, 3 n, *lanes), contact by contact."""
    swapped = jnp.swapaxes(blocks, 1, 2)
    return swapped.reshape(blocks.shape[0], -1, *blocks.shape[3:])


def _unflatten(rows: jax.Array) -> jax.Array:
    return jnp.swapaxes(rows.reshape(rows.shape[0], -1, 3, *rows.shape[2:]), 1, 2)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b, (0, 1))


def _combine(row: list, wrench: jax.Array) -> jax.Array:
    total = row[0] * wrench[0]
    for column in range(1, len(row)):
        total = total + row[column] * wrench[column]
    return total


def _largest(values: list) -> jax.Array:
    best = values[0]
    for value in values[1:]:
        best = jnp.maximum(best, value)
    return best
