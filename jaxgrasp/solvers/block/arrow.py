"""A quadratic program whose copies of small blocks meet in one of them: the form of (11).

    min 1/2 x_0' H_0 x_0 + sum_j 1/2 (x_j - x_0)' H (x_j - x_0)   over x_0, x_1 .. x_J, blocks of three each, with
    A x_ji <= h   and   sum_i E_i x_ji = b_j.

The Newton matrix is an arrow: given x_0, the copies have nothing to do with each other. Their blocks are eliminated,
then their equalities, then x_0, so a step costs O(J (n + n^2) + n^3); a dense factorisation would cost O(J^3 n^3).

Callers scale: |x|_inf <= 1 at admissible points, rows of E orthonormal or zero, entries of H at most 1.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import fold, literal
from jaxgrasp.lanes.fence import fenced, repeat
from jaxgrasp.solvers.interior_point import Iterate, Residuals
from jaxgrasp.solvers.small_matrices import (
    cholesky_3x3,
    inverse_cholesky,
    matvec,
    matvec_transposed,
    solve_3x3,
    spread_over,
    sum_over_blocks,
)


class ArrowRecord(NamedTuple):
    """Best bounds so far, certified, and the points that give them: x one of them, (y, z) with `tangent` the other."""

    lower: jax.Array
    upper: jax.Array
    x: jax.Array
    y: jax.Array
    z: jax.Array
    tangent: jax.Array


class _Factors(NamedTuple):
    lower: list[jax.Array]  # of the blocks of all copies, (n, J, *lanes)
    follow: jax.Array  # (3, 3, n, J, *lanes), how x_j follows x_0 while its equalities are free
    roots: jax.Array  # (eq, eq, J, *lanes), inverse Cholesky factors of the copies' equalities
    reach: jax.Array  # (eq, 3, n, J, *lanes), roots E follow
    hub: jax.Array  # (3 n, 3 n, *lanes), the same of what is left for x_0
    hub_root: jax.Array  # (eq, eq, *lanes), and of its equalities
    hub_columns: jax.Array  # (eq, 3 n, *lanes), E hub'
    weights: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ArrowProblem:
    """The program for `interior_point.solve`; x is (3, n, J + 1, *lanes), x_0 last, rows (m, n, J + 1, *lanes)."""

    patterns: jax.Array
    """(m, 3), A."""
    h: jax.Array
    """(m, 1, 1, *1)."""
    columns: jax.Array
    """(eq, 3, n, 1, *lanes), E; zero where dropped or absent."""
    rhs: jax.Array
    """(eq, J + 1, *lanes), b_j."""
    dropped: jax.Array
    """(eq, 1, *lanes), 1 for equality rows that are zero."""
    own: jax.Array
    """(3, 3, n, 1, *lanes), blocks of H_0."""
    change: jax.Array
    """(3, 3, n, 1, *lanes), blocks of H."""
    guess: jax.Array
    """(3, n, J + 1, *lanes), where to start: inside the rows, if possible."""

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the trailing axes."""
        return self.rhs.shape[2:]

    @property
    def present(self) -> jax.Array:
        """Every row counts."""
        return jnp.ones((1,) * self.guess.ndim, self.rhs.dtype)

    @property
    def predictor(self) -> Self:
        """Nothing is refined."""
        return self

    def apply(self, x: jax.Array) -> jax.Array:
        """A x."""
        return matvec_transposed(spread_over(self.patterns.T, x), x)

    def adjoint(self, z: jax.Array) -> jax.Array:
        """A'z."""
        return matvec_transposed(spread_over(self.patterns, z), z)

    def equality(self, x: jax.Array) -> jax.Array:
        """E x, (eq, copies, *lanes)."""
        return sum_over_blocks(self.columns * x)

    def pull_back(self, y: jax.Array) -> jax.Array:
        """E'y."""
        return fold(jnp.add, self.columns * y[:, None, None])

    def project(self, x: jax.Array) -> jax.Array:
        """The nearest point with E x = b."""
        return x + self.pull_back(self.rhs - self.equality(x))

    def gradient(self, x: jax.Array) -> jax.Array:
        """Of the objective."""
        moved = matvec(self.change, x[:, :, :-1] - x[:, :, -1:])
        rest = matvec(self.own, x[:, :, -1:]) - _copies(moved)
        return jnp.concatenate([moved, rest], 2)

    def objective(self, x: jax.Array) -> jax.Array:
        """Of x, (*lanes)."""
        moved = x[:, :, :-1] - x[:, :, -1:]
        return 0.5 * (
            _total(moved * matvec(self.change, moved)) + _total(x[:, :, -1:] * matvec(self.own, x[:, :, -1:]))
        )

    def start(self) -> Iterate:
        """From the guess, with slacks of at least 0.03 and multipliers on the central path."""
        x = self.project(self.guess)
        s = jnp.maximum(self.h - self.apply(x), 0.03)
        z = 0.02 / s
        return Iterate(x, -self.equality(self.gradient(x) + self.adjoint(z)), s, z)

    def residuals(self, iterate: Iterate) -> Residuals:
        """Of stationarity, of E x = b and of the rows."""
        dual = self.gradient(iterate.x) + self.adjoint(iterate.z) + self.pull_back(iterate.y)
        return Residuals(dual, self.equality(iterate.x) - self.rhs, self.apply(iterate.x) + iterate.s - self.h)

    def factor(self, weights: jax.Array) -> _Factors:
        """Eliminate the copies' blocks, their equalities, then x_0."""
        eq, _, n = self.columns.shape[:3]

        @fenced
        def blocks(weights: jax.Array) -> tuple:
            pairs = [(a, b) for a in range(3) for b in range(a + 1)]
            grams = [
                fold(jnp.add, spread_over(self.patterns[:, a] * self.patterns[:, b], weights) * weights)
                for a, b in pairs
            ]
            lower = cholesky_3x3([g[:, :-1] + self.change[a, b] for g, (a, b) in zip(grams, pairs, strict=True)])
            follow = jnp.stack([solve_3x3(lower, self.change[:, b]) for b in range(3)], 1)
            solved = jnp.stack([solve_3x3(lower, self.columns[r]) for r in range(eq)])
            matrix = jnp.stack([sum_over_blocks(self.columns * solved[r]) for r in range(eq)])
            across = fold(jnp.add, jnp.moveaxis(self.columns[:, :, None] * follow, 1, 0))
            full = [grams[pairs.index((max(a, b), min(a, b)))] for a in range(3) for b in range(3)]
            hub = jnp.stack(full).reshape(3, 3, *full[0].shape)[:, :, :, -1:] + self.own
            # H - H (H + A'WA)^-1 H of every copy.
            lost = self.change - fold(jnp.add, jnp.moveaxis(self.change[:, :, None] * follow[None], 1, 0))
            return lower, follow, matrix, across, (hub + _copies(lost, 3))[:, :, :, 0]

        lower, follow, matrix, across, hub = blocks(weights)
        eye = jnp.eye(eq, dtype=weights.dtype).reshape(eq, eq, *[1] * (self.rhs.ndim - 1))
        roots = inverse_cholesky(matrix + eye * self.dropped)

        @fenced
        def couple(roots: jax.Array, across: jax.Array, hub: jax.Array) -> tuple:
            reach = jnp.stack([fold(jnp.add, root[:, None, None] * across) for root in roots])
            flat = jnp.swapaxes(reach, 1, 2).reshape(eq, 3 * n, -1, *self.lanes)
            whole = jnp.einsum("epj...,eqj...->pq...", flat, flat)
            blocks = jnp.einsum("abi...,ik->iakb...", hub, jnp.eye(n, dtype=hub.dtype))
            return reach, whole + blocks.reshape(3 * n, 3 * n, *self.lanes)

        reach, whole = couple(roots, across, hub)
        inverse = inverse_cholesky(whole)

        @fenced
        def tie(inverse: jax.Array) -> tuple:
            columns = jnp.swapaxes(self.columns[:, :, :, 0], 1, 2).reshape(eq, 3 * n, *self.lanes)
            turned = jnp.einsum("ep...,qp...->eq...", columns, inverse)
            return turned, jnp.einsum("ep...,fp...->ef...", turned, turned)

        turned, tied = tie(inverse)
        return _Factors(
            lower,
            follow,
            roots,
            reach,
            inverse,
            inverse_cholesky(tied + eye[..., 0, :] * self.dropped[:, 0]),
            turned,
            weights,
        )

    def solve(self, factors: _Factors, residuals: Residuals, shift: jax.Array) -> tuple:
        """See `interior_point.Problem`."""
        n = self.columns.shape[2]

        @fenced
        def newton(rhs: jax.Array, rhs_y: jax.Array) -> tuple:
            first = solve_3x3(factors.lower, rhs[:, :, :-1])
            lacking = matvec(factors.roots, self.equality(first) - rhs_y[:, :-1])
            push = fold(jnp.add, factors.reach * lacking[:, None, None])
            # H (P^-1 r - P^-1 E' M^-1 (..)), the second term by the transpose of `reach`.
            right = rhs[:, :, -1:] + _copies(matvec(self.change, first) - push)
            flat = jnp.swapaxes(right[:, :, 0], 0, 1).reshape(3 * n, *self.lanes)
            half = matvec(factors.hub, flat)
            y = matvec(
                factors.hub_root, fold(jnp.add, jnp.swapaxes(factors.hub_columns, 0, 1) * half[:, None]) - rhs_y[:, -1]
            )
            y = matvec_transposed(factors.hub_root, y)
            rest = matvec_transposed(factors.hub, half - fold(jnp.add, factors.hub_columns * y[:, None]))
            rest = jnp.swapaxes(rest.reshape(n, 3, *self.lanes), 0, 1)[:, :, None]
            moved = lacking + sum_over_blocks(factors.reach * rest)
            own_y = matvec_transposed(factors.roots, moved)
            own = first + matvec(factors.follow, rest) - solve_3x3(factors.lower, self.pull_back(own_y))
            return jnp.concatenate([own, rest], 2), jnp.concatenate([own_y, y[:, None]], 1)

        def improve(_: jax.Array, state: tuple) -> tuple:
            dx, dy, rows = state
            rhs = (
                -residuals.dual - self.adjoint(shift + factors.weights * rows) - self.gradient(dx) - self.pull_back(dy)
            )
            more_x, more_y = newton(rhs, -residuals.primal - self.equality(dx))
            return dx + more_x, dy + more_y, self.apply(dx + more_x)

        return repeat(1, improve, jax.tree.map(jnp.zeros_like, (residuals.dual, residuals.primal, residuals.rows)))

    def first_record(self) -> ArrowRecord:
        """Nothing is known."""
        inf = jnp.full(self.lanes, jnp.inf, self.rhs.dtype)
        rows = jnp.zeros((self.patterns.shape[0], *self.guess.shape[1:]), self.rhs.dtype)
        return ArrowRecord(-inf, inf, jnp.zeros_like(self.guess), jnp.zeros_like(self.rhs), rows, self.guess)

    def gap_scale(self, record: ArrowRecord) -> jax.Array:
        """The effort, but not less than a thousandth of a unit."""
        return jnp.maximum(jnp.where(jnp.isinf(record.upper), 0, record.upper), 1e-3)

    def assess(self, iterate: Iterate, residuals: Residuals, record: ArrowRecord) -> ArrowRecord:
        """Both bounds; what a point misses the rows by is charged at the rows' multipliers."""
        x = self.project(iterate.x)
        over = jnp.maximum(self.apply(x) - self.h, 0)
        missed = fold(jnp.maximum, fold(jnp.maximum, fold(jnp.maximum, over)))
        near = 1e-9 if self.rhs.dtype == jnp.float64 else 2e-6
        upper = jnp.where(missed <= near, self.objective(x) + _total(over * iterate.z), jnp.inf)
        held = _total(self.h * iterate.z) + fold(jnp.add, fold(jnp.add, iterate.y * self.rhs))
        lower = -self.objective(iterate.x) - held - _total(jnp.abs(residuals.dual))
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
        """What the multipliers prove about the least objective, by its tangent, (*lanes)."""
        slope = self.gradient(record.tangent) + self.adjoint(record.z) + self.pull_back(record.y)
        held = _total(self.h * record.z) + fold(jnp.add, fold(jnp.add, record.y * self.rhs))
        return -self.objective(record.tangent) - held - _total(jnp.abs(slope))

    def lagrangian(self, record: ArrowRecord) -> jax.Array:
        """Objective and what is lacking, weighed by the multipliers: its derivative is the optimum's (envelope)."""
        rows = self.apply(record.x) - self.h
        lacking = fold(jnp.add, fold(jnp.add, record.y * (self.equality(record.x) - self.rhs)))
        return self.objective(record.x) + _total(record.z * rows) + lacking


def patterns_of(facets: np.ndarray, dtype: jnp.dtype, axes: int) -> tuple[jax.Array, jax.Array]:
    """The rows A of facets and of a bound on what pushes, and their right-hand sides."""
    rows = literal(np.concatenate([facets, [[0.0, 0.0, -1.0]]]), dtype)
    return rows, literal(np.array([0.0] * len(facets) + [1.0]), dtype).reshape(-1, *[1] * axes)


def _copies(x: jax.Array, axis: int = 2) -> jax.Array:
    """Sum over copies, which stay as an axis of length one."""
    return jnp.sum(x, axis, keepdims=True)


def _total(x: jax.Array) -> jax.Array:
    """Sum over all but the lanes, (r, n, copies, *lanes)."""
    return jnp.sum(x, (0, 1, 2))
