"""The program max lambda over blocks: the form of (21)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced, repeat
from jaxgrasp.solvers.block.kkt import (
    BlockProblem,
    Factors,
    Record,
    Rows,
    adjoint_rows,
    apply_rows,
    least,
    total,
)
from jaxgrasp.solvers.interior_point import Iterate, Residuals
from jaxgrasp.solvers.small_matrices import spread_over


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MarginProblem(BlockProblem):
    """The program max lambda; its x is (blocks, lambda).

    In its record, `x` attains `lower` and (y, z) with sum sigma z = 1 certify `upper`.

    cutoff: (*lanes); a lane is finished when its upper bound is below this. None: lanes run to their optimum.
    """

    cutoff: jax.Array | None = None

    def attained(self, x: Rows) -> jax.Array:
        """Compute min (h - A x) / sigma, the lambda that x attains when E x = b.

        It is -inf where x violates a row with sigma = 0.
        """
        ratios = []
        for g, x_g in zip(self.groups, x, strict=True):
            info = jnp.finfo(g.h.dtype)
            # A row that lambda hardly moves may miss its right-hand side by a little more than rounding.
            soft = g.h + jnp.where(g.sigma <= 1e4 * info.eps, max(8 * float(info.eps), 1e-11), 0)
            ratios.append(least((soft - apply_rows(g, x_g)) / jnp.maximum(g.sigma, 4 * info.tiny)))
        worst = fold(jnp.minimum, ratios)
        return jnp.where(worst < -1e12, -jnp.inf, worst)

    def start(self) -> Iterate:
        """Start at light forces that meet E x = b, lambda well below what they attain, and multipliers with A'z = 0."""
        blocks = self.project(
            tuple(
                jnp.broadcast_to(spread_over(g.start, g.columns[0]), g.columns.shape[1:]) * g.present
                for g in self.groups
            )
        )

        @fenced
        def attain(blocks: Rows) -> jax.Array:
            ratios = []
            for g, x in zip(self.groups, blocks, strict=True):
                loaded = g.sigma > 1e-3
                ratio = (g.h - apply_rows(g, x)) / jnp.where(loaded, g.sigma, 1)
                ratios.append(least(jnp.where(loaded, ratio, jnp.inf)))
            low = fold(jnp.minimum, ratios)
            low = jnp.where(jnp.isfinite(low), low, 0)
            return low - jnp.maximum(jnp.abs(low), 0.1)

        @fenced
        def slacken(blocks: Rows, lam: jax.Array) -> Rows:
            return tuple(g.h - apply_rows(g, x) - g.sigma * lam for g, x in zip(self.groups, blocks, strict=True))

        # Slacks of at least a floor; z ~ 1 / (mean slack of a block), balanced so that A'z = 0.
        @fenced
        def spread(slacks: Rows) -> tuple:
            floor = jnp.maximum(0.1, -fold(jnp.minimum, [least(s) for s in slacks]))
            s, z = [], []
            for g, slack in zip(self.groups, slacks, strict=True):
                slack = jnp.where(g.present > 0, jnp.maximum(slack, floor), 1)
                along = slice(g.bounded, g.bounded + 1)
                balance = jnp.concatenate(
                    [
                        jnp.ones(slack.shape[0] - 1, slack.dtype),
                        -jnp.sum(g.patterns[:-1, along], 0) / g.patterns[-1, along],
                    ]
                )
                mean = fold(jnp.add, slack[:-1]) / (slack.shape[0] - 1)
                s.append(slack)
                z.append(spread_over(balance, slack) * (g.present / mean))
            return tuple(s), tuple(z)

        lam = attain(blocks)
        s, z = spread(slacken(blocks, lam))
        pull = fold(jnp.add, [total(g.sigma * z_g) for g, z_g in zip(self.groups, z, strict=True)])
        return Iterate((blocks, lam), jnp.zeros_like(self.rhs), s, tuple(z_g / jnp.maximum(pull, 1e-6) for z_g in z))

    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals of stationarity in x and lambda, of E x = b and of the rows."""
        blocks, lam = iterate.x
        dual = tuple(
            adjoint_rows(g, z) + e for g, z, e in zip(self.groups, iterate.z, self.pull_back(iterate.y), strict=True)
        )
        pull = fold(jnp.add, [total(g.sigma * z) for g, z in zip(self.groups, iterate.z, strict=True)]) - 1
        rows = tuple(
            apply_rows(g, x) + g.sigma * lam + s - g.h for g, x, s in zip(self.groups, blocks, iterate.s, strict=True)
        )
        return Residuals((dual, pull), self.equality(blocks) - self.rhs, rows)

    def solve(self, factors: Factors, residuals: Residuals, shift: Rows) -> tuple:
        """Solve the Newton system with dz = shift + weights * (A dx + sigma dlambda).

        Returns:
            (dx, dlambda), dy and the change of the rows, A dx + sigma dlambda.
        """

        @fenced
        def remainder(weights: Rows, dx: Rows, dlambda: jax.Array, dy: jax.Array, rows: Rows) -> tuple:
            """Compute what the direction so far leaves of the right-hand side."""
            dual, pull = residuals.dual
            shifts = tuple(e + w * r for e, w, r in zip(shift, weights, rows, strict=True))
            rhs_x = tuple(
                -d - adjoint_rows(g, e) - t
                for g, d, e, t in zip(self.groups, dual, shifts, self.pull_back(dy), strict=True)
            )
            rhs_lambda = -pull - fold(jnp.add, [total(g.sigma * e) for g, e in zip(self.groups, shifts, strict=True)])
            return rhs_x, rhs_lambda, -residuals.primal - self.equality(dx)

        @fenced
        def change(dx: Rows, dlambda: jax.Array) -> Rows:
            return tuple(apply_rows(g, d) + g.sigma * dlambda for g, d in zip(self.groups, dx, strict=True))

        def improve(_: jax.Array, state: tuple) -> tuple:
            (dx, dlambda), dy, rows = state
            more_x, more_lambda, more_y = self.newton(factors, *remainder(factors.weights, dx, dlambda, dy, rows))
            dx = tuple(d + m for d, m in zip(dx, more_x, strict=True))
            return (dx, dlambda + more_lambda), dy + more_y, change(dx, dlambda + more_lambda)

        zero = jax.tree.map(jnp.zeros_like, (residuals.dual, residuals.primal, residuals.rows))
        return repeat(1 + self.refinements, improve, zero)

    def first_record(self) -> Record:
        """Make the record before the first step: no bound yet."""
        inf = jnp.full(self.lanes, jnp.inf, self.rhs.dtype)
        x = tuple(jnp.zeros_like(g.columns[0]) for g in self.groups)
        return Record(-inf, inf, x, *self.first_multipliers())

    def gap_scale(self, record: Record) -> jax.Array:
        """Measure gaps by max(1, |lambda|).

        No gap counts where the upper bound is below the cutoff, or negative while no x attains anything.
        """
        decided = jnp.isinf(record.lower) & (record.upper < -1e-6)
        if self.cutoff is not None:
            decided |= record.upper < self.cutoff
        return jnp.where(decided, jnp.inf, jnp.maximum(1, jnp.where(jnp.isinf(record.lower), 1, jnp.abs(record.lower))))

    def assess(self, iterate: Iterate, residuals: Residuals, record: Record) -> Record:
        """Update both bounds: min (h - A x)/sigma and h'z + b'y + radius |A'z + E'y|_1, scaled to sigma'z = 1."""
        x = fenced(self.project)(iterate.x[0])
        lower = fenced(self.attained)(x)
        pull = residuals.dual[1] + 1
        loss = fold(jnp.add, [total(jnp.abs(d)) for d in residuals.dual[0]])
        value = fold(jnp.add, [total(g.h * z) for g, z in zip(self.groups, iterate.z, strict=True)])
        value = value + fold(jnp.add, iterate.y * self.rhs)
        best = jnp.maximum(lower, record.lower)
        # Before any point attains a lambda, the bound holds for lambda >= 0 only; a negative bound just excludes these.
        radius = 1 + self.radius * jnp.where(jnp.isinf(best), 0, jnp.maximum(0, -best))
        scale = 1 / pull
        upper = jnp.where(pull > 0, (value + radius * loss) * scale, jnp.inf)
        rises, falls = lower > record.lower, upper < record.upper
        return Record(
            lower=best,
            upper=jnp.where(falls, upper, record.upper),
            x=tuple(jnp.where(rises, n, o) for n, o in zip(x, record.x, strict=True)),
            y=jnp.where(falls, iterate.y * scale, record.y),
            z=tuple(jnp.where(falls, n * scale, o) for n, o in zip(iterate.z, record.z, strict=True)),
        )
