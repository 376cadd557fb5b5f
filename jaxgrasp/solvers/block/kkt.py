"""Programs of small blocks with constant row patterns, tied by a few equalities and one border column.

With blocks x_i (three or four forces of a contact, or one bounded actuator effort), a scalar lambda and rows

    A x_i + sigma_i lambda <= h_i      for every block i,
    sum_i E_i x_i = b                  (a static number of equality rows),

`margin` maximises lambda, `effort` minimises 1/2 sum x_i' H_i x_i with lambda held. All blocks of a group have the same
rows A, so that a group stores them once.

With the weights W = Z/S of the rows, A and sigma over all blocks, and dz = e + W (A dx + sigma dlambda), a step solves

    [ P   p              E' ] [dx     ]   [ r_x      ]
    [ p'  sigma'W sigma  0  ] [dlambda] = [ r_lambda ]        P = A'W A + H,    p = A'W sigma.
    [ E   0              0  ] [dy     ]   [ r_y      ]

P is made of k x k blocks. Eliminating them and then lambda leaves, with v = -E P^-1 p, the equality rows:

    dx = P^-1 (r_x - p dlambda - E'dy),
    kappa dlambda = r_lambda - p'P^-1 r_x - v'dy,    kappa = sigma'W sigma - p'P^-1 p,
    (E P^-1 E' + v v'/kappa) dy = E P^-1 r_x - r_y + v (r_lambda - p'P^-1 r_x) / kappa,

at a cost that is linear in the number of blocks. Near an optimum W goes to infinity in active rows and to 0 in the
others. Forming A'W A would square the condition of W^1/2 A, and kappa as a difference would cancel. So the columns of
W^1/2 [A, sigma] (with a root of H below A) are made orthogonal instead: the coefficients are L, with L L' = P, and
theta = L^-1 p, and the square of what remains of the last column is kappa.

Where H ties the blocks of a group together (`effort` alone), the roots L_i' of their A'W A stand above the root of H,
and the columns of all of it are made orthogonal: P is then dense, and its cost cubic in the number of blocks.

Both programs certify their results at every step. Any x with E x = b attains lambda_lo = min (h - A x) / sigma. Any
z >= 0 scaled to sum sigma z = 1 proves lambda* <= h'z + b'y + radius |A'z + E'y|_1; radius bounds |x|_inf at the
optimum.

Callers scale: |x| about 1 at most, sigma <= 1, the rows of E orthonormal or zero.

Sources: Wright (1997), "Primal-dual interior-point methods", chapter 11; Bjorck (1967), "Solving linear least squares
problems by Gram-Schmidt orthogonalization".
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import each, fenced
from jaxgrasp.solvers.block.factors import BlockFactor, Factor, couple, solve_lower, solve_upper
from jaxgrasp.solvers.block.joined import Joined
from jaxgrasp.solvers.interior_point import Iterate, Residuals
from jaxgrasp.solvers.small_matrices import (
    ColumnFactor,
    cholesky_by_columns,
    flatten,
    inverse_cholesky,
    matvec,
    matvec_transposed,
    spread_over,
    substitute_down,
    unflatten,
)

Rows = tuple[jax.Array, ...]


class Blocks(NamedTuple):
    """A group of n blocks of k <= 4 unknowns, each with the same m rows A; lanes trail.

    patterns: the rows A, (m, k); the last one, of the unknown `bounded` alone, opposes the sum of the others, so that
        positive multipliers balance.
    columns: E_i, (eq, k, n, *lanes); zero where a block is absent.
    sigma: the column of lambda, (m, n, *lanes), >= 0; zero where a block is absent.
    h: the right-hand sides, (m, n, *lanes); one where a block is absent.
    present: a mask of the blocks, (n, *lanes): 1 or 0.
    hessian_root: a root of H_i (H_i = root' root), (k, k, n, *lanes), for `EffortProblem`, or of an H that ties the
        blocks together, (k n, k n, *lanes) block by block, zero where a block is absent; None where H = 0.
    start: the unknowns of every block at the start, (k,).
    """

    patterns: jax.Array
    columns: jax.Array
    sigma: jax.Array
    h: jax.Array
    present: jax.Array
    hessian_root: jax.Array | None
    start: jax.Array

    @property
    def bounded(self) -> int:
        """The unknown that the last row bounds: the third, or the last of fewer."""
        return min(self.patterns.shape[1], 3) - 1

    @property
    def root(self) -> jax.Array:
        """The root of H of blocks that have one."""
        assert self.hessian_root is not None
        return self.hessian_root

    @property
    def coupled(self) -> bool:
        """Whether H ties the blocks together."""
        return self.hessian_root is not None and self.hessian_root.ndim < self.columns.ndim


class Record(NamedTuple):
    """The best certified bounds so far and the points that give them: x the attained one, (y, z) the proven one."""

    lower: jax.Array
    upper: jax.Array
    x: Rows
    y: jax.Array
    z: Rows


class _Border(NamedTuple):
    """The part of the reduced Newton system that a free lambda adds."""

    inverse: jax.Array  # (*lanes), 1 / kappa
    column: jax.Array  # (eq, *lanes), v


class Factors(NamedTuple):
    """The reduced Newton system; `border` is None where lambda is held."""

    blocks: list[Factor]
    # Of E P^-1 E' + v v'/kappa: the inverse Cholesky factor, (eq, eq, *lanes), or the factor of rows that are joined.
    root: jax.Array | ColumnFactor
    weights: Rows
    border: _Border | None


def apply_rows(group: Blocks, x: jax.Array) -> jax.Array:
    """Compute A x: (k, n, *lanes) -> (m, n, *lanes)."""
    return matvec_transposed(spread_over(group.patterns.T, x), x)


def adjoint_rows(group: Blocks, z: jax.Array) -> jax.Array:
    """Compute A'z: (m, n, *lanes) -> (k, n, *lanes)."""
    return matvec_transposed(spread_over(group.patterns, z), z)


def apply_hessian(group: Blocks, x: jax.Array) -> jax.Array:
    """Compute H x = root' (root x), (k, n, *lanes)."""
    if group.coupled:
        return unflatten(matvec_transposed(group.root, matvec(group.root, flatten(x))), len(x))
    product = fold(jnp.add, jnp.moveaxis(group.root * x, 1, 0))
    return matvec_transposed(group.root, product)


def total(x: jax.Array) -> jax.Array:
    """Sum over rows and blocks, (m, n, *lanes) -> (*lanes), unrolled: XLA's CPU code then runs along the lanes."""
    return fold(jnp.add, fold(jnp.add, x))


def _over_blocks(x: jax.Array, axis: int) -> jax.Array:
    """Sum over the axis of blocks, which is not the leading one."""
    return fold(jnp.add, jnp.moveaxis(x, axis, 0))


def least(x: jax.Array) -> jax.Array:
    """Find the smallest entry over rows and blocks, (m, n, *lanes) -> (*lanes)."""
    return fold(jnp.minimum, fold(jnp.minimum, x))


@dataclass(frozen=True)
class BlockProblem(ABC):
    """The constraints and the Newton system that both programs share.

    groups: the groups of blocks.
    rhs: the right-hand sides b, (eq, *lanes); zero in rows that are zero in E.
    dropped: a mask of the equality rows, (eq, *lanes): 1 for rows that are zero, else 0.
    radius: the growth of |x|_inf at the optimum with a negative lambda: at most 1 + radius * max(0, -lambda).
    refinements: the number of steps of iterative refinement of every Newton direction.
    joined: where the rows of E are not orthonormal, see `joined`; None where they are.
    bordered: whether lambda is an unknown (a constant of the class).
    """

    groups: tuple[Blocks, ...]
    rhs: jax.Array
    dropped: jax.Array
    radius: float = field(metadata={"static": True})
    refinements: int = field(metadata={"static": True})
    joined: Joined | None = field(default=None, metadata={"static": True})
    bordered = True

    @property
    def lanes(self) -> tuple[int, ...]:
        """The shape of the trailing axes."""
        return self.rhs.shape[1:]

    @property
    def present(self) -> Rows:
        """The mask of the blocks of every group: 1 where a block is present."""
        return tuple(g.present for g in self.groups)

    @property
    def predictor(self) -> Self:
        """The problem without refinement: its directions only set the centring, so the loop ends at the same points."""
        return replace(self, refinements=0)

    @abstractmethod
    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals of the optimality conditions."""

    @abstractmethod
    def solve(self, factors: Factors, residuals: Residuals, shift: Rows) -> tuple[Any, jax.Array, Rows]:
        """Solve the Newton system with dz = shift + weights * (A dx + sigma dlambda) for (dx, dy, change of the rows).

        Like x, dx includes dlambda where lambda is free.
        """

    def equality(self, x: Rows) -> jax.Array:
        """Compute E x, (eq, *lanes)."""
        if self.joined is not None:
            return self.joined.equality(self.groups, x)
        products = [g.columns * x_g for g, x_g in zip(self.groups, x, strict=True)]
        return fold(jnp.add, [total(jnp.moveaxis(p, 0, 2)) for p in products])

    def pull_back(self, y: jax.Array) -> Rows:
        """Compute E'y, (k, n, *lanes) a group."""
        if self.joined is not None:
            return self.joined.pull_back(self.groups, y)
        return tuple(fold(jnp.add, g.columns * y[:, None, None]) for g in self.groups)

    def project(self, x: Rows) -> Rows:
        """Find a point with E x = b near x."""
        gap = fenced(lambda x: self.rhs - self.equality(x))(x)
        return tuple(x_g + c for x_g, c in zip(x, self.restore(gap), strict=True))

    def restore(self, gap: jax.Array) -> Rows:
        """Find a change that closes a gap b - E x: where the rows of E are orthonormal the least one, E'(b - E x)."""
        return self.pull_back(gap) if self.joined is None else self.joined.restore(self.groups, gap)

    def balancing(self, pull: Rows) -> jax.Array:
        """Find the multipliers y with E'y = -pull, (eq, *lanes), if there are any."""
        return -(self.equality(pull) if self.joined is None else self.joined.multipliers(self.groups, pull))

    def violations(self, x: Rows, lam: jax.Array) -> jax.Array:
        """Compute the largest amount by which a point misses any row, (*lanes)."""
        violation = fold(jnp.maximum, jnp.abs(self.equality(x) - self.rhs))
        for g, x_g in zip(self.groups, x, strict=True):
            violation = jnp.maximum(violation, -least(g.h - apply_rows(g, x_g) - g.sigma * lam))
        return violation

    def first_multipliers(self) -> tuple[jax.Array, Rows]:
        """Make the multipliers y and z of the record before the first step: zeros."""
        return jnp.zeros_like(self.rhs), tuple(jnp.zeros_like(g.sigma) for g in self.groups)

    def factor(self, weights: Rows) -> Factors:
        """Factor the Newton system for weights z/s: eliminate the blocks, then lambda."""
        if (joined := self._in_turn) is not None:
            blocks, matrix, v, kappa = joined.eliminate(self, weights)
        else:
            # Blocks: L L' = P, with theta = L^-1 p and L^-1 E'.
            blocks = [self._factor_group(g, w) for g, w in zip(self.groups, weights, strict=True)]
            matrix, v, kappa = self._reduce(blocks)
        inverse = None if kappa is None else 1 / jnp.maximum(kappa, jnp.finfo(kappa.dtype).tiny)

        # Eliminate lambda: E P^-1 E' + v v'/kappa, with ones on the diagonal of dropped rows.
        @fenced
        def complete(matrix: jax.Array, v: jax.Array | None, inverse: jax.Array | None) -> jax.Array:
            eye = jnp.eye(matrix.shape[0], dtype=matrix.dtype).reshape(*matrix.shape[:2], *[1] * len(self.lanes))
            matrix = matrix + eye * self.dropped
            return matrix if v is None or inverse is None else matrix + v[:, None] * (v * inverse)

        border = None if inverse is None or v is None else _Border(inverse, v)
        matrix = complete(matrix, v, inverse)
        root = inverse_cholesky(matrix) if self.joined is None else cholesky_by_columns(matrix)
        return Factors(blocks, root, weights, border)

    def _reduce(self, blocks: list[Factor]) -> tuple:
        """Compute E P^-1 E', v = -E P^-1 p and kappa; the last two are None where lambda is held."""

        @fenced
        def reduce(blocks: list[Factor]) -> tuple:
            columns = [f.columns for f in blocks]

            def row(r: jax.Array) -> jax.Array:
                return fold(jnp.add, [_over_blocks(c[r] * c, 1) for each_k in columns for c in each_k])

            matrix = each(row, jnp.arange(self.rhs.shape[0]))
            if not self.bordered:
                return matrix, None, None
            terms = [_over_blocks(c * -t, 1) for f in blocks for c, t in zip(f.columns, f.theta, strict=True)]
            kappa = fold(jnp.add, [fold(jnp.add, f.kappa) for f in blocks if f.kappa is not None])
            return matrix, fold(jnp.add, terms), kappa

        return reduce(blocks)

    @property
    def _in_turn(self) -> Joined | None:
        """The elimination of forces and efforts block by block; None eliminates all blocks at once."""
        return None if any(g.coupled for g in self.groups) else self.joined

    def _factor_group(self, g: Blocks, weights: jax.Array) -> Factor:
        if not g.coupled:
            return self.factor_block(g, weights)
        return couple(self.factor_block(g._replace(hessian_root=None), weights), g.root, g.columns)

    def factor_block(self, g: Blocks, weights: jax.Array) -> BlockFactor:
        """Make the columns of [A, sigma] orthogonal in the inner product of W, by modified Gram-Schmidt.

        P = A'W A itself would square the condition, too much for float32.
        """
        k = g.patterns.shape[1]
        columns = [jnp.broadcast_to(spread_over(g.patterns[:, a], weights), weights.shape) for a in range(k)]
        if g.hessian_root is not None:
            # A root of H below A gives P = A'W A + H.
            columns = [jnp.concatenate([c, g.hessian_root[:, a]]) for a, c in enumerate(columns)]
            weights = jnp.concatenate([weights, jnp.ones_like(g.hessian_root[:, 0])])
        if self.bordered:
            columns.append(g.sigma)

        @fenced
        def project(weights: jax.Array, column: jax.Array, others: list[jax.Array]) -> tuple:
            """Compute 1 / |column| and the components of the other columns along it: a column of L."""
            weighted = weights * column
            square = fold(jnp.add, weighted * column)
            inverse = jax.lax.rsqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny) + (1 - g.present))
            return inverse, [fold(jnp.add, weighted * other) * inverse for other in others]

        @fenced
        def remove(column: jax.Array, inverse: jax.Array, others: list[jax.Array], components: list[jax.Array]) -> list:
            unit = column * inverse
            return [other - component * unit for other, component in zip(others, components, strict=True)]

        inverse, components = [], []
        for _ in range(k):
            column, *others = columns
            inverse_length, along = project(weights, column, others)
            columns = remove(column, inverse_length, others, along)
            inverse.append(inverse_length)
            components.append(along)
        below = [components[j][i - j - 1] for i in range(k) for j in range(i)]
        theta = [along[-1] for along in components] if self.bordered else []
        # The remaining column is sigma's, and its square is kappa.
        kappa = fenced(lambda w, c: fold(jnp.add, w * c * c))(weights, columns[0]) if self.bordered else None
        reduced = fenced(lambda below, inverse: substitute_down(below, inverse, [g.columns[:, a] for a in range(k)]))
        return BlockFactor(below, inverse, reduced(below, inverse), theta, kappa)

    def newton(self, factors: Factors, rhs_x: Rows, rhs_lambda: jax.Array | None, rhs_y: jax.Array) -> tuple:
        """Solve the system of this module's docstring for (dx, dlambda, dy).

        Where lambda is held, rhs_lambda and dlambda are None.
        """

        # Eliminate the blocks: L^-1 r_x, E P^-1 r_x - r_y and r_lambda - p'P^-1 r_x.
        @fenced
        def eliminate(factors: Factors, rhs_x: Rows, rhs_lambda: jax.Array | None, rhs_y: jax.Array) -> tuple:
            if (joined := self._in_turn) is not None:
                reduced, right, pull = joined.reduce(self.groups, factors.blocks, rhs_x, rhs_lambda is not None)
                return reduced, right - rhs_y, None if rhs_lambda is None else rhs_lambda - pull
            reduced = [solve_lower(f, r) for f, r in zip(factors.blocks, rhs_x, strict=True)]
            pairs = [
                (c, t, a)
                for f, r in zip(factors.blocks, reduced, strict=True)
                for c, t, a in zip(f.columns, f.theta or f.columns, r, strict=True)
            ]
            right = fold(jnp.add, [_over_blocks(c * a, 1) for c, _, a in pairs]) - rhs_y
            if rhs_lambda is None:
                return reduced, right, None
            return reduced, right, rhs_lambda - fold(jnp.add, [fold(jnp.add, t * a) for _, t, a in pairs])

        # Eliminate lambda, and solve the equality rows for dy in two halves: root'(root right).
        @fenced
        def solve_equalities(factors: Factors, right: jax.Array, pull: jax.Array | None) -> jax.Array:
            if factors.border is not None and pull is not None:
                right = right + factors.border.column * (pull * factors.border.inverse)
            if isinstance(factors.root, ColumnFactor):
                return factors.root.down(right)
            return fold(jnp.add, jnp.moveaxis(factors.root * right, 1, 0))

        # Then dlambda = (r_lambda - p'P^-1 r_x - v'dy) / kappa.
        @fenced
        def finish_equalities(factors: Factors, root_right: jax.Array, pull: jax.Array | None) -> tuple:
            root = factors.root
            dy = root.up(root_right) if isinstance(root, ColumnFactor) else matvec_transposed(root, root_right)
            if factors.border is None or pull is None:
                return dy, None
            return dy, (pull - fold(jnp.add, factors.border.column * dy)) * factors.border.inverse

        # Substitute: dx = L^-T (L^-1 r_x - L^-1 E'dy - theta dlambda).
        @fenced
        def substitute(factors: Factors, reduced: list, dy: jax.Array, dlambda: jax.Array | None) -> Rows:
            if (joined := self._in_turn) is not None:
                return joined.substitute(self.groups, factors.blocks, reduced, dy, dlambda)
            out = []
            for g, f, r in zip(self.groups, factors.blocks, reduced, strict=True):
                right = [a - fold(jnp.add, c * dy[:, None]) for c, a in zip(f.columns, r, strict=True)]
                if dlambda is not None:
                    right = [a - t * dlambda for a, t in zip(right, f.theta, strict=True)]
                out.append(solve_upper(f, right, g.patterns.shape[1]))
            return tuple(out)

        reduced, right, pull = eliminate(factors, rhs_x, rhs_lambda, rhs_y)
        dy, dlambda = finish_equalities(factors, solve_equalities(factors, right, pull), pull)
        return substitute(factors, reduced, dy, dlambda), dlambda, dy
