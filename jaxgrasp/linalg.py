"""Linear algebra of small dense matrices in batch, in JAX's own operations.

jaxlib's LAPACK calls on CPUs divide a batch over the threads of XLA's pool and wait for them on a thread of that same
pool: two such calls at once, on two devices or in one program, can wait for each other for ever. What is here knows no
threads: the matrices of a batch are computed like the entries of any other array, so a batch may be mapped, divided
over devices and differentiated like one. Loops have a fixed number of turns: no matrix waits for another one.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

# Larger matrices are factored in halves, so that most of the work is in products.
_UNDIVIDED = 16


@jax.custom_jvp
def cholesky(matrix: jax.Array) -> jax.Array:
    """L, lower triangular, with L L' = A.

    Args:
        matrix: A (*batch, n, n), symmetric.

    Returns:
        (*batch, n, n), all NaN where A is not positive definite.
    """
    n, matrix = matrix.shape[-1], (matrix + _transposed(matrix)) / 2
    if n > _UNDIVIDED:
        half = n // 2
        first, inverse = cholesky(matrix[..., :half, :half]), inverse_root(matrix[..., :half, :half])
        across = matrix[..., half:, :half] @ _transposed(inverse)
        last = cholesky(matrix[..., half:, half:] - across @ _transposed(across))
        return _whole(_lower(first, across, last))
    left = _eliminated(matrix)
    return _whole(_transposed(jnp.triu(left / _pivot_roots(left))))


@cholesky.defjvp
def _cholesky_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """DL = L Phi(L^-1 dA L^-T)."""
    lower = cholesky(*primals)
    return lower, lower @ _phi(inverse_root(*primals), *tangents)


@jax.custom_jvp
def inverse_root(matrix: jax.Array) -> jax.Array:
    """L^-1 for L L' = A, without L.

    Args:
        matrix: A (*batch, n, n), symmetric.

    Returns:
        (*batch, n, n), lower triangular, all NaN where A is not positive definite.
    """
    n, matrix = matrix.shape[-1], (matrix + _transposed(matrix)) / 2
    if n > _UNDIVIDED:
        half = n // 2
        first = inverse_root(matrix[..., :half, :half])
        across = matrix[..., half:, :half] @ _transposed(first)
        last = inverse_root(matrix[..., half:, half:] - across @ _transposed(across))
        return _whole(_lower(first, -last @ (across @ first), last))
    eye = jnp.broadcast_to(jnp.eye(n, dtype=matrix.dtype), matrix.shape)
    left = _eliminated(jnp.concatenate([matrix, eye], -1))
    return _whole(left[..., n:] / _pivot_roots(left))


@inverse_root.defjvp
def _inverse_root_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """dL^-1 = - Phi(L^-1 dA L^-T) L^-1."""
    inverse = inverse_root(*primals)
    return inverse, -_phi(inverse, *tangents) @ inverse


def _eliminated(left: jax.Array) -> jax.Array:
    """Rows (*batch, n, n or more) of which each has lost its shares of the earlier ones."""
    n = left.shape[-2]
    rows = jnp.arange(n)[:, None]

    def eliminate(j: jax.Array, left: jax.Array) -> jax.Array:
        share = left[..., j, None, :] / left[..., j, None, j, None]
        return jnp.where(rows > j, left - left[..., j, None] * share, left)

    return lax.fori_loop(0, n - 1, eliminate, left)


def _pivot_roots(left: jax.Array) -> jax.Array:
    """Square roots of the pivots (*batch, n, 1), NaN where they are not positive."""
    pivots = jnp.diagonal(left, axis1=-2, axis2=-1)[..., None]
    return jnp.sqrt(jnp.where(pivots > 0, pivots, jnp.nan))


def _whole(factor: jax.Array) -> jax.Array:
    """The factor, all NaN where something in it is not finite."""
    return jnp.where(jnp.isfinite(factor).all((-2, -1), keepdims=True), factor, jnp.nan)


def _lower(first: jax.Array, across: jax.Array, last: jax.Array) -> jax.Array:
    """A lower triangular matrix of its three blocks."""
    corner = jnp.zeros_like(_transposed(across))
    return jnp.concatenate([jnp.concatenate([first, corner], -1), jnp.concatenate([across, last], -1)], -2)


def _phi(inverse: jax.Array, change: jax.Array) -> jax.Array:
    """The lower triangle of L^-1 dA L^-T, with half of the diagonal."""
    moved = inverse @ (change + _transposed(change)) @ _transposed(inverse)
    return (jnp.tril(moved) + jnp.tril(moved, -1)) / 4


def solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """A^-1 B for symmetric positive definite A, by the elimination of Gauss and Jordan.

    Args:
        matrix: A (*batch, n, n). Pivots are clamped at eps of its diagonal.
        right: B (*batch, n, k), with the same batch.

    Returns:
        (*batch, n, k).
    """
    n = matrix.shape[-1]
    rows = jnp.arange(n)[:, None]

    def solve(_: Callable, right: jax.Array) -> jax.Array:
        least = jnp.finfo(matrix.dtype).eps * jnp.diagonal(matrix, axis1=-2, axis2=-1)

        def eliminate(j: jax.Array, both: jax.Array) -> jax.Array:
            pivot = jnp.maximum(both[..., j, j], least[..., j])
            row = both[..., j, None, :] / pivot[..., None, None]
            return jnp.where(rows == j, row, both - both[..., j, None] * row)

        return lax.fori_loop(0, n, eliminate, jnp.concatenate([matrix, right], -1))[..., n:]

    return lax.custom_linear_solve(lambda x: matrix @ x, right, solve, symmetric=True)


def right_singular(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Singular values and right singular vectors, held constant by derivatives.

    By one-sided Jacobi rotations: columns are turned in pairs until all are orthogonal, n/2 pairs at once in the order
    of a round-robin tournament. Columns that depend on others become zero to within rounding.

    Args:
        matrix: (*batch, m, n), any m and n.

    Returns:
        values: (*batch, n), descending.
        vectors: (*batch, n, n), columns in the same order.
    """
    matrix = lax.stop_gradient(matrix)
    n = matrix.shape[-1]
    largest = jnp.max(jnp.abs(matrix), (-2, -1), initial=0)
    scale = jnp.where(largest > 0, largest, 1)
    matrix = matrix / scale[..., None, None]
    # The longest column first: fewer turns are then wanted where lengths differ by decades.
    order = jnp.argsort(-jnp.sum(matrix * matrix, -2), axis=-1)
    columns = _transposed(_triangle(jnp.take_along_axis(matrix, order[..., None, :], -1)))
    # Rows are columns of R and of V, and a row of zeros makes their number even.
    both = jnp.concatenate([columns, (order[..., None] == jnp.arange(n)).astype(matrix.dtype)], -1)
    both = jnp.pad(both, [*[(0, 0)] * (both.ndim - 2), (0, n % 2), (0, 0)])
    half, m = both.shape[-2] // 2, columns.shape[-1]
    # Two more than the hardest matrices want that we found.
    sweeps = 7 + n.bit_length()

    def rotate(_: int, both: jax.Array) -> jax.Array:
        p, q = both[..., :half, :], both[..., half:, :]
        dot = lambda x, y: jnp.sum(x[..., :m] * y[..., :m], -1, keepdims=True)
        product = dot(p, q)
        slope = (dot(q, q) - dot(p, p)) / (2 * jnp.where(product != 0, product, 1))
        tangent = jnp.where(slope < 0, -1, 1) / (jnp.abs(slope) + jnp.sqrt(1 + slope * slope))
        tangent = jnp.where(product != 0, tangent, 0)
        cosine = lax.rsqrt(1 + tangent * tangent)
        p, q = cosine * (p - tangent * q), cosine * (q + tangent * p)
        # The first one keeps its seat, all others move on by one around the table.
        seats = [p[..., :1, :], q[..., :1, :], p[..., 1:-1, :], q[..., 1:, :], p[..., -1:, :]]
        return jnp.concatenate(seats if half > 1 else [p, q], -2)

    both = lax.fori_loop(0, sweeps * max(2 * half - 1, 1), rotate, both)[..., :n, :]
    values = scale[..., None] * jnp.sqrt(jnp.sum(both[..., :m] ** 2, -1))
    order = jnp.argsort(-values, axis=-1)
    vectors = jnp.take_along_axis(both[..., m:], order[..., None], -2)
    return jnp.take_along_axis(values, order, -1), _transposed(vectors)


def _triangle(matrix: jax.Array) -> jax.Array:
    """R (*batch, n, n) of A = QR, by Householder's reflections, or A itself where it has no more rows than columns."""
    m, n = matrix.shape[-2:]
    if m <= n:
        return matrix
    rows = jnp.arange(m)

    def reflect(j: jax.Array, left: jax.Array) -> jax.Array:
        column = jnp.where(rows >= j, left[..., j], 0)
        length = jnp.sqrt(jnp.sum(column * column, -1, keepdims=True))
        normal = column + jnp.where(rows == j, jnp.where(column < 0, -length, length), 0)
        square = jnp.sum(normal * normal, -1, keepdims=True)
        share = (normal[..., None, :] @ left) / jnp.where(square > 0, square, 1)[..., None]
        return left - 2 * normal[..., None] * share

    return jnp.triu(lax.fori_loop(0, n, reflect, matrix)[..., :n, :])


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def pinv(matrix: jax.Array, tolerance: float) -> jax.Array:
    """Moore and Penrose's inverse, of which singular values up to `tolerance` times the largest are 0.

    Args:
        matrix: (*batch, m, n).
        tolerance: relative.

    Returns:
        (*batch, n, m). Its derivative is that while the rank stays.
    """
    m, n = matrix.shape[-2:]
    if m < n:
        return _transposed(pinv(_transposed(matrix), tolerance))
    values, vectors = right_singular(matrix)
    counted = values > tolerance * values[..., :1]
    weights = jnp.where(counted, 1 / jnp.where(counted, values, 1) ** 2, 0)
    return (vectors * weights[..., None, :]) @ _transposed(matrix @ vectors)


@pinv.defjvp
def _pinv_jvp(tolerance: float, primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """DP = -P dA P + P P'dA'(1 - A P) + (1 - P A) dA'P'P, of Golub and Pereyra (1973)."""
    (A,), (change,) = primals, tangents
    P = pinv(A, tolerance)
    left = change - A @ (P @ change)
    right = change - (change @ P) @ A
    moved = P @ (_transposed(P) @ _transposed(left)) + _transposed(right) @ (_transposed(P) @ P)
    return P, moved - P @ change @ P


def _transposed(matrix: jax.Array) -> jax.Array:
    return jnp.swapaxes(matrix, -1, -2)
