"""A linear function over the part of a polytope that lies in a box: certified bounds of its largest value.

    max c'v   over v (6) and t (n)   such that   w_gk'v - t_g <= h_gk,   0 <= t,   sum t <= 1,   -1 <= v <= 1

with n groups g of k points each. Any z >= 0 of the rows w proves an upper bound,

    c'v <= sum z_gk h_gk + max (0, max_g sum_k z_gk) + sum_j |c - sum z_gk w_gk|_j,

whether or not the loop has converged, and whether or not the part is empty. That suits a search that only asks whether
the bound is below some level: the loop stops there, or where the value is known to lie above.

A step solves six unknowns. With the weights d = z/s of the rows, group g adds the scatter of its points and of the
origin, which counts by the weight of t_g >= 0, about their mean m_g; sum t <= 1 adds, by its weight, that of sum m_g.
All terms are positive, so nothing cancels.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced
from jaxgrasp.solvers.interior_point import Iterate, Residuals, Settings, reduce_rows
from jaxgrasp.solvers.small_matrices import SmallFactor, small_cholesky, solve_small

SETTINGS = {
    "float64": Settings(
        tolerance=1.0,
        max_iterations=60,
        step_cap=1e-4,
        mu_floor=0.0,
        equal_steps=False,
        safeguard=1e-6,
        patience=30,
    ),
    "float32": Settings(
        tolerance=1.0,
        max_iterations=60,
        step_cap=1e-3,
        mu_floor=1e-8,
        equal_steps=True,
        safeguard=1e-3,
        patience=30,
    ),
}
"""Numbers of the loop."""
CLOSED = {"float64": 1e-9, "float32": 1e-5}
"""A gap of this share of the scale counts as closed."""
# Above the level, the bound is known well enough when the gap is this share of what it is above it.
_SHARE = 0.1
# Of the start: the least room that rows get, beside what they vary by in the box, and s z.
_ROOM, _CENTRING = 0.03, 1.0
# Rows that hold to this tell a value.
_MISSED = {"float64": 1e-10, "float32": 1e-6}


class Rows(NamedTuple):
    """The rows of the program, or what belongs to each."""

    edges: jax.Array
    """w_gk'v - t_g <= h_gk, (n, k, *lanes)."""
    least: jax.Array
    """-t_g <= 0, (n, *lanes)."""
    total: jax.Array
    """sum t <= 1, (*lanes)."""
    low: jax.Array
    """-v <= 1, (6, *lanes)."""
    high: jax.Array
    """v <= 1, (6, *lanes)."""


class Unknowns(NamedTuple):
    """v (6, *lanes) and t (n, *lanes)."""

    v: jax.Array
    t: jax.Array


class Record(NamedTuple):
    """The least bound so far, and a guess of the value at the last point."""

    lower: jax.Array
    upper: jax.Array


class Factors(NamedTuple):
    """The factor of the six unknowns' system, and what eliminates t."""

    factor: SmallFactor
    weights: Rows
    means: jax.Array
    """m_g, (6, n, *lanes)."""
    inverse: jax.Array
    """1 over the weight of group g with the origin, (n, *lanes)."""
    coupling: jax.Array
    """The factor of the scatter of sum m_g, from the row sum t <= 1, (*lanes)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BoxedProblem:
    """The program above as a problem for the loop, which minimises -c'v.

    points: w, (6, n, k, *lanes).
    heights: h, (n, k, *lanes).
    counts: a mask of the points, (n, k, *lanes): 1 or 0.
    target: c, (6, *lanes).
    level: (*lanes,), the loop ends where the bound is at most this.
    scale: (*lanes,), the size of what a gap counts beside.
    """

    points: jax.Array
    heights: jax.Array
    counts: jax.Array
    target: jax.Array
    level: jax.Array
    scale: jax.Array

    @property
    def lanes(self) -> tuple[int, ...]:
        """The shape of the trailing axes."""
        return self.level.shape

    @property
    def present(self) -> Rows:
        """A mask of the rows: 0 for points that are absent, else 1."""
        groups, one = jnp.ones_like(self.heights[:, 0]), jnp.ones_like(self.level)
        six = jnp.ones_like(self.target)
        return Rows(self.counts, groups, one, six, six)

    @property
    def predictor(self) -> Self:
        """The problem itself."""
        return self

    def start(self) -> Iterate:
        """Start in the middle of the box, with some room in every row, as far as the polytope has any there."""
        groups = self.heights.shape[0]
        used = jnp.maximum(-fold(jnp.minimum, jnp.swapaxes(jnp.where(self.counts > 0, self.heights, 0), 0, 1)), 0)
        # What the rows vary by in the box.
        widths = fold(jnp.add, jnp.abs(self.points))
        least = _ROOM * fold(jnp.maximum, fold(jnp.maximum, jnp.swapaxes(widths, 0, 1)))
        room = jnp.maximum(1 - fold(jnp.add, used), least) / (groups + 1)
        t = used + room
        six = jnp.ones_like(self.target)
        s = Rows(jnp.where(self.counts > 0, self.heights + t[:, None], 1), t, room, six, six)
        z = jax.tree.map(lambda s, p: _CENTRING * p / s, s, self.present)
        return Iterate(Unknowns(jnp.zeros_like(self.target), t), (), s, z)

    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals of the optimality conditions."""
        along, s = self._along(iterate.x), iterate.s
        rows = Rows(
            jnp.where(self.counts > 0, along.edges + s.edges - self.heights, 0),
            along.least + s.least,
            along.total + s.total - 1,
            along.low + s.low - 1,
            along.high + s.high - 1,
        )
        back = self._back(iterate.z)
        return Residuals(Unknowns(back.v - self.target, back.t), (), rows)

    def factor(self, weights: Rows) -> Factors:
        """Eliminate t, and factor the system of v."""

        @fenced
        def reduce(points: jax.Array, weights: Rows) -> tuple:
            d = weights.edges
            inverse = 1 / (fold(jnp.add, jnp.swapaxes(d, 0, 1)) + weights.least)
            means = fold(jnp.add, jnp.moveaxis(points * d, 2, 0)) * inverse
            coupling = weights.total / (1 + weights.total * fold(jnp.add, inverse))
            centred = points - means[:, :, None]
            whole = fold(jnp.add, jnp.swapaxes(means, 0, 1))
            box = weights.low + weights.high
            entries: list[jax.Array] = []
            for i in range(6):
                scaled = centred[i] * d
                origin = means[i] * weights.least
                for j in range(i + 1):
                    group = fold(jnp.add, jnp.swapaxes(scaled * centred[j], 0, 1)) + origin * means[j]
                    entry = fold(jnp.add, group) + coupling * whole[i] * whole[j]
                    entries.append(entry + box[i] if i == j else entry)
            return entries, means, inverse, coupling

        entries, means, inverse, coupling = reduce(self.points, weights)
        return Factors(fenced(small_cholesky)(entries), weights, means, inverse, coupling)

    def solve(self, factors: Factors, residuals: Residuals, shift: Rows) -> tuple[Unknowns, tuple, Rows]:
        """Solve the Newton system with dz = shift + weights * A dx for (dx, (), A dx)."""

        @fenced
        def direction(factors: Factors, dual: Unknowns, shift: Rows) -> tuple[Unknowns, tuple, Rows]:
            back = self._back(shift)
            right = Unknowns(-dual.v - back.v, -dual.t - back.t)
            means, inverse, coupling = factors.means, factors.inverse, factors.coupling
            # A'WA = [S.., -(sums); .., D + w e e']: t = (D + w e e')^-1 (right + sums' v), sums = m / inverse.
            undone = lambda r: inverse * (r - coupling * fold(jnp.add, inverse * r))
            v = right.v + fold(jnp.add, jnp.swapaxes(means / inverse * undone(right.t), 0, 1))
            v = solve_small(factors.factor, v)
            t = undone(right.t + fold(jnp.add, means * v[:, None]) / inverse)
            return Unknowns(v, t), (), self._along(Unknowns(v, t))

        return direction(factors, residuals.dual, shift)

    def first_record(self) -> Record:
        """Make the record before the first step: the box alone."""
        return Record(jnp.full_like(self.level, -jnp.inf), fold(jnp.add, jnp.abs(self.target)))

    def gap_scale(self, record: Record) -> jax.Array:
        """Measure gaps by what the value is above the level, or by the scale."""
        return jnp.maximum(_SHARE * (record.lower - self.level), CLOSED[self.level.dtype.name] * self.scale)

    def assess(self, iterate: Iterate, residuals: Residuals, record: Record) -> Record:
        """Update the bound, see the top of this file."""
        z = iterate.z.edges
        shares = fold(jnp.add, jnp.swapaxes(z, 0, 1))
        left = self.target - self._pull(z)
        bound = fold(jnp.add, fold(jnp.add, jnp.swapaxes(z * self.heights, 0, 1)))
        bound = bound + jnp.maximum(fold(jnp.maximum, shares), 0) + fold(jnp.add, jnp.abs(left))
        # Not the minimum: a bound that is not a number proves nothing.
        upper = jnp.where(bound < record.upper, bound, record.upper)
        # The value here, once the rows hold, less what they are off; below the level there is no more to know.
        off = jax.tree.map(jnp.abs, residuals.rows)
        missed = reduce_rows(jnp.maximum, off, len(self.lanes))
        cost = reduce_rows(jnp.add, jax.tree.map(jnp.multiply, iterate.z, off), len(self.lanes))
        value = fold(jnp.add, self.target * iterate.x.v) - 2 * cost
        guess = jnp.where(missed < _MISSED[missed.dtype.name], jnp.minimum(value, upper), record.lower)
        return Record(jnp.where(upper <= self.level, upper, guess), upper)

    def _pull(self, z: jax.Array) -> jax.Array:
        """Compute sum z_gk w_gk, (6, *lanes)."""
        return fold(jnp.add, jnp.swapaxes(fold(jnp.add, jnp.moveaxis(self.points * z, 2, 0)), 0, 1))

    def _along(self, x: Unknowns) -> Rows:
        """Compute A x."""
        edges = fold(jnp.add, self.points * x.v[:, None, None]) - x.t[:, None] * self.counts
        return Rows(edges, -x.t, fold(jnp.add, x.t), -x.v, x.v)

    def _back(self, z: Rows) -> Unknowns:
        """Compute A'z."""
        shares = fold(jnp.add, jnp.swapaxes(z.edges, 0, 1))
        return Unknowns(self._pull(z.edges) - z.low + z.high, z.total - shares - z.least)
