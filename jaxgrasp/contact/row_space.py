"""An orthonormal basis of the row space of the grasp map. Rank is decided here.

The six rows of G, moments divided by the root-mean-square distance of the contacts, are orthonormalised. A row that is
a combination of the earlier ones to within `RANK_TOLERANCE` of the longest row adds nothing and is dropped.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import each, fenced, repeat

RANK_TOLERANCE = {"float64": 1e-9, "float32": 1e-4}


class Basis(NamedTuple):
    """An orthonormal basis of the row space of r rows, and the row operations T that lead to it; lanes trail.

    rows: the basis, T times the r rows, (r, k, n, *lanes): orthonormal, or zero where dropped.
    operations: T, (r, r, *lanes); a dropped row of T is orthogonal to the range of G, but for the tolerance.
    kept: a mask of the rows, (r, *lanes): 1, or 0 where dropped.
    ratios: the length of each row after the earlier ones were removed, in lengths of the longest row, (r, *lanes).
    """

    rows: jax.Array
    operations: jax.Array
    kept: jax.Array
    ratios: jax.Array

    def coordinates(self, wrench: jax.Array) -> jax.Array:
        """Compute T w for w (r, *lanes): its coordinates in the basis; in dropped rows, its part outside the range."""
        return fold(jnp.add, [self.operations[:, c] * wrench[c] for c in range(wrench.shape[0])])

    def multipliers(self, y: jax.Array) -> jax.Array:
        """Compute T'y (r, *lanes): the multipliers of the original rows that belong to those of the basis."""
        return fold(jnp.add, [row * k for row, k in zip(self.operations, self.kept * y, strict=True)])


def row_basis(rows: jax.Array) -> Basis:
    """Make rows (r, k, n, *lanes) orthonormal by modified Gram-Schmidt.

    Of the three rows of moments, the longest remaining one goes first: after a short one, a row that depends on it
    would be rounding divided by the short one's length. Rows that end up shorter than the tolerance become zero, and
    their operations stay unscaled. One step of Newton and Schulz, B <- (3/2 - B B'/2) B, then makes the basis
    orthonormal to rounding: it squares the error that close rows cause.
    """
    count, lanes = rows.shape[0], rows.shape[3:]
    index = jnp.arange(count).reshape(count, *[1] * len(lanes))
    eye = jnp.eye(count, dtype=rows.dtype).reshape(count, count, *[1] * len(lanes))
    longest = jnp.sqrt(fold(jnp.maximum, dot(rows, rows)))
    least = RANK_TOLERANCE[rows.dtype.name] * longest

    # Scale row j to length 1, and remove it from the later ones.
    @fenced
    def remove(j: jax.Array, rows: jax.Array, operations: jax.Array, products: jax.Array) -> tuple:
        length = jnp.sqrt(products[j])
        keep = length > least
        inverse = jnp.where(keep, 1 / jnp.where(keep, length, 1), 0)
        this, later = index == j, index > j
        share = jnp.where(later, products * (inverse * inverse), 0)[:, None]
        turned = jnp.where(this[:, None], operations * jnp.where(keep, inverse, 1), operations - share * operations[j])
        return jnp.where(this[:, None, None], rows * inverse, rows - share[:, None] * rows[j]), turned, length

    def step(j: jax.Array, state: tuple) -> tuple:
        rows, operations, lengths = state
        products = fenced(lambda rows, j: dot(rows, rows[j]))(rows, j)
        rows, operations, length = remove(j, rows, operations, products)
        return rows, operations, lengths.at[j].set(length)

    # Three rows of forces in their order, then the three of moments by length, then any others.
    state = (rows, jnp.broadcast_to(eye, (count, count, *lanes)), jnp.zeros((count, *lanes), rows.dtype))
    state = repeat(3, step, state)
    for j in (3, 4):
        rows, operations, lengths = state
        first = _longest_first(rows[j:6], operations[j:6])
        rows, operations = rows.at[j:6].set(first[0]), operations.at[j:6].set(first[1])
        state = step(jnp.asarray(j), (rows, operations, lengths))
    rows, operations, lengths = repeat(count - 5, lambda i, state: step(i + 5, state), state)
    kept = (lengths > least).astype(rows.dtype)

    # Newton and Schulz: multiply by 1 + (1 - B B') / 2, where kept.
    @fenced
    def correction(rows: jax.Array) -> jax.Array:
        gram = each(lambda row: dot(rows, row), rows)
        return eye + 0.5 * (eye * kept - gram)

    @fenced
    def correct(factor: jax.Array, rows: jax.Array, operations: jax.Array) -> tuple:
        apply = lambda f: (
            fold(jnp.add, [f_r * r for f_r, r in zip(f, rows, strict=True)]),
            fold(jnp.add, [f_r * o for f_r, o in zip(f, operations, strict=True)]),
        )
        return each(apply, factor)

    rows, operations = correct(correction(rows), rows, operations)
    return Basis(rows, operations, kept, lengths / jnp.where(longest > 0, longest, 1))


@fenced
def _longest_first(rows: jax.Array, operations: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bring the longest of some rows to the front, by exchanging neighbours from the end on."""
    squares = list(dot(rows, rows))
    for r in reversed(range(1, len(squares))):
        longer = squares[r] > squares[r - 1]
        squares[r - 1] = jnp.maximum(squares[r], squares[r - 1])
        rows, operations = (
            x.at[r - 1].set(jnp.where(longer, x[r], x[r - 1])).at[r].set(jnp.where(longer, x[r - 1], x[r]))
            for x in (rows, operations)
        )
    return rows, operations


@jax.custom_jvp
def whitened(rows: jax.Array) -> Basis:
    """Compute `row_basis` as a change of coordinates: its derivative holds the row operations and the rank fixed.

    Programs with whitened rows need no more: their solutions do not depend on the combinations of rows.
    """
    return row_basis(rows)


@whitened.defjvp
def _whitened_jvp(primals: tuple, tangents: tuple) -> tuple[Basis, Basis]:
    """Apply the row operations to the change of the rows."""
    basis, (change,) = whitened(*primals), tangents
    still = jax.tree.map(jnp.zeros_like, basis)
    return basis, still._replace(rows=_operate(basis, change))


@fenced
def _operate(basis: Basis, rows: jax.Array) -> jax.Array:
    """Compute T rows, zero where dropped."""
    combine = lambda t: fold(jnp.add, [t_r * r for t_r, r in zip(t[0], rows, strict=True)]) * t[1]
    return each(combine, (basis.operations, basis.kept))


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute the inner products of rows (r, k, n, *lanes) with b (k, n, *lanes) or rows like a, (r, *lanes)."""
    return fold(jnp.add, jnp.moveaxis(fold(jnp.add, jnp.moveaxis(a * b, 1, 0)), 1, 0))
