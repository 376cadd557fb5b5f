"""The homogeneous self-dual embedding of a conic margin program, in lanes.

The program is max lambda over A x + sigma lambda + s = h, E x + w lambda = b, s in K, with multipliers z in K and y.
With tau and kappa >= 0 beside the unknowns, the embedding asks for

    A'z + E'y = 0,    sigma'z + w'y = tau,                   (stationarity in x and lambda)
    b tau - E x - w lambda = 0,    s + A x + sigma lambda - h tau = 0,
    kappa - lambda + b'y + h'z = 0,    s o z = 0,    tau kappa = 0.

Zero always solves it. Where tau > 0, (x, lambda, s, y, z)/tau is optimal; where kappa > 0 with h'z + b'y < 0, (y, z)
proves that nothing is admissible. So the loop needs no admissible point to start from.

A predictor and a corrector with Nesterov's and Todd's scaling make a step; `kkt` solves their Newton systems.

Sources: Vandenberghe (2010), "The CVXOPT linear and quadratic cone program solvers", sections 4 and 7; Andersen, Roos
and Terlaky (2003), "On implementing a primal-dual interior-point method for conic quadratic optimization".
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced, repeat
from jaxgrasp.solvers.conic import cones, kkt
from jaxgrasp.solvers.conic.cones import Scaling
from jaxgrasp.solvers.conic.margin import ConicMargin, ConicPoint, Parts, inner, largest_entry, reduce

_MAX_ITERATIONS = 60
_PATIENCE = 6
# A relative fall of the upper bound by this much counts as progress.
_FALL = 1e-4
# A step goes this share of the way to the boundary.
_STEP = 0.98


class ConicOutcome(NamedTuple):
    """The best point and the best certificates that the loop met; all but the point are (*lanes).

    point: the best point.
    upper: a certified bound: no admissible point has a larger lambda (for lambda >= 0).
    error: the largest of the residuals of `point` and its gap, relative.
    infeasible: bool, whether a certificate shows that no point is admissible.
    certificate: the relative error of the best such certificate; inf where there is none at all.
    residual: the largest amount by which `point` misses rows and equalities.
    iterations: the number of steps taken.
    """

    point: ConicPoint
    upper: jax.Array
    error: jax.Array
    infeasible: jax.Array
    certificate: jax.Array
    residual: jax.Array
    iterations: jax.Array


class _State(NamedTuple):
    """The unknowns of the embedding."""

    x: jax.Array
    lam: jax.Array
    y: jax.Array
    s: Parts
    z: Parts
    tau: jax.Array
    kappa: jax.Array


class _Residuals(NamedTuple):
    """The residuals of the embedding's equations, each named after the unknown that it is as large as."""

    x: jax.Array
    lam: jax.Array
    y: jax.Array
    rows: Parts
    tau: jax.Array


class _Carry(NamedTuple):
    state: _State
    residuals: _Residuals
    best: ConicOutcome
    stalled: jax.Array
    active: jax.Array
    step: jax.Array


def solve(problem: ConicMargin, tolerance: float, active: jax.Array) -> ConicOutcome:
    """Solve until every active lane is done.

    Args:
        problem: the problem to solve.
        tolerance: the largest relative residual and gap of an optimum, and the largest error of a certificate.
        active: bool (*lanes); the loop does not touch lanes that are False.
    """
    lanes, dtype = problem.rhs.shape[1:], problem.rhs.dtype
    shapes = [part.sigma.shape for part in problem.rows]
    units = tuple(
        cones.identity_like(part.second_order, jnp.ones(shape, dtype))
        for part, shape in zip(problem.rows, shapes, strict=True)
    )
    # Start at the identity of every cone; the degree counts the pairs that share mu.
    one, zero = jnp.ones(lanes, dtype), jnp.zeros(lanes, dtype)
    x, y = jnp.zeros((*problem.columns.shape[1:3], *lanes), dtype), jnp.zeros_like(problem.rhs)
    state = _State(x, zero, y, units, units, one, one)
    degree = 1.0 + sum(
        float(np.prod(shape[1:3])) * (1 if part.second_order else shape[0])
        for part, shape in zip(problem.rows, shapes, strict=True)
    )
    best = ConicOutcome(
        ConicPoint(x, zero, y, tuple(jnp.zeros_like(u) for u in units)),
        jnp.full(lanes, jnp.inf, dtype),
        jnp.full(lanes, jnp.inf, dtype),
        jnp.zeros(lanes, bool),
        jnp.full(lanes, jnp.inf, dtype),
        jnp.full(lanes, jnp.inf, dtype),
        jnp.zeros(lanes, jnp.int32),
    )

    def body(carry: _Carry) -> _Carry:
        stepped = _step(problem, carry.state, carry.residuals, units, degree)
        is_usable = carry.active & jnp.isfinite(_total(stepped))
        state = _where(is_usable, stepped, carry.state)
        residuals = _residuals(problem, state)

        # Freeze the lanes that are solved or make no progress.
        assessed = _assess(problem, state, residuals, carry.best, tolerance)
        better = (assessed.error < 0.9 * carry.best.error) | (assessed.certificate < 0.9 * carry.best.certificate)
        # Where nothing is strictly inside the cones, points that miss them by little can promise much; the bound then
        # comes down, over a dozen steps, before they get any better.
        better |= carry.best.upper - assessed.upper > _FALL * jnp.maximum(1, jnp.abs(assessed.upper))
        assessed = assessed._replace(iterations=carry.best.iterations + 1)
        best = _where(carry.active, assessed, carry.best)
        stalled = jnp.where(better, 0, carry.stalled + 1)
        done = (best.error <= tolerance) | best.infeasible | (stalled >= _PATIENCE) | ~is_usable
        return _Carry(state, residuals, best, stalled, carry.active & ~done, carry.step + 1)

    first = _Carry(
        state, _residuals(problem, state), best, jnp.zeros(lanes, jnp.int32), active, jnp.zeros((), jnp.int32)
    )
    return lax.while_loop(lambda c: (c.step < _MAX_ITERATIONS) & jnp.any(c.active), body, first).best


@fenced
def _assess(problem: ConicMargin, state: _State, r: _Residuals, best: ConicOutcome, tolerance: float) -> ConicOutcome:
    """Update the best point and the certificates with this state."""
    # The point (x, lambda, y, z) / tau, and its residuals and gap.
    inverse = 1 / state.tau
    primal = jnp.maximum(fold(jnp.maximum, jnp.abs(r.y)), largest_entry([jnp.abs(v) for v in r.rows])) * inverse
    dual = jnp.maximum(fold(jnp.maximum, fold(jnp.maximum, jnp.abs(r.x))), jnp.abs(r.lam)) * inverse
    value = fold(jnp.add, problem.rhs * state.y) + inner([part.sides() for part in problem.rows], state.z)
    lam, bound = state.lam * inverse, value * inverse
    error = jnp.maximum(jnp.maximum(primal, dual), jnp.abs(bound - lam) / jnp.maximum(1, jnp.abs(lam)))
    error = jnp.where(jnp.isfinite(error), error, jnp.inf)

    # h'z + b'y - (A'z + E'y)'x >= lambda (sigma'z + w'y) at every admissible point; |x|_inf <= 1 for lambda >= 0.
    lost = fold(jnp.add, fold(jnp.add, jnp.abs(r.x)))
    pull = r.lam + state.tau
    radius = 1 + 3 * jnp.maximum(0, -lam)
    upper = jnp.where(pull > 0, (value + radius * lost) / jnp.where(pull > 0, pull, 1), jnp.inf)
    # With a right-hand side of 0, (y, z) excludes every x with |x|_inf <= 1, whatever lambda is.
    size = jnp.maximum(1e-30, -value)
    certificate = jnp.where(value < 0, (lost + jnp.abs(pull)) / size, jnp.inf)
    certificate = jnp.where(jnp.isfinite(certificate), jnp.minimum(best.certificate, certificate), best.certificate)

    better = error < best.error
    point = ConicPoint(state.x * inverse, lam, state.y * inverse, tuple(z * inverse for z in state.z))
    return best._replace(
        point=_where(better, point, best.point),
        error=jnp.where(better, error, best.error),
        residual=jnp.where(better, primal, best.residual),
        upper=jnp.minimum(best.upper, jnp.where(jnp.isfinite(upper), upper, jnp.inf)),
        infeasible=certificate <= tolerance,
        certificate=certificate,
    )


@fenced
def _residuals(problem: ConicMargin, state: _State) -> _Residuals:
    """Compute the residuals of the embedding's equations."""
    pulled, along = problem.adjoint(state.z)
    value = fold(jnp.add, problem.rhs * state.y) + inner([part.sides() for part in problem.rows], state.z)
    lhs = problem.apply(state.x, state.lam)
    return _Residuals(
        x=pulled + problem.pull_back(state.y),
        lam=along + fold(jnp.add, problem.border * state.y) - state.tau,
        y=problem.rhs * state.tau - problem.equality(state.x, state.lam),
        rows=tuple(s + a - part.sides() * state.tau for s, a, part in zip(state.s, lhs, problem.rows, strict=True)),
        tau=state.kappa - state.lam + value,
    )


def _step(problem: ConicMargin, state: _State, residuals: _Residuals, units: Parts, degree: float) -> _State:
    """Take a step along the corrector's direction.

    A direction is a solution of the Newton system for the residuals plus dtau times one for the constants (c, b, h).
    The three solves (constants, predictor, corrector) are rounds of one loop, so that the program has the system once.
    """
    kinds = [part.second_order for part in problem.rows]

    # Scale, W^-1 s = W z = lambda, and factor the Newton system.
    @fenced
    def scale(s: Parts, z: Parts) -> tuple:
        scalings = tuple(cones.scaling(kind, s_p, z_p) for kind, s_p, z_p in zip(kinds, s, z, strict=True))
        return scalings, (inner(s, z) + state.tau * state.kappa) / degree

    scalings, mu = scale(state.s, state.z)
    factors = kkt.factor(problem, scalings)
    right_sides = fenced(partial(_right_sides, problem, residuals, scalings))
    combine = fenced(partial(_combine, problem, state, residuals, scalings))
    aim_at = fenced(partial(_aim, kinds, state, scalings, mu, units))

    # Solve for the constants, the predictor and the corrector, in this order.
    def solve(i: jax.Array, carry: tuple) -> tuple:
        constant, bend, (remaining, aims, aim), _, _ = carry
        solution = kkt.newton(problem, scalings, factors, *right_sides(i, remaining, aims))
        constant = _where(i == 0, solution, constant)
        # = lambda_1 - b'y_1 - h'z_1, without its cancellation.
        bend = jnp.where(i == 0, fenced(inner)(solution[4], solution[3]), bend)
        direction, slack, scaled, overshoot = combine(solution, constant, bend, remaining, aims, aim)
        return constant, bend, aim_at(i, direction, slack, scaled, overshoot), direction, overshoot

    zero = jnp.zeros_like(state.lam)
    nothing = jax.tree.map(jnp.zeros_like, state)
    start = (nothing.x, zero, nothing.y, nothing.z, nothing.s), zero, (zero, nothing.s, zero), nothing, zero
    *_, direction, overshoot = repeat(3, solve, start)

    # Go a fixed share of the way to the boundary.
    @fenced
    def advance(state: _State, direction: _State, overshoot: jax.Array) -> _State:
        alpha = _STEP / jnp.maximum(overshoot, _STEP)
        return jax.tree.map(lambda a, d: a + alpha * d, state, direction)

    return advance(state, direction, overshoot)


def _right_sides(
    problem: ConicMargin,
    residuals: _Residuals,
    scalings: tuple[Scaling, ...],
    i: jax.Array,
    remaining: jax.Array,
    aims: Parts,
) -> tuple:
    """Form the right-hand sides of `kkt.newton`: (c, b, h) in round 0, then the remaining share of the residuals."""
    is_constant = i == 0
    sides = tuple(
        jnp.where(is_constant, -part.sides(), remaining * r + cones.stretch(w, a))
        for part, r, w, a in zip(problem.rows, residuals.rows, scalings, aims, strict=True)
    )
    rhs_lam = jnp.where(is_constant, 1, -remaining * residuals.lam)
    return -remaining * residuals.x, rhs_lam, jnp.where(is_constant, problem.rhs, remaining * residuals.y), sides


def _combine(
    problem: ConicMargin,
    state: _State,
    residuals: _Residuals,
    scalings: tuple[Scaling, ...],
    solution: tuple,
    constant: tuple,
    bend: jax.Array,
    remaining: jax.Array,
    aims: Parts,
    aim: jax.Array,
) -> tuple:
    """Combine both solutions to a direction; dtau follows from the rows of tau and kappa.

    Returns:
        The direction, W^-1 ds and W dz, and the reciprocal of the step that reaches the boundary.
    """
    _, _, y, z, _ = solution
    value = fold(jnp.add, problem.rhs * y) + inner([part.sides() for part in problem.rows], z)
    residual = remaining * residuals.tau + aim / state.tau - solution[1] + value
    dtau = residual / (state.kappa / state.tau + bend)
    x, lam, y, z, rows = jax.tree.map(lambda a, c: a + dtau * c, solution, constant)
    # From the rows, so that these are met whatever rounding does to W: lambda-wise it is aims - W dz.
    s = tuple(cones.stretch(w, a) - r for w, a, r in zip(scalings, aims, rows, strict=True))
    scaled = tuple(cones.stretch(w, d) for w, d in zip(scalings, z, strict=True))
    slack = tuple(cones.shrink(w, d) for w, d in zip(scalings, s, strict=True))
    dkappa = (aim - state.kappa * dtau) / state.tau
    overshoots = [largest_entry([cones.overshoot(w, d)]) for w, d in zip(scalings * 2, slack + scaled, strict=True)]
    overshoot = fold(jnp.maximum, [*overshoots, -dtau / state.tau, -dkappa / state.kappa])
    return _State(x, lam, y, s, z, dtau, dkappa), slack, scaled, overshoot


def _aim(
    kinds: list[bool],
    state: _State,
    scalings: tuple[Scaling, ...],
    mu: jax.Array,
    units: Parts,
    i: jax.Array,
    direction: _State,
    slack: Parts,
    scaled: Parts,
    overshoot: jax.Array,
) -> tuple:
    """Choose what the next direction aims at: after the constants the boundary, after the predictor sigma mu.

    In the scaled space a direction solves lambda o (W^-1 ds + W dz) = sigma mu e - lambda o lambda - second order.

    Returns:
        The share 1 - sigma of the residuals, d_s divided by lambda, and d_kappa.
    """
    is_constant = i == 0
    # Mehrotra's sigma = (1 - alpha)^3, with the predictor's step alpha to the boundary.
    sigma = jnp.where(is_constant, 0, (1 - 1 / jnp.maximum(overshoot, 1)) ** 3)
    second = jnp.where(is_constant, 0, 1)
    aims = tuple(
        cones.quotient(w, sigma * mu * e - second * cones.product(kind, a, b)) - w.value
        for kind, w, a, b, e in zip(kinds, scalings, slack, scaled, units, strict=True)
    )
    aim = sigma * mu - state.tau * state.kappa - second * direction.tau * direction.kappa
    return 1 - sigma, aims, aim


def _total(state: _State) -> jax.Array:
    """Sum all unknowns, (*lanes): the sum is not finite where any of them is not."""
    sums = [fold(jnp.add, fold(jnp.add, state.x)), state.lam, fold(jnp.add, state.y), state.tau, state.kappa]
    return fold(jnp.add, [*sums, *(reduce(jnp.add, v) for v in (*state.s, *state.z))])


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda n, o: jnp.where(mask, n, o), new, old)
