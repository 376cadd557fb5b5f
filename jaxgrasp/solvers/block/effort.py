"""The program min 1/2 sum x_i' H_i x_i over blocks, or 1/2 x'H x over all of them, lambda held: the form of (22)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced, repeat
from jaxgrasp.solvers.block.kkt import (
    BlockProblem,
    Blocks,
    Factors,
    Record,
    Rows,
    adjoint_rows,
    apply_hessian,
    apply_rows,
    least,
    total,
)
from jaxgrasp.solvers.interior_point import Iterate, Residuals
from jaxgrasp.solvers.small_matrices import flatten, matvec, orthonormalise


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EffortProblem(BlockProblem):
    """The program min 1/2 sum x_i' H_i x_i with lambda held, so sigma plays no part.

    In its record, `x` attains `upper` and (y, z) certify `lower`. Callers scale H so that its entries are 1 at most;
    the blocks' bounds are |x|_inf <= 1.

    guess: a point to start from that nearly meets E x = b, well inside the rows if possible.
    curvature: like x, c >= 0 with H - diag(c) positive semidefinite, or K with K'K = H^-1 of a group whose blocks H
        ties together, see `curvature_of`.
    """

    guess: Rows = ()
    curvature: Rows = ()
    bordered = False

    def start(self) -> Iterate:
        """Start from the guess, with slacks of at least 0.03 and multipliers on the central path s z = 0.02."""
        blocks = self.project(self.guess)
        s = tuple(
            jnp.where(g.present > 0, jnp.maximum(g.h - apply_rows(g, x), 0.03), 1)
            for g, x in zip(self.groups, blocks, strict=True)
        )
        z = tuple(0.02 * g.present / s_g for g, s_g in zip(self.groups, s, strict=True))
        pull = tuple(
            apply_hessian(g, x) + adjoint_rows(g, z_g) for g, x, z_g in zip(self.groups, blocks, z, strict=True)
        )
        return Iterate(blocks, self.balancing(pull), s, z)

    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals of stationarity, of E x = b and of the rows."""
        blocks = iterate.x
        dual = tuple(
            apply_hessian(g, x) + adjoint_rows(g, z) + e
            for g, x, z, e in zip(self.groups, blocks, iterate.z, self.pull_back(iterate.y), strict=True)
        )
        rows = tuple(apply_rows(g, x) + s - g.h for g, x, s in zip(self.groups, blocks, iterate.s, strict=True))
        return Residuals(dual, self.equality(blocks) - self.rhs, rows)

    def solve(self, factors: Factors, residuals: Residuals, shift: Rows) -> tuple:
        """Solve the Newton system with dz = shift + weights * A dx for the directions (dx, dy, A dx)."""

        def improve(_: jax.Array, state: tuple) -> tuple:
            dx, dy, rows = state
            rhs = tuple(
                -d - adjoint_rows(g, e + w * r) - apply_hessian(g, x) - t
                for g, d, e, w, r, x, t in zip(
                    self.groups, residuals.dual, shift, factors.weights, rows, dx, self.pull_back(dy), strict=True
                )
            )
            more_x, _, more_y = self.newton(factors, rhs, None, -residuals.primal - self.equality(dx))
            dx = tuple(d + m for d, m in zip(dx, more_x, strict=True))
            return dx, dy + more_y, tuple(apply_rows(g, d) for g, d in zip(self.groups, dx, strict=True))

        zero = jax.tree.map(jnp.zeros_like, (residuals.dual, residuals.primal, residuals.rows))
        return repeat(1 + self.refinements, improve, zero)

    def first_record(self) -> Record:
        """Make the record before the first step: no bound yet."""
        inf = jnp.full(self.lanes, jnp.inf, self.rhs.dtype)
        return Record(-inf, inf, tuple(jnp.zeros_like(x) for x in self.guess), *self.first_multipliers())

    def gap_scale(self, record: Record) -> jax.Array:
        """Measure gaps by the effort, but by no less than a thousandth of a unit."""
        return jnp.maximum(jnp.where(jnp.isinf(record.upper), 0, record.upper), 1e-3)

    def assess(self, iterate: Iterate, residuals: Residuals, record: Record) -> Record:
        """Update both bounds.

        Upper: row violations are charged at twice their multipliers, once for what violating saves, once so that the
        effort itself stays within the gap of the optimum.

        Lower: with r = H x + A'z + E'y no u that meets the rows has an effort below -1/2 x'H x - h'z - b'y + r'u +
        1/2 (u - x)'H (u - x), whose last two terms are at least minus `_largest_loss`.
        """
        x = fenced(self.project)(iterate.x)

        def value(x: Rows) -> jax.Array:
            terms = [total(x_g * apply_hessian(g, x_g)) for g, x_g in zip(self.groups, x, strict=True)]
            return 0.5 * fold(jnp.add, terms)

        over = [jnp.maximum(apply_rows(g, x_g) - g.h, 0) for g, x_g in zip(self.groups, x, strict=True)]
        violation = fold(jnp.maximum, [-least(-o) for o in over])
        charge = fold(jnp.add, [total(o * z) for o, z in zip(over, iterate.z, strict=True)])
        near = 1e-9 if self.rhs.dtype == jnp.float64 else 2e-6
        upper = jnp.where(violation <= near, value(x) + 2 * charge, jnp.inf)
        sides = fold(jnp.add, [total(g.h * z) for g, z in zip(self.groups, iterate.z, strict=True)])
        losses = map(_largest_loss, self.groups, self.curvature, iterate.x, residuals.dual)
        lower = -value(iterate.x) - sides - fold(jnp.add, iterate.y * self.rhs) - fold(jnp.add, losses)
        falls, rises = upper < record.upper, lower > record.lower
        return Record(
            lower=jnp.where(rises, lower, record.lower),
            upper=jnp.where(falls, upper, record.upper),
            x=tuple(jnp.where(falls, n, o) for n, o in zip(x, record.x, strict=True)),
            y=jnp.where(rises, iterate.y, record.y),
            z=tuple(jnp.where(rises, n, o) for n, o in zip(iterate.z, record.z, strict=True)),
        )


def curvature_of(group: Blocks) -> jax.Array:
    """Find a c >= 0, (k, n, *lanes), with H - diag(c) diagonally dominant: for a diagonal H its diagonal.

    Where H ties the blocks together: K, (k n, k n, *lanes), with K'K = H^-1, any where a block is absent.
    """
    root = group.root
    if group.coupled:
        absent = flatten(jnp.broadcast_to(1 - group.present, group.columns.shape[1:]))
        eye = jnp.eye(len(root), dtype=root.dtype).reshape(*root.shape[:2], *[1] * (root.ndim - 2))
        return jnp.swapaxes(orthonormalise(root + eye * absent), 0, 1)
    matrix = jnp.stack([fold(jnp.add, root * column[:, None]) for column in jnp.moveaxis(root, 1, 0)])
    off_diagonal = lambda a, row: [jnp.abs(entry) for b, entry in enumerate(row) if b != a]
    return jnp.maximum(jnp.stack([row[a] - sum(off_diagonal(a, row)) for a, row in enumerate(matrix)]), 0)


def _largest_loss(group: Blocks, curvature: jax.Array, x: jax.Array, r: jax.Array) -> jax.Array:
    """Bound -r'u - 1/2 (u - x)'H (u - x) from above over |u| <= 1, (*lanes), from the group's curvature.

    For every unknown by r^2/(2 c) - r x or by |r|, or for all at once by 1/2 r'H^-1 r - r'x or by |r|_1. Where the
    objective is curved, u is near x, and the sign of r x counts: in float32 this bound is far tighter.
    """
    if group.coupled:
        turned = matvec(curvature, flatten(r))
        return jnp.minimum(0.5 * fold(jnp.add, turned * turned) - total(r * x), total(jnp.abs(r)))
    curved = curvature > 0
    near = 0.5 * r * r / jnp.where(curved, curvature, 1) - r * x
    return total(jnp.where(curved, jnp.minimum(near, jnp.abs(r)), jnp.abs(r)))
