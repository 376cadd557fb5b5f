"""Programs of small blocks with constant row patterns, tied by a few equalities and one border column.

With blocks x_i (three forces of a contact, or one bounded actuator effort), a scalar lambda and rows

    A x_i + sigma_i lambda <= h_i      for every block i,
    sum_i E_i x_i = b                  (a static number of equality rows),

`margin_problem` maximises lambda, `effort_problem` minimises 1/2 sum x_i' H_i x_i with lambda held. The rows A are the
same for every block of a group, so they are never stored. The Newton system is reduced block by block (k x k), then
lambda, then the equality rows: the cost is linear in the number of blocks.

Both certify their answers at every step. Any x with E x = b attains lambda_lo = min (h - A x) / sigma. Any z >= 0
scaled to sum sigma z = 1 proves lambda* <= h'z + b'y + radius |A'z + E'y|_1; radius bounds |x|_inf at the optimum.

Callers scale: |x| about 1 at most, sigma <= 1, the rows of E orthonormal or zero.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import each, fenced
from jaxgrasp.solvers.interior_point import Iterate, Residuals
from jaxgrasp.solvers.small_matrices import inverse_cholesky, matvec_transposed, spread_over

Rows = tuple[jax.Array, ...]


class Blocks(NamedTuple):
    """A group of n blocks of k unknowns, each with the same m rows A; lanes trail.

    patterns: (m, k), the rows A; the last one opposes the sum of the others, so that positive multipliers balance.
    columns: (eq, k, n, *lanes), E_i; zero where a block is absent.
    sigma: (m, n, *lanes), the border column, >= 0; zero where absent.
    h: (m, n, *lanes), right-hand sides; one where absent.
    present: (n, *lanes), 1 or 0.
    hessian_root: (k, k, n, *lanes), a root of H_i (H_i = root' root), for `EffortProblem`.
    start: (k,), where the unknowns of a block start.
    """

    patterns: jax.Array
    columns: jax.Array
    sigma: jax.Array
    h: jax.Array
    present: jax.Array
    hessian_root: jax.Array | None
    start: jax.Array

    @property
    def root(self) -> jax.Array:
        """`hessian_root`, of blocks that have one."""
        assert self.hessian_root is not None
        return self.hessian_root


class Record(NamedTuple):
    """Best bounds so far, certified, and the points that give them: x one of them, (y, z) the other."""

    lower: jax.Array
    upper: jax.Array
    x: Rows
    y: jax.Array
    z: Rows


class _BlockFactor(NamedTuple):
    """L with L L' = P = A'WA (+ H) and what is solved with it; lists run over the k unknowns."""

    below: list[jax.Array]  # L10, L20, L21, each (n, *lanes)
    inverse: list[jax.Array]  # 1 / diag(L)
    columns: list[jax.Array]  # L^-1 E', each (eq, n, *lanes)
    theta: list[jax.Array]  # L^-1 p, p = A'W sigma
    lean: jax.Array | None  # (n, *lanes), what of sigma'W sigma the unknowns of the block cannot make up for


class _Border(NamedTuple):
    """What a free lambda adds to the reduced Newton system."""

    inverse: jax.Array  # inverse pivot of lambda
    column: jax.Array  # (eq, *lanes), lambda's column in the equality rows


class Factors(NamedTuple):
    """The reduced Newton system; `border` is None where lambda is held."""

    blocks: list[_BlockFactor]
    root: jax.Array  # (eq, eq, *lanes), inverse Cholesky factor of the equality rows' matrix
    weights: Rows
    border: _Border | None


def apply_rows(group: Blocks, x: jax.Array) -> jax.Array:
    """A x: (k, n, *lanes) -> (m, n, *lanes)."""
    return matvec_transposed(spread_over(group.patterns.T, x), x)


def adjoint_rows(group: Blocks, z: jax.Array) -> jax.Array:
    """A'z: (m, n, *lanes) -> (k, n, *lanes)."""
    return matvec_transposed(spread_over(group.patterns, z), z)


def apply_hessian(group: Blocks, x: jax.Array) -> jax.Array:
    """H x = root' root x, (k, n, *lanes)."""
    half = fold(jnp.add, jnp.moveaxis(group.root * x, 1, 0))
    return fold(jnp.add, group.root * half[:, None])


def total(x: jax.Array) -> jax.Array:
    """Sum over rows and blocks, (m, n, *lanes) -> (*lanes), unrolled: XLA's CPU code then runs along the lanes."""
    return fold(jnp.add, fold(jnp.add, x))


def _over_blocks(x: jax.Array, axis: int) -> jax.Array:
    """Sum over the axis of blocks."""
    return fold(jnp.add, jnp.moveaxis(x, axis, 0))


def least(x: jax.Array) -> jax.Array:
    """Smallest over rows and blocks."""
    return fold(jnp.minimum, fold(jnp.minimum, x))


def _substitute_down(below: list[jax.Array], inverse: list[jax.Array], rhs: list[jax.Array]) -> list[jax.Array]:
    """L^-1 rhs for k <= 3, lists over the unknowns."""
    out: list[jax.Array] = []
    for i, entry in enumerate(rhs):
        for j in range(i):
            entry = entry - below[i * (i - 1) // 2 + j] * out[j]
        out.append(entry * inverse[i])
    return out


def _substitute_up(below: list[jax.Array], inverse: list[jax.Array], rhs: list[jax.Array]) -> list[jax.Array]:
    """L^-T rhs."""
    out = list(rhs)
    for i in reversed(range(len(rhs))):
        for j in range(i + 1, len(rhs)):
            out[i] = out[i] - below[j * (j - 1) // 2 + i] * out[j]
        out[i] = out[i] * inverse[i]
    return out


@dataclass(frozen=True)
class BlockProblem(ABC):
    """What both programs share.

    groups: the blocks.
    rhs: (eq, *lanes), b; zero in rows that are zero in E.
    dropped: (eq, *lanes), 1 for the equality rows that are zero, else 0.
    radius: how |x|_inf at the optimum grows with a negative lambda: at most 1 + radius * max(0, -lambda).
    refinements: steps of iterative refinement of every Newton direction.
    """

    groups: tuple[Blocks, ...]
    rhs: jax.Array
    dropped: jax.Array
    radius: float = field(metadata={"static": True})
    refinements: int = field(metadata={"static": True})
    bordered = True

    @property
    def lanes(self) -> tuple[int, ...]:
        """Shape of the trailing axes."""
        return self.rhs.shape[1:]

    @property
    def present(self) -> Rows:
        """1 where a block is there."""
        return tuple(g.present for g in self.groups)

    @property
    def predictor(self) -> Self:
        """Without refinement, which changes neither the steps that are taken nor what they end at."""
        return replace(self, refinements=0)

    @abstractmethod
    def residuals(self, iterate: Iterate) -> Residuals:
        """See `interior_point.Problem`."""

    @abstractmethod
    def solve(self, factors: Factors, residuals: Residuals, shift: Rows) -> tuple[Any, jax.Array, Rows]:
        """See `interior_point.Problem`; dx is like the problem's own x."""

    def equality(self, x: Rows) -> jax.Array:
        """E x, (eq, *lanes)."""
        products = [g.columns * x_g for g, x_g in zip(self.groups, x, strict=True)]
        return fold(jnp.add, [total(jnp.moveaxis(p, 0, 2)) for p in products])

    def pull_back(self, y: jax.Array) -> Rows:
        """E'y, (k, n, *lanes) a group."""
        return tuple(fold(jnp.add, g.columns * y[:, None, None]) for g in self.groups)

    def project(self, x: Rows) -> Rows:
        """The nearest point with E x = b, for orthonormal rows."""
        gap = fenced(lambda x: self.rhs - self.equality(x))(x)
        return tuple(x_g + c for x_g, c in zip(x, self.pull_back(gap), strict=True))

    def violations(self, x: Rows, lam: jax.Array) -> jax.Array:
        """Largest amount by which any row is missed, (*lanes)."""
        missed = fold(jnp.maximum, jnp.abs(self.equality(x) - self.rhs))
        for g, x_g in zip(self.groups, x, strict=True):
            missed = jnp.maximum(missed, -least(g.h - apply_rows(g, x_g) - g.sigma * lam))
        return missed

    def first_multipliers(self) -> tuple[jax.Array, Rows]:
        """Nothing, for a record."""
        return jnp.zeros_like(self.rhs), tuple(jnp.zeros_like(g.sigma) for g in self.groups)

    def factor(self, weights: Rows) -> Factors:
        """Eliminate blocks, then lambda."""
        blocks = [self._factor_block(g, w) for g, w in zip(self.groups, weights, strict=True)]

        @fenced
        def reduce(blocks: list[_BlockFactor]) -> tuple:
            columns = [f.columns for f in blocks]

            def row(r: jax.Array) -> jax.Array:
                return fold(jnp.add, [_over_blocks(c[r] * c, 1) for each_k in columns for c in each_k])

            matrix = each(row, jnp.arange(self.rhs.shape[0]))
            if not self.bordered:
                return matrix, None, None
            sides = [_over_blocks(c * -t, 1) for f in blocks for c, t in zip(f.columns, f.theta, strict=True)]
            # A sum of squares: sigma'W sigma - p'P^-1 p would cancel near the optimum.
            kappa = fold(jnp.add, [fold(jnp.add, f.lean) for f in blocks if f.lean is not None])
            return matrix, fold(jnp.add, sides), 1 / jnp.maximum(kappa, jnp.finfo(kappa.dtype).tiny)

        @fenced
        def complete(matrix: jax.Array, v: jax.Array | None, inverse: jax.Array | None) -> jax.Array:
            eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype).reshape(*matrix.shape[:2], *[1] * len(self.lanes))
            matrix = matrix + eye * self.dropped
            return matrix if v is None or inverse is None else matrix + v[:, None] * (v * inverse)

        matrix, v, inverse = reduce(blocks)
        border = _Border(inverse, v) if self.bordered else None
        return Factors(blocks, inverse_cholesky(complete(matrix, v, inverse)), weights, border)

    def _factor_block(self, g: Blocks, weights: jax.Array) -> _BlockFactor:
        """Orthogonalise [A, sigma] column by column, in the inner product that the weights give.

        A'WA itself would square its condition, too much for float32.
        """
        k = g.patterns.shape[1]
        columns = [jnp.broadcast_to(spread_over(g.patterns[:, a], weights), weights.shape) for a in range(k)]
        if g.hessian_root is not None:
            columns = [jnp.concatenate([c, g.hessian_root[:, a]]) for a, c in enumerate(columns)]
            weights = jnp.concatenate([weights, jnp.ones_like(g.hessian_root[:, 0])])
        if self.bordered:
            columns.append(g.sigma)

        @fenced
        def share(weights: jax.Array, column: jax.Array, others: list[jax.Array]) -> tuple:
            pulled = weights * column
            square = fold(jnp.add, pulled * column)
            inverse = jax.lax.rsqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny) + (1 - g.present))
            return inverse, [fold(jnp.add, pulled * other) * inverse for other in others]

        @fenced
        def remove(column: jax.Array, inverse: jax.Array, others: list[jax.Array], shares: list[jax.Array]) -> list:
            unit = column * inverse
            return [other - part * unit for other, part in zip(others, shares, strict=True)]

        inverse, shares = [], []
        for _ in range(k):
            column, *others = columns
            own, parts = share(weights, column, others)
            columns = remove(column, own, others, parts)
            inverse.append(own)
            shares.append(parts)
        below = [shares[j][i - j - 1] for i in range(k) for j in range(i)]
        theta = [parts[-1] for parts in shares] if self.bordered else []
        lean = fenced(lambda w, c: fold(jnp.add, w * c * c))(weights, columns[0]) if self.bordered else None
        reduced = fenced(lambda below, inverse: _substitute_down(below, inverse, [g.columns[:, a] for a in range(k)]))
        return _BlockFactor(below, inverse, reduced(below, inverse), theta, lean)

    def newton(self, factors: Factors, rhs_x: Rows, rhs_lambda: jax.Array | None, rhs_y: jax.Array) -> tuple:
        """Solve [P p E'; p' hll 0; E 0 0] (dx, dlambda, dy) = (rhs_x, rhs_lambda, rhs_y).

        rhs_lambda and dlambda are None where lambda is held.
        """

        @fenced
        def eliminate(factors: Factors, rhs_x: Rows, rhs_lambda: jax.Array | None, rhs_y: jax.Array) -> tuple:
            reduced = [
                _substitute_down(f.below, f.inverse, list(r)) for f, r in zip(factors.blocks, rhs_x, strict=True)
            ]
            pairs = [
                (c, t, a)
                for f, r in zip(factors.blocks, reduced, strict=True)
                for c, t, a in zip(f.columns, f.theta or f.inverse, r, strict=True)
            ]
            right = fold(jnp.add, [_over_blocks(c * a, 1) for c, _, a in pairs]) - rhs_y
            if rhs_lambda is None:
                return reduced, right, None
            return reduced, right, rhs_lambda - fold(jnp.add, [fold(jnp.add, t * a) for _, t, a in pairs])

        @fenced
        def solve_equalities(factors: Factors, right: jax.Array, pull: jax.Array | None) -> jax.Array:
            if factors.border is not None and pull is not None:
                right = right + factors.border.column * (pull * factors.border.inverse)
            return fold(jnp.add, jnp.moveaxis(factors.root * right, 1, 0))

        @fenced
        def finish_equalities(factors: Factors, half: jax.Array, pull: jax.Array | None) -> tuple:
            dy = fold(jnp.add, factors.root * half[:, None])
            if factors.border is None or pull is None:
                return dy, None
            return dy, (pull - fold(jnp.add, factors.border.column * dy)) * factors.border.inverse

        @fenced
        def substitute(factors: Factors, reduced: list, dy: jax.Array, dlambda: jax.Array | None) -> Rows:
            out = []
            for f, r in zip(factors.blocks, reduced, strict=True):
                left = [a - fold(jnp.add, c * dy[:, None]) for c, a in zip(f.columns, r, strict=True)]
                if dlambda is not None:
                    left = [a - t * dlambda for a, t in zip(left, f.theta, strict=True)]
                out.append(jnp.stack(_substitute_up(f.below, f.inverse, left)))
            return tuple(out)

        reduced, right, pull = eliminate(factors, rhs_x, rhs_lambda, rhs_y)
        dy, dlambda = finish_equalities(factors, solve_equalities(factors, right, pull), pull)
        return substitute(factors, reduced, dy, dlambda), dlambda, dy
