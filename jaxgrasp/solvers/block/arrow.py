"""A quadratic program whose copies of small blocks meet in one of them: the form of (11).

    min 1/2 x_0' H_0 x_0 + sum_j 1/2 (x_j - x_0)' H_j (x_j - x_0)   over x_0, x_1 .. x_J, blocks of k each, with
    A x_ji <= h   and   sum_i E_i x_ji = b_j.

The Newton matrix is an arrow: given x_0, the hub, the copies have nothing to do with each other. With the weights W of
the rows, P_j = A'W_j A + H_j and P_0 = A'W_0 A + H_0 + sum_j H_j, a step solves

    P_j dx_j - H_j dx_0 + E'dy_j = r_j,    E dx_j = q_j            for every copy j,
    P_0 dx_0 - sum_j H_j dx_j + E'dy_0 = r_0,    E dx_0 = q_0.

The blocks of the copies are eliminated, then their equalities, with F_j = P_j^-1 H_j, a Cholesky factor of
E P_j^-1 E' = L_j L_j' and G_j = L_j^-1 E F_j:

    dx_j = P_j^-1 (r_j - E'dy_j) + F_j dx_0,    L_j'dy_j = L_j^-1 (E P_j^-1 r_j - q_j) + G_j dx_0,

    (P_0 - sum_j (H_j F_j - G_j'G_j)) dx_0 + E'dy_0 = r_0 + sum_j (H_j P_j^-1 r_j - G_j'L_j^-1 (E P_j^-1 r_j - q_j)).

The last system, of k n unknowns and the equalities of the hub, is solved by inverse Cholesky factors. A step costs
O(J (n + n^2) + n^3); a dense factorisation would cost O(J^3 n^3). Where H_j ties the blocks together P_j is dense, too,
and a step costs O(J n^3). H_0 may be full at no cost, since the hub's matrix is.

Callers scale: |x|_inf <= 1 at admissible points, rows of E orthonormal or zero, entries of H at most 1.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import fold, literal
from jaxgrasp.lanes.fence import each, fenced, repeat
from jaxgrasp.solvers.interior_point import Iterate, Residuals
from jaxgrasp.solvers.small_matrices import (
    SmallFactor,
    block_diagonal,
    flatten,
    inverse_cholesky,
    matmul,
    matvec,
    matvec_transposed,
    small_cholesky,
    solve_small,
    spread_over,
    sum_over_blocks,
    unflatten,
)


class ArrowRecord(NamedTuple):
    """The best certified bounds so far and their points: x for the upper, (y, z) and `tangent` for the lower one."""

    lower: jax.Array
    upper: jax.Array
    x: jax.Array
    y: jax.Array
    z: jax.Array
    tangent: jax.Array


class _Factors(NamedTuple):
    """The reduced Newton system, in the letters of the module's docstring."""

    # Cholesky factors of the blocks of P_j, (n, J, *lanes), or one of a dense P_j, (k n, k n, J, *lanes), inverted.
    copies: SmallFactor | jax.Array
    follow: jax.Array  # F_j, like H_j
    roots: jax.Array  # (eq, eq, J, *lanes), L_j^-1
    reach: jax.Array  # (eq, k, n, J, *lanes), G_j
    hub: jax.Array  # (k n, k n, *lanes), K, the inverse Cholesky factor of the matrix of dx_0
    hub_root: jax.Array  # (eq, eq, *lanes), the inverse Cholesky factor of E K'K E'
    hub_columns: jax.Array  # (eq, k n, *lanes), E K'
    weights: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ArrowProblem:
    """The program for `interior_point.solve`; x is (k, n, J + 1, *lanes), x_0 last, rows (m, n, J + 1, *lanes)."""

    patterns: jax.Array
    """The rows A, (m, k)."""
    h: jax.Array
    """The right-hand sides of the rows, (m, 1 or n, 1, *1 or *lanes)."""
    columns: jax.Array
    """E, (eq, k, n, 1, *lanes); zero where a row is dropped or a block absent."""
    rhs: jax.Array
    """The right-hand sides b_j of the equality rows, (eq, J + 1, *lanes)."""
    dropped: jax.Array
    """A mask of the equality rows, (eq, 1, *lanes): 1 for rows that are zero, else 0."""
    hub_hessian: jax.Array
    """H_0: its blocks, (k, k, n, 1, *lanes), or a full matrix, (k n, k n, 1, *lanes), block by block."""
    copy_hessian: jax.Array
    """H_j: blocks, (k, k, n, J or 1, *lanes), or full matrices, (k n, k n, J or 1, *lanes); 1 where all are one."""
    guess: jax.Array
    """A point to start from, (k, n, J + 1, *lanes): inside the rows, if possible."""

    @property
    def lanes(self) -> tuple[int, ...]:
        """The shape of the trailing axes."""
        return self.rhs.shape[2:]

    @property
    def present(self) -> jax.Array:
        """The mask of rows: every row counts."""
        return jnp.ones((1,) * self.guess.ndim, self.rhs.dtype)

    @property
    def predictor(self) -> Self:
        """The problem itself: its directions are not refined beyond one solve."""
        return self

    def apply(self, x: jax.Array) -> jax.Array:
        """Compute A x, (m, n, J + 1, *lanes)."""
        return matvec_transposed(spread_over(self.patterns.T, x), x)

    def adjoint(self, z: jax.Array) -> jax.Array:
        """Compute A'z, (k, n, J + 1, *lanes)."""
        return matvec_transposed(spread_over(self.patterns, z), z)

    def equality(self, x: jax.Array) -> jax.Array:
        """Compute E x, (eq, J + 1, *lanes)."""
        return sum_over_blocks(self.columns * x)

    def pull_back(self, y: jax.Array) -> jax.Array:
        """Compute E'y, (k, n, J + 1, *lanes)."""
        return fold(jnp.add, self.columns * y[:, None, None])

    def project(self, x: jax.Array) -> jax.Array:
        """Find the nearest point with E x = b: the rows of E are orthonormal."""
        return x + self.pull_back(self.rhs - self.equality(x))

    def gradient(self, x: jax.Array) -> jax.Array:
        """Compute the gradient of the objective at x, shaped like x."""
        moved = _times(self.copy_hessian, x[:, :, :-1] - x[:, :, -1:])
        hub = _times(self.hub_hessian, x[:, :, -1:]) - _sum_copies(moved)
        return jnp.concatenate([moved, hub], 2)

    def objective(self, x: jax.Array) -> jax.Array:
        """Compute the objective at x, (*lanes)."""
        moved = x[:, :, :-1] - x[:, :, -1:]
        return 0.5 * (
            _total(moved * _times(self.copy_hessian, moved))
            + _total(x[:, :, -1:] * _times(self.hub_hessian, x[:, :, -1:]))
        )

    def start(self) -> Iterate:
        """Start from the guess, with slacks of at least 0.03 and multipliers on the central path s z = 0.02."""
        x = self.project(self.guess)
        s = jnp.maximum(self.h - self.apply(x), 0.03)
        z = 0.02 / s
        return Iterate(x, -self.equality(self.gradient(x) + self.adjoint(z)), s, z)

    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals of stationarity, of E x = b and of the rows."""
        dual = self.gradient(iterate.x) + self.adjoint(iterate.z) + self.pull_back(iterate.y)
        return Residuals(dual, self.equality(iterate.x) - self.rhs, self.apply(iterate.x) + iterate.s - self.h)

    def factor(self, weights: jax.Array) -> _Factors:
        """Factor the Newton system: eliminate the copies' blocks, their equalities, then x_0."""
        eq, size = self.columns.shape[0], self.columns.shape[1] * self.columns.shape[2]
        if self.copy_hessian.ndim == self.guess.ndim:
            factors, follow, matrix, across, hub = self._eliminate_coupled_copies(weights)
        else:
            factors, follow, matrix, across, hub = fenced(self._eliminate_copies)(weights)

        # Equalities of the copies: G_j = L_j^-1 E F_j, and the sum of G_j'G_j for the hub.
        eye = jnp.eye(eq, dtype=weights.dtype).reshape(eq, eq, *[1] * (self.rhs.ndim - 1))
        roots = inverse_cholesky(matrix + eye * self.dropped)

        @fenced
        def couple(roots: jax.Array, across: jax.Array, hub: jax.Array) -> tuple:
            reach = jnp.stack([fold(jnp.add, root[:, None, None] * across) for root in roots])
            flat = jnp.swapaxes(reach, 1, 2).reshape(eq, size, -1, *self.lanes)
            whole = jnp.einsum("epj...,eqj...->pq...", flat, flat)
            whole = whole + (hub if hub.ndim == whole.ndim else block_diagonal(hub))
            if self.hub_hessian.ndim == self.guess.ndim:
                whole = whole + self.hub_hessian[:, :, 0]
            return reach, whole

        reach, whole = couple(roots, across, hub)

        # The hub and its equalities.
        inverse = inverse_cholesky(whole)

        @fenced
        def tie(inverse: jax.Array) -> tuple:
            columns = jnp.swapaxes(self.columns[:, :, :, 0], 1, 2).reshape(eq, size, *self.lanes)
            turned = jnp.einsum("ep...,qp...->eq...", columns, inverse)
            return turned, jnp.einsum("ep...,fp...->ef...", turned, turned)

        turned, tied = tie(inverse)
        return _Factors(
            factors,
            follow,
            roots,
            reach,
            inverse,
            inverse_cholesky(tied + eye[..., 0, :] * self.dropped[:, 0]),
            turned,
            weights,
        )

    def _eliminate_copies(self, weights: jax.Array) -> tuple:
        """Compute factors of P_j, F_j, E P_j^-1 E' and E F_j of the copies, and P_0 - sum_j H_j F_j without a full H_0.

        The last one comes in blocks.
        """
        eq, k = self.columns.shape[:2]
        pairs = _pairs(k)
        grams = self._grams(weights)
        factors = small_cholesky([g[:, :-1] + self.copy_hessian[a, b] for g, (a, b) in zip(grams, pairs, strict=True)])
        follow = jnp.stack([solve_small(factors, self.copy_hessian[:, b]) for b in range(k)], 1)
        solved = jnp.stack([solve_small(factors, self.columns[r]) for r in range(eq)])
        matrix = jnp.stack([sum_over_blocks(self.columns * solved[r]) for r in range(eq)])
        across = fold(jnp.add, jnp.moveaxis(self.columns[:, :, None] * follow, 1, 0))
        hub = _symmetric(grams)[:, :, :, -1:]
        if self.hub_hessian.ndim > self.guess.ndim:
            hub = hub + self.hub_hessian
        # H_j - H_j P_j^-1 H_j of every copy, whose sum over the copies joins H_0 + A'W_0 A.
        remainder = self.copy_hessian - fold(jnp.add, jnp.moveaxis(self.copy_hessian[:, :, None] * follow[None], 1, 0))
        return factors, follow, matrix, across, (hub + _sum_copies(remainder, 3))[:, :, :, 0]

    def _eliminate_coupled_copies(self, weights: jax.Array) -> tuple:
        """Do what `_eliminate_copies` does where H_j are full matrices; so is then what is left of the hub."""
        blocks = fenced(lambda weights: _symmetric(self._grams(weights)))(weights)
        roots = inverse_cholesky(block_diagonal(blocks[:, :, :, :-1]) + self.copy_hessian)
        pulled = matmul(roots, self.copy_hessian)
        follow = matmul(jnp.swapaxes(roots, 0, 1), pulled)

        @fenced
        def reduce(roots: jax.Array, pulled: jax.Array) -> tuple:
            turned = each(lambda column: matvec(roots, column), jax.vmap(flatten)(self.columns))
            matrix = each(lambda row: fold(jnp.add, jnp.moveaxis(turned * row, 1, 0)), turned)
            across = each(lambda row: matvec_transposed(pulled, row), turned)
            return matrix, jax.vmap(lambda x: unflatten(x, self.columns.shape[1]))(across)

        matrix, across = reduce(roots, pulled)
        remainder = self.copy_hessian - matmul(jnp.swapaxes(pulled, 0, 1), pulled)
        hub = blocks[:, :, :, -1]
        if self.hub_hessian.ndim > self.guess.ndim:
            hub = hub + self.hub_hessian[:, :, :, 0]
        return roots, follow, matrix, across, block_diagonal(hub) + jnp.sum(remainder, 2)

    def _grams(self, weights: jax.Array) -> list[jax.Array]:
        """Compute the entries `_pairs` of the blocks of A'W A, (n, J + 1, *lanes) each."""
        squares = [self.patterns[:, a] * self.patterns[:, b] for a, b in _pairs(self.patterns.shape[1])]
        return [fold(jnp.add, spread_over(square, weights) * weights) for square in squares]

    def solve(self, factors: _Factors, residuals: Residuals, shift: jax.Array) -> tuple:
        """Solve the Newton system with dz = shift + weights * A dx for the directions (dx, dy, A dx)."""
        k, n = self.columns.shape[1:3]

        @fenced
        def newton(rhs: jax.Array, rhs_y: jax.Array) -> tuple:
            # Copies, while x_0 stays: P_j^-1 r_j and L_j^-1 (E P_j^-1 r_j - q_j).
            first = _solve_copies(factors.copies, rhs[:, :, :-1])
            root_y = matvec(factors.roots, self.equality(first) - rhs_y[:, :-1])

            # The hub: its right-hand side, then dy_0 and dx_0.
            push = fold(jnp.add, factors.reach * root_y[:, None, None])
            right = rhs[:, :, -1:] + _sum_copies(_times(self.copy_hessian, first) - push)
            flat = jnp.swapaxes(right[:, :, 0], 0, 1).reshape(k * n, *self.lanes)
            root_right = matvec(factors.hub, flat)
            hub_y = matvec(factors.hub_root, matvec(factors.hub_columns, root_right) - rhs_y[:, -1])
            hub_y = matvec_transposed(factors.hub_root, hub_y)
            hub = matvec_transposed(factors.hub, root_right - matvec_transposed(factors.hub_columns, hub_y))
            hub = jnp.swapaxes(hub.reshape(n, k, *self.lanes), 0, 1)[:, :, None]

            # Back to the copies: dy_j and dx_j.
            copies_y = matvec_transposed(factors.roots, root_y + sum_over_blocks(factors.reach * hub))
            copies = first + _times(factors.follow, hub) - _solve_copies(factors.copies, self.pull_back(copies_y))
            return jnp.concatenate([copies, hub], 2), jnp.concatenate([copies_y, hub_y[:, None]], 1)

        def improve(_: jax.Array, state: tuple) -> tuple:
            dx, dy, rows = state
            rhs = (
                -residuals.dual - self.adjoint(shift + factors.weights * rows) - self.gradient(dx) - self.pull_back(dy)
            )
            more_x, more_y = newton(rhs, -residuals.primal - self.equality(dx))
            return dx + more_x, dy + more_y, self.apply(dx + more_x)

        return repeat(1, improve, jax.tree.map(jnp.zeros_like, (residuals.dual, residuals.primal, residuals.rows)))

    def first_record(self) -> ArrowRecord:
        """Make the record before the first step: no bound yet."""
        inf = jnp.full(self.lanes, jnp.inf, self.rhs.dtype)
        rows = jnp.zeros((self.patterns.shape[0], *self.guess.shape[1:]), self.rhs.dtype)
        return ArrowRecord(-inf, inf, jnp.zeros_like(self.guess), jnp.zeros_like(self.rhs), rows, self.guess)

    def gap_scale(self, record: ArrowRecord) -> jax.Array:
        """Measure gaps by the effort, but by no less than a thousandth of a unit."""
        return jnp.maximum(jnp.where(jnp.isinf(record.upper), 0, record.upper), 1e-3)

    def assess(self, iterate: Iterate, residuals: Residuals, record: ArrowRecord) -> ArrowRecord:
        """Update both bounds; violations of the rows are charged at the rows' multipliers."""
        x = self.project(iterate.x)
        # A point that all but meets the rows attains the upper bound.
        over = jnp.maximum(self.apply(x) - self.h, 0)
        violation = fold(jnp.maximum, fold(jnp.maximum, fold(jnp.maximum, over)))
        near = 1e-9 if self.rhs.dtype == jnp.float64 else 2e-6
        upper = jnp.where(violation <= near, self.objective(x) + _total(over * iterate.z), jnp.inf)
        # By convexity f(u) >= f(x) + f'(x)(u - x), so f >= -f(x) - h'z - b'y - |r|_1 with r the dual residual.
        sides = _total(self.h * iterate.z) + fold(jnp.add, fold(jnp.add, iterate.y * self.rhs))
        lower = -self.objective(iterate.x) - sides - _total(jnp.abs(residuals.dual))
        falls, rises = upper < record.upper, lower > record.lower
        return ArrowRecord(
            lower=jnp.where(rises, lower, record.lower),
            upper=jnp.where(falls, upper, record.upper),
            x=jnp.where(falls, x, record.x),
            y=jnp.where(rises, iterate.y, record.y),
            z=jnp.where(rises, iterate.z, record.z),
            tangent=jnp.where(rises, iterate.x, record.tangent),
        )

    def proven(self, record: ArrowRecord) -> jax.Array:
        """Compute the lower bound that the multipliers and the objective's tangent prove, (*lanes), as in `assess`."""
        slope = self.gradient(record.tangent) + self.adjoint(record.z) + self.pull_back(record.y)
        sides = _total(self.h * record.z) + fold(jnp.add, fold(jnp.add, record.y * self.rhs))
        return -self.objective(record.tangent) - sides - _total(jnp.abs(slope))

    def lagrangian(self, record: ArrowRecord) -> jax.Array:
        """Compute f + z'(A x - h) + y'(E x - b): its derivative is that of the optimum (envelope theorem)."""
        rows = self.apply(record.x) - self.h
        equalities = fold(jnp.add, fold(jnp.add, record.y * (self.equality(record.x) - self.rhs)))
        return self.objective(record.x) + _total(record.z * rows) + equalities


def build_rows(facets: np.ndarray, dtype: jnp.dtype, axes: int) -> tuple[jax.Array, jax.Array]:
    """Build the rows A x <= h of friction facets and of a bound on the pushing force.

    Args:
        facets: (m - 1, k), the facets' normals.
        dtype: precision.
        axes: how many axes follow the rows.

    Returns:
        A, (m, k), and h, (m, *1).
    """
    bound = np.array([[0.0, 0.0, -1.0, 0.0][: facets.shape[1]]])
    rows = literal(np.concatenate([facets, bound]), dtype)
    return rows, literal(np.array([0.0] * len(facets) + [1.0]), dtype).reshape(-1, *[1] * axes)


def _pairs(k: int) -> list[tuple[int, int]]:
    """The entries of a symmetric k x k matrix that `small_cholesky` takes."""
    return [(a, b) for a in range(k) for b in range(a + 1)]


def _symmetric(entries: list[jax.Array]) -> jax.Array:
    """Build symmetric blocks (k, k, ...) of their entries `_pairs`."""
    k = round((2 * len(entries)) ** 0.5 - 0.5)
    full = [entries[_pairs(k).index((max(a, b), min(a, b)))] for a in range(k) for b in range(k)]
    return jnp.stack(full).reshape(k, k, *full[0].shape)


def _times(matrix: jax.Array, x: jax.Array) -> jax.Array:
    """Multiply blocks, (k, k, n, ...), or full matrices, (k n, k n, ...), by x (k, n, ...)."""
    if matrix.ndim > x.ndim:
        return matvec(matrix, x)
    return unflatten(matvec(matrix, flatten(x)), len(x))


def _solve_copies(factors: SmallFactor | jax.Array, rhs: jax.Array) -> jax.Array:
    """Compute P_j^-1 rhs, (k, n, J, *lanes), with factors of blocks or of dense matrices."""
    if isinstance(factors, SmallFactor):
        return solve_small(factors, rhs)
    return unflatten(matvec_transposed(factors, matvec(factors, flatten(rhs))), len(rhs))


def _sum_copies(x: jax.Array, axis: int = 2) -> jax.Array:
    """Sum over copies, which stay as an axis of length one."""
    return jnp.sum(x, axis, keepdims=True)


def _total(x: jax.Array) -> jax.Array:
    """Sum over all but the lanes, (r, n, copies, *lanes)."""
    return jnp.sum(x, (0, 1, 2))
