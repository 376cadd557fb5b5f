"""The gauge of a polytope: how many times the hull of points u_k has to grow until it holds another point c.

    g = max c'y    over y with u_k'y <= 1
      = min sum z  over z >= 0 with sum z_k u_k = c

The origin is in the hull. With the points as the columns of U and the weights w = z/s of the slacks s = 1 - U'y, a step
solves U diag(w) U' dy = right, six unknowns whatever the number of points.

Every step proves two bounds. Any y proves g >= c'y / max u_k'y, so y is recorded as the point of the polar that it
points to. Any z that is moved by U'(U U')^-1 (c - U z) attains c, and its sum is an upper bound where it is then not
negative.

Here the points are balanced: with some weights a > 0, all 1 where nothing else is said, they sum up to zero. Then z may
have any multiple of a more, so both programs have interior points to start from, and the bounds are never far.

Callers scale: U has orthonormal rows, or zeros, before the mean is taken from all points.

Derivatives, of any order, are those of the equations

    u_k'y + s_k = 1,    U z = c,    s_k z_k = 0,

with U diag(w) U' again, and of g itself with y and z held: dg = dc'y - sum z_k du_k'y.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp

from jaxgrasp import linalg
from jaxgrasp.arrays import fold
from jaxgrasp.compiling import own_settings
from jaxgrasp.lanes.fence import fenced
from jaxgrasp.solvers.interior_point import Iterate, Residuals, Settings
from jaxgrasp.solvers.small_matrices import SmallFactor, matvec, matvec_transposed, small_cholesky, solve_small

ACCEPTED = {"float64": 1e-7, "float32": 1e-4}
"""A gap that did not close to the tolerance still counts as closed below this one."""
SETTINGS = {
    "float64": Settings(
        tolerance=1e-9,
        max_iterations=60,
        step_cap=1e-4,
        mu_floor=0.0,
        equal_steps=False,
        safeguard=0.0,
        patience=8,
        gap_floor=1e-12,
        accepted=ACCEPTED["float64"],
    ),
    "float32": Settings(
        tolerance=1e-5,
        max_iterations=60,
        step_cap=1e-3,
        mu_floor=1e-7,
        equal_steps=True,
        safeguard=1e-3,
        patience=8,
        gap_floor=1e-5,
        accepted=ACCEPTED["float32"],
    ),
}
"""Numbers of the loop."""
REFINEMENTS = {"float64": 0, "float32": 1}
"""Steps of iterative refinement of every direction."""
# The start's z is c's own multipliers, raised by their least one and a little more, in units of a point's share.
_RAISE, _LIFT = 1.1, 0.01
# The least slack whose row may move in derivatives.
_LEAST_SLACK = {"float64": 1e-10, "float32": 1e-6}


class Record(NamedTuple):
    """The best bounds so far, y (6, *lanes) that attains `lower` and z (m, *lanes) that proves `upper`."""

    lower: jax.Array
    upper: jax.Array
    y: jax.Array
    z: jax.Array


def factor_weighted(points: jax.Array, weights: jax.Array, dropped: jax.Array) -> SmallFactor:
    """Factor U diag(w) U' of U (6, m, *lanes), with ones on the diagonal of dropped rows."""

    @fenced
    def reduce(points: jax.Array, weights: jax.Array, dropped: jax.Array) -> list[jax.Array]:
        entries: list[jax.Array] = []
        for i, row in enumerate(points):
            products = fold(jnp.add, jnp.swapaxes(points[: i + 1] * (row * weights), 0, 1))
            entries += [*products[:i], products[i] + dropped[i]]
        return entries

    return fenced(small_cholesky)(reduce(points, weights, dropped))


class Factors(NamedTuple):
    """The factor of U diag(w) U', and w."""

    factor: SmallFactor
    weights: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GaugeProblem:
    """The program max c'y as a problem for the loop: its x is y, its multipliers are z.

    points: U, (6, m, *lanes); zero where a point is absent.
    target: c, (6, *lanes); zero where U has a zero row.
    present: a mask of the points, (m, *lanes): 1 or 0.
    dropped: a mask of the rows of U, (6, *lanes): 1 for rows that are zero, else 0.
    lean: e with (U U')^-1 = 1 + e e', (6, *lanes); None where e is zero.
    balance: a, (m, *lanes), zero where a point is absent; None where all are 1.
    """

    points: jax.Array
    target: jax.Array
    present: jax.Array
    dropped: jax.Array
    lean: jax.Array | None
    balance: jax.Array | None = None

    @property
    def lanes(self) -> tuple[int, ...]:
        """The shape of the trailing axes."""
        return self.target.shape[1:]

    @property
    def predictor(self) -> Self:
        """The problem itself."""
        return self

    def start(self) -> Iterate:
        """Start in the middle of the polar, at multipliers that attain c, raised until they are positive."""
        along = self._multipliers(self.target)
        lift = _RAISE * self._least_lift(along) + _LIFT / jnp.maximum(fold(jnp.add, self.present), 1)
        z = self._lifted(along, lift)
        return Iterate(jnp.zeros_like(self.target), (), jnp.ones_like(z), z)

    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals of U z = c and of the rows."""
        rows = matvec_transposed(self.points, iterate.x) + iterate.s - 1
        return Residuals(matvec(self.points, iterate.z) - self.target, (), rows)

    def factor(self, weights: jax.Array) -> Factors:
        """Factor U diag(w) U', with ones on the diagonal of dropped rows."""
        return Factors(factor_weighted(self.points, weights, self.dropped), weights)

    def solve(self, factors: Factors, residuals: Residuals, shift: jax.Array) -> tuple[jax.Array, tuple, jax.Array]:
        """Solve the Newton system with dz = shift + weights * U'dy for (dy, (), U'dy)."""

        @fenced
        def direction(factors: Factors, dual: jax.Array, shift: jax.Array) -> tuple[jax.Array, jax.Array]:
            dy = solve_small(factors.factor, -dual - matvec(self.points, shift))
            rows = matvec_transposed(self.points, dy)
            for _ in range(REFINEMENTS[dual.dtype.name]):
                dz = shift + factors.weights * rows
                dy = dy + solve_small(factors.factor, -dual - matvec(self.points, dz))
                rows = matvec_transposed(self.points, dy)
            return dy, rows

        dy, rows = direction(factors, residuals.dual, shift)
        return dy, (), rows

    def first_record(self) -> Record:
        """Make the record before the first step: g >= 0."""
        zero = jnp.zeros_like(self.target[0])
        return Record(zero, jnp.full_like(zero, jnp.inf), jnp.zeros_like(self.target), jnp.zeros_like(self.present))

    def gap_scale(self, record: Record) -> jax.Array:
        """Measure gaps by the distance from 1, where c is on the hull's boundary."""
        return jnp.abs(1 - record.lower)

    def assess(self, iterate: Iterate, residuals: Residuals, record: Record) -> Record:
        """Update both bounds, see the top of this file."""
        height = fold(jnp.add, self.target * iterate.x)
        reach = fold(jnp.maximum, residuals.rows - iterate.s + 1)
        inverse = 1 / jnp.maximum(reach, jnp.finfo(reach.dtype).tiny)
        lower = height * inverse
        z = iterate.z - self._multipliers(residuals.dual) * self.present
        z = self._lifted(z, jnp.maximum(self._least_lift(z), 0))
        upper = fold(jnp.add, z)
        rises, falls = lower > record.lower, upper < record.upper
        return Record(
            lower=jnp.where(rises, lower, record.lower),
            upper=jnp.where(falls, upper, record.upper),
            y=jnp.where(rises, iterate.x * inverse, record.y),
            z=jnp.where(falls, z, record.z),
        )

    def _multipliers(self, x: jax.Array) -> jax.Array:
        """Compute U'(U U')^-1 x, the least z with U z = x."""
        if self.lean is not None:
            x = x + self.lean * fold(jnp.add, self.lean * x)
        return matvec_transposed(self.points, x)

    def _least_lift(self, z: jax.Array) -> jax.Array:
        """The least multiple of a with which no z of a point that is there is negative, (*lanes)."""
        if self.balance is None:
            return fold(jnp.maximum, -z)
        there = self.balance > 0
        return fold(jnp.maximum, jnp.where(there, -z / jnp.where(there, self.balance, 1), -jnp.inf))

    def _lifted(self, z: jax.Array, lift: jax.Array) -> jax.Array:
        """Compute z + lift a, zero where a point is absent."""
        if self.balance is None:
            return (z + lift) * self.present
        return z * self.present + lift * self.balance


class Gauge(NamedTuple):
    """The gauge with the points that attain it, batch axes leading."""

    value: jax.Array
    """(*batch,), g."""
    y: jax.Array
    """(*batch, 6)."""
    z: jax.Array
    """(*batch, m)."""


@jax.custom_jvp
def gauge_of(points: jax.Array, target: jax.Array, found: Gauge, usable: jax.Array) -> Gauge:
    """Return the gauge as a function of the points and the target that it is of.

    Args:
        points: U', (*batch, m, 6), zero where absent.
        target: c, (*batch, 6).
        found: the gauge, held constant.
        usable: bool (*batch,); derivatives are zero where it is False. Those of y and z mean nothing where these are
            not unique.
    """
    return found


@gauge_of.defjvp
@own_settings()
def _gauge_jvp(primals: tuple, tangents: tuple) -> tuple[Gauge, Gauge]:
    U, _, _, usable = primals
    out = gauge_of(*primals)
    where = lambda x: jnp.where(usable.reshape(*usable.shape, *[1] * (x.ndim - usable.ndim)), x, 0)
    U, dU, dc, y, z = map(where, (U, *tangents[:2], out.y, out.z))
    times = lambda rows, v: jnp.einsum("...ki,...i->...k", rows, v)
    against = lambda rows, v: jnp.einsum("...ki,...k->...i", rows, v)
    across = times(dU, y)
    value = jnp.sum(dc * y, -1) - jnp.sum(z * across, -1)
    # With z ds + s dz = 0:  dz = w (U'dy + dU'y)  and  U diag(w) U'dy = dc - dU z - U diag(w) dU'y.
    weights = z / jnp.maximum(1 - times(U, y), _LEAST_SLACK[y.dtype.name])
    matrix = jnp.einsum("...ki,...k,...kj->...ij", U, weights, U)
    size = jnp.trace(matrix, axis1=-2, axis2=-1)
    least = jnp.where(size > 0, jnp.finfo(size.dtype).eps * size, 1)
    matrix = matrix + least[..., None, None] * jnp.eye(6, dtype=matrix.dtype)
    right = dc - against(dU, z) - against(U, weights * across)
    dy = linalg.solve_positive(matrix, right[..., None])[..., 0]
    return out, Gauge(value, dy, weights * (times(U, dy) + across))
