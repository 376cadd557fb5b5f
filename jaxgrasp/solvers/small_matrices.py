"""Linear algebra of small matrices, one for every block or lane, in code that XLA's CPU backend vectorises over them.

The leading axes of an array are the rows and columns of a matrix; the trailing ones are blocks, copies and lanes, each
with a matrix of its own, so that every elementary operation runs over all of these. `jnp.linalg` would call LAPACK for
every single matrix.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import each, fenced, repeat

# `inverse_cholesky` eliminates matrices up to this size row by row, and cuts larger ones in two.
_LARGEST_UNCUT = 16


def spread_over(values: jax.Array, like: jax.Array) -> jax.Array:
    """Append axes to constants, so that they weigh arrays of which `like` is one along its leading axis."""
    return values.reshape(values.shape + (1,) * (like.ndim - 1))


def matvec(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """Compute M v of M (r, c, ...) and v (c, ...)."""
    return fold(jnp.add, jnp.swapaxes(matrix, 0, 1) * v[:, None])


def matvec_transposed(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """Compute M'v of M (r, c, ...) and v (r, ...)."""
    return fold(jnp.add, matrix * v[:, None])


def sum_over_blocks(x: jax.Array) -> jax.Array:
    """Sum (eq, k, n, ...) over the components and the blocks, the axes 1 and 2: (eq, ...)."""
    return fold(jnp.add, jnp.moveaxis(fold(jnp.add, jnp.moveaxis(x, 1, 0)), 1, 0))


def flatten(x: jax.Array) -> jax.Array:
    """Lay the unknowns of blocks, (k, n, ...), behind each other block by block: (k n, ...)."""
    return jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:])


def unflatten(x: jax.Array, k: int) -> jax.Array:
    """Undo `flatten`: (k n, ...) to blocks of k unknowns, (k, n, ...)."""
    return jnp.swapaxes(x.reshape(-1, k, *x.shape[1:]), 0, 1)


def block_diagonal(blocks: jax.Array) -> jax.Array:
    """Make one matrix (k n, k n, ...) of its blocks (k, k, n, ...), in the order of `flatten`."""
    k, _, n = blocks.shape[:3]
    spread = jnp.einsum("abi...,ij->iajb...", blocks, jnp.eye(n, dtype=blocks.dtype))
    return spread.reshape(k * n, k * n, *blocks.shape[3:])


@fenced
def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute A B of matrices (r, c, *lanes) and (c, d, *lanes)."""
    return each(lambda row: fold(jnp.add, [x * y for x, y in zip(row, b, strict=True)]), a)


def matmul_transposed(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute A B' of matrices (r, c, *lanes) and (d, c, *lanes)."""
    return matmul(a, jnp.swapaxes(b, 0, 1))


def inverse_cholesky(matrix: jax.Array, floor: jax.Array | None = None) -> jax.Array:
    """Invert the Cholesky factor of a symmetric positive definite M = L L', (eq, eq, *lanes): returns L^-1.

    Large matrices are cut in two: with M = [M11 M21'; M21 M22], C = M21 L11^-T and L22 L22' = M22 - C C',

        L^-1 = [L11^-1  0; -L22^-1 C L11^-1  L22^-1],

    which is a third of the work of one elimination.

    Args:
        matrix: M, (eq, eq, *lanes).
        floor: (eq, *lanes), the least value of a pivot; eps times the diagonal if None.
    """
    size, lanes = matrix.shape[0], matrix.shape[2:]
    index = jnp.arange(size).reshape(size, *[1] * len(lanes))
    eye = jnp.eye(size, dtype=matrix.dtype).reshape(size, size, *[1] * len(lanes))
    least = jnp.finfo(matrix.dtype).eps * fold(jnp.add, eye * matrix) if floor is None else floor
    if size > _LARGEST_UNCUT:
        middle = size // 2
        first = inverse_cholesky(matrix[:middle, :middle], least[:middle])
        below = matmul_transposed(matrix[middle:, :middle], first)
        last = inverse_cholesky(matrix[middle:, middle:] - matmul_transposed(below, below), least[middle:])
        corner = -matmul(last, matmul(below, first))
        zero = jnp.zeros((middle, size - middle, *lanes), matrix.dtype)
        return jnp.concatenate([jnp.concatenate([first, zero], 1), jnp.concatenate([corner, last], 1)])

    def eliminate(j: jax.Array, state: tuple) -> tuple:
        """Clear column j below the diagonal of M, and do the same to the identity, which becomes L^-1."""
        remainder, inverse_factor = state

        @fenced
        def scale(remainder: jax.Array) -> tuple:
            inverse = lax.rsqrt(jnp.maximum(remainder[j, j], least[j]))
            return inverse, jnp.where(index > j, remainder[:, j], 0) * (inverse * inverse)

        @fenced
        def subtract(rows: jax.Array, inverse: jax.Array, multipliers: jax.Array) -> jax.Array:
            return jnp.where((index == j)[:, None], rows * inverse, rows - multipliers[:, None] * rows[j])

        inverse, multipliers = scale(remainder)
        return subtract(remainder, inverse, multipliers), subtract(inverse_factor, inverse, multipliers)

    return repeat(size, eliminate, (matrix, jnp.broadcast_to(eye, matrix.shape)))[1]


def orthonormalise(matrix: jax.Array) -> jax.Array:
    """Find the upper triangular T for which the columns of M T are orthonormal, by modified Gram-Schmidt.

    With M'M = L L' it is L^-T. M'M itself would square the condition, too much for float32; large rows come first.

    Args:
        matrix: M, (r, c, *lanes), with independent columns.

    Returns:
        T, (c, c, *lanes).
    """
    rows, size = matrix.shape[:2]
    index = jnp.arange(size).reshape(size, *[1] * (matrix.ndim - 2))
    eye = jnp.eye(size, dtype=matrix.dtype).reshape(size, size, *[1] * (matrix.ndim - 2))

    def remove(j: jax.Array, both: jax.Array) -> jax.Array:
        """Make column j one long, and the later ones orthogonal to it."""

        @fenced
        def components(both: jax.Array) -> tuple:
            column = both[:rows, j]
            square = fold(jnp.add, column * column)
            inverse = lax.rsqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny))
            along = fold(jnp.add, both[:rows] * column[:, None]) * inverse
            return both[:, j] * inverse, along

        @fenced
        def subtract(both: jax.Array, unit: jax.Array, along: jax.Array) -> jax.Array:
            moved = both - unit[:, None] * jnp.where(index > j, along, 0)
            return jnp.where(index == j, unit[:, None], moved)

        return subtract(both, *components(both))

    both = jnp.concatenate([matrix, jnp.broadcast_to(eye, (size, *matrix.shape[1:]))])
    return repeat(size, remove, both)[rows:]


class ColumnFactor(NamedTuple):
    """The Cholesky factor L of matrices (r, r, *lanes), by columns, whose size is that of the code as well."""

    below: list[jax.Array]  # the entries of column j below the diagonal, (r - 1 - j, *lanes), of all but the last one
    inverse: list[jax.Array]  # 1 / diag(L), (*lanes) each

    def remainders(self, rhs: jax.Array) -> jax.Array:
        """Compute diag(L) L^-1 rhs for rhs (r, *lanes): what the columns before leave of every entry."""
        out = []
        for below, inverse in zip(self.below, self.inverse[:-1], strict=True):
            out.append(rhs[0])
            rhs = rhs[1:] - below * (rhs[0] * inverse)
        return jnp.stack([*out, rhs[0]])

    def down(self, rhs: jax.Array) -> jax.Array:
        """Compute L^-1 rhs for rhs (r, *lanes)."""
        return self.remainders(rhs) * jnp.stack(self.inverse)

    def up(self, rhs: jax.Array) -> jax.Array:
        """Compute L^-T rhs for rhs (r, *lanes)."""
        out = (rhs[-1] * self.inverse[-1])[None]
        for j in reversed(range(len(rhs) - 1)):
            entry = (rhs[j] - fold(jnp.add, self.below[j] * out)) * self.inverse[j]
            out = jnp.concatenate([entry[None], out])
        return out


def cholesky_by_columns(matrix: jax.Array, dropped: float | None = None) -> ColumnFactor:
    """Factor symmetric positive definite matrices.

    Args:
        matrix: (r, r, *lanes).
        dropped: rows whose pivot is no more than this share of the diagonal are left out: 1 / diag(L) is 0 there. None:
            pivots are clamped at eps of the diagonal.
    """
    share = jnp.finfo(matrix.dtype).eps if dropped is None else dropped
    least = [share * matrix[j, j] for j in range(len(matrix))]
    factor = ColumnFactor([], [])
    for floor in least:
        root = lax.rsqrt(jnp.maximum(matrix[0, 0], floor))
        factor.inverse.append(root if dropped is None else jnp.where(matrix[0, 0] > floor, root, 0))
        if len(matrix) > 1:
            below = matrix[1:, 0] * factor.inverse[-1]
            factor.below.append(below)
            matrix = matrix[1:, 1:] - below[:, None] * below
    return factor


def lower_places(size: int) -> np.ndarray:
    """Find where the entries of a symmetric matrix stand in its lower triangle, row by row: (size, size)."""
    rows, columns = np.maximum(*np.indices((size, size))), np.minimum(*np.indices((size, size)))
    return rows * (rows + 1) // 2 + columns


class SmallFactor(NamedTuple):
    """The Cholesky factor L of small matrices; lists of entries of any one shape."""

    below: list[jax.Array]  # L10, L20, L21, ..
    inverse: list[jax.Array]  # 1 / diag(L)


def small_cholesky(entries: list[jax.Array]) -> SmallFactor:
    """Factor symmetric positive definite matrices, written out; pivots are clamped at eps of the diagonal.

    Args:
        entries: 00, 10, 11, 20, 21, 22, .. of the matrices, of any one shape.
    """
    eps = jnp.finfo(entries[0].dtype).eps
    below: list[jax.Array] = []
    inverse: list[jax.Array] = []
    while entries:
        i = len(inverse)
        *row, diagonal = entries[: i + 1]
        entries = entries[i + 1 :]
        pivot = diagonal
        for j in range(i):
            for m in range(j):
                row[j] = row[j] - row[m] * below[j * (j - 1) // 2 + m]
            row[j] = row[j] * inverse[j]
            pivot = pivot - row[j] * row[j]
        below += row
        inverse.append(lax.rsqrt(jnp.maximum(pivot, eps * diagonal)))
    return SmallFactor(below, inverse)


def substitute_down(below: list[jax.Array], inverse: list[jax.Array], rhs: list[jax.Array]) -> list[jax.Array]:
    """Compute L^-1 rhs; lists run over the unknowns, see `SmallFactor`."""
    out: list[jax.Array] = []
    for i, entry in enumerate(rhs):
        for j in range(i):
            entry = entry - below[i * (i - 1) // 2 + j] * out[j]
        out.append(entry * inverse[i])
    return out


def substitute_up(below: list[jax.Array], inverse: list[jax.Array], rhs: list[jax.Array]) -> list[jax.Array]:
    """Compute L^-T rhs; lists run over the unknowns, see `SmallFactor`."""
    out = list(rhs)
    for i in reversed(range(len(rhs))):
        for j in range(i + 1, len(rhs)):
            out[i] = out[i] - below[j * (j - 1) // 2 + i] * out[j]
        out[i] = out[i] * inverse[i]
    return out


def solve_lower(factor: SmallFactor, rhs: jax.Array) -> jax.Array:
    """Compute L^-1 rhs for rhs (k, ...)."""
    return jnp.stack(substitute_down(factor.below, factor.inverse, list(rhs)))


def solve_small(factor: SmallFactor, rhs: jax.Array) -> jax.Array:
    """Compute (L L')^-1 rhs for rhs (k, ...)."""
    down = substitute_down(factor.below, factor.inverse, list(rhs))
    return jnp.stack(substitute_up(factor.below, factor.inverse, down))
