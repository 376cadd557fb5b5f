"""The homogeneous self-dual embedding of a conic margin program, in lanes.

One loop of predictor-corrector steps with Nesterov's and Todd's scaling finds an optimum, or a certificate that nothing
is admissible; it starts at no admissible point. Blocks are eliminated first, then the equalities, then lambda.

Sources: Vandenberghe (2010), "The CVXOPT linear and quadratic cone program solvers", sections 4 and 7; Andersen, Roos
and Terlaky (2003), "On implementing a primal-dual interior-point method for conic quadratic optimization".
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced, repeat
from jaxgrasp.solvers.conic import cones
from jaxgrasp.solvers.conic.cones import Scaling
from jaxgrasp.solvers.conic.margin import ConicMargin, ConicPoint, Parts, inner, most, reduce
from jaxgrasp.solvers.small_matrices import (
    cholesky_3x3,
    inverse_cholesky,
    matvec,
    solve_3x3,
    solve_lower_3x3,
    sum_over_blocks,
)

_MAX_ITERATIONS = 60
_PATIENCE = 6
# What counts as progress of the upper bound.
_FALL = 1e-4
# Share of the way to the boundary.
_STEP = 0.98
# Steps of iterative refinement of every Newton direction.
_REFINEMENTS = 1


class ConicOutcome(NamedTuple):
    """The best point; (*lanes) each.

    point: the best one found.
    upper: certified: no admissible point has a larger lambda (for lambda >= 0).
    error: of `point`, the largest of its residuals and its gap, relative.
    infeasible: bool, there is a certificate that no point is admissible.
    certificate: how far the best one is from being exact; inf where there is none at all.
    residual: how far `point` misses rows and equalities.
    iterations: steps taken.
    """

    point: ConicPoint
    upper: jax.Array
    error: jax.Array
    infeasible: jax.Array
    certificate: jax.Array
    residual: jax.Array
    iterations: jax.Array


class _State(NamedTuple):
    x: jax.Array
    lam: jax.Array
    y: jax.Array
    s: Parts
    z: Parts
    tau: jax.Array
    kappa: jax.Array


class _Residuals(NamedTuple):
    x: jax.Array
    lam: jax.Array
    y: jax.Array
    rows: Parts
    tau: jax.Array


class _Factors(NamedTuple):
    lower: list[jax.Array]
    phi: jax.Array
    root: jax.Array
    v: jax.Array
    pivot: jax.Array


class _Carry(NamedTuple):
    state: _State
    residuals: _Residuals
    best: ConicOutcome
    stalled: jax.Array
    active: jax.Array
    step: jax.Array


def solve(problem: ConicMargin, tolerance: float, active: jax.Array) -> ConicOutcome:
    """Solve until every active lane is done; others are not touched.

    Args:
        problem: what to solve.
        tolerance: largest relative residual and gap.
        active: bool (*lanes).
    """
    lanes, dtype = problem.rhs.shape[1:], problem.rhs.dtype
    shapes = [part.sigma.shape for part in problem.rows]
    units = tuple(
        cones.identity_like(part.second_order, jnp.ones(shape, dtype))
        for part, shape in zip(problem.rows, shapes, strict=True)
    )
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
        fine = carry.active & jnp.isfinite(_total(stepped))
        state = _where(fine, stepped, carry.state)
        residuals = _residuals(problem, state)
        found = _assessed(problem, state, residuals, carry.best, tolerance)
        better = (found.error < 0.9 * carry.best.error) | (found.certificate < 0.9 * carry.best.certificate)
        # Where nothing is strictly inside the cones, points that miss them by little can promise much; the bound then
        # comes down, over a dozen steps, before they get any better.
        better |= carry.best.upper - found.upper > _FALL * jnp.maximum(1, jnp.abs(found.upper))
        found = found._replace(iterations=carry.best.iterations + 1)
        best = _where(carry.active, found, carry.best)
        stalled = jnp.where(better, 0, carry.stalled + 1)
        done = (best.error <= tolerance) | best.infeasible | (stalled >= _PATIENCE) | ~fine
        return _Carry(state, residuals, best, stalled, carry.active & ~done, carry.step + 1)

    first = _Carry(
        state, _residuals(problem, state), best, jnp.zeros(lanes, jnp.int32), active, jnp.zeros((), jnp.int32)
    )
    return lax.while_loop(lambda c: (c.step < _MAX_ITERATIONS) & jnp.any(c.active), body, first).best


@fenced
def _assessed(problem: ConicMargin, state: _State, r: _Residuals, best: ConicOutcome, tolerance: float) -> ConicOutcome:
    """The best point with this one taken into account."""
    inverse = 1 / state.tau
    primal = jnp.maximum(fold(jnp.maximum, jnp.abs(r.y)), most([jnp.abs(v) for v in r.rows])) * inverse
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
    # With nothing on the right, (y, z) excludes every x with |x|_inf <= 1, whatever lambda is.
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
    """A predictor, a corrector, and a step along it.

    Directions are a solution for the residuals plus dtau times one for the constants (c, b, h): three solves, in a loop
    so that the program has each of them once.
    """
    kinds = [part.second_order for part in problem.rows]

    @fenced
    def scale(s: Parts, z: Parts) -> tuple:
        scalings = tuple(cones.scaling(kind, s_p, z_p) for kind, s_p, z_p in zip(kinds, s, z, strict=True))
        return scalings, (inner(s, z) + state.tau * state.kappa) / degree

    scalings, mu = scale(state.s, state.z)
    factors = _factor(problem, scalings)

    @fenced
    def right_sides(i: jax.Array, remaining: jax.Array, aims: Parts) -> tuple:
        first = i == 0
        sides = tuple(
            jnp.where(first, -part.sides(), remaining * r + cones.stretch(w, a))
            for part, r, w, a in zip(problem.rows, residuals.rows, scalings, aims, strict=True)
        )
        rhs_lam = jnp.where(first, 1, -remaining * residuals.lam)
        return -remaining * residuals.x, rhs_lam, jnp.where(first, problem.rhs, remaining * residuals.y), sides

    @fenced
    def combine(
        own: tuple, constant: tuple, bend: jax.Array, remaining: jax.Array, aims: Parts, aim: jax.Array
    ) -> tuple:
        _, _, y, z, _ = own
        value = fold(jnp.add, problem.rhs * y) + inner([part.sides() for part in problem.rows], z)
        lacking = remaining * residuals.tau + aim / state.tau - own[1] + value
        dtau = lacking / (state.kappa / state.tau + bend)
        x, lam, y, z, rows = jax.tree.map(lambda a, c: a + dtau * c, own, constant)
        # From the rows, so that these are met whatever rounding does to W: lambda-wise it is aims - W dz.
        s = tuple(cones.stretch(w, a) - r for w, a, r in zip(scalings, aims, rows, strict=True))
        scaled = tuple(cones.stretch(w, d) for w, d in zip(scalings, z, strict=True))
        slack = tuple(cones.shrink(w, d) for w, d in zip(scalings, s, strict=True))
        dkappa = (aim - state.kappa * dtau) / state.tau
        over = [most([cones.overshoot(w, d)]) for w, d in zip(scalings * 2, slack + scaled, strict=True)]
        over = fold(jnp.maximum, [*over, -dtau / state.tau, -dkappa / state.kappa])
        return _State(x, lam, y, s, z, dtau, dkappa), slack, scaled, over

    @fenced
    def correct(i: jax.Array, direction: _State, slack: Parts, scaled: Parts, over: jax.Array) -> tuple:
        """What the next direction aims at, d_s divided by lambda and d_kappa: after the constants, the boundary."""
        first = i == 0
        centring = jnp.where(first, 0, (1 - 1 / jnp.maximum(over, 1)) ** 3)
        second = jnp.where(first, 0, 1)
        aims = tuple(
            cones.quotient(w, centring * mu * e - second * cones.product(kind, a, b)) - w.value
            for kind, w, a, b, e in zip(kinds, scalings, slack, scaled, units, strict=True)
        )
        aim = centring * mu - state.tau * state.kappa - second * direction.tau * direction.kappa
        return 1 - centring, aims, aim

    def phase(i: jax.Array, carry: tuple) -> tuple:
        constant, bend, (remaining, aims, aim), _, _ = carry
        own = _newton(problem, scalings, factors, *right_sides(i, remaining, aims))
        constant = _where(i == 0, own, constant)
        # = lambda_1 - b'y_1 - h'z_1, without its cancellation.
        bend = jnp.where(i == 0, fenced(inner)(own[4], own[3]), bend)
        direction, slack, scaled, over = combine(own, constant, bend, remaining, aims, aim)
        return constant, bend, correct(i, direction, slack, scaled, over), direction, over

    zero = jnp.zeros_like(state.lam)
    nothing = jax.tree.map(jnp.zeros_like, state)
    start = (nothing.x, zero, nothing.y, nothing.z, nothing.s), zero, (zero, nothing.s, zero), nothing, zero
    *_, direction, over = repeat(3, phase, start)

    @fenced
    def advance(state: _State, direction: _State, over: jax.Array) -> _State:
        alpha = _STEP / jnp.maximum(over, _STEP)
        return jax.tree.map(lambda a, d: a + alpha * d, state, direction)

    return advance(state, direction, over)


def _factor(problem: ConicMargin, scalings: tuple[Scaling, ...]) -> _Factors:
    """Eliminate blocks, then the equalities, then lambda."""

    @fenced
    def blocks(scalings: tuple[Scaling, ...]) -> tuple:
        grams = [part.gram(w) for part, w in zip(problem.rows, scalings, strict=True)]
        lower = cholesky_3x3([fold(jnp.add, list(entries)) for entries in zip(*grams, strict=True)])
        sigma = tuple(part.sigma for part in problem.rows)
        weighed = tuple(cones.weigh(w, v) for w, v in zip(scalings, sigma, strict=True))
        return lower, solve_3x3(lower, problem.adjoint(weighed)[0])

    lower, phi = blocks(scalings)

    @fenced
    def equalities(lower: list[jax.Array], phi: jax.Array) -> tuple:
        reduced = solve_lower_3x3(lower, jnp.moveaxis(problem.columns, 1, 0))
        matrix = jnp.stack(
            [sum_over_blocks(jnp.swapaxes(reduced * reduced[:, r][:, None], 0, 1)) for r in range(len(problem.rhs))]
        )
        eye = jnp.eye(len(problem.rhs), dtype=phi.dtype).reshape(*matrix.shape[:2], *[1] * (problem.rhs.ndim - 1))
        # What of sigma the blocks cannot make up for; as a difference of squares it would cancel.
        rest = [part.sigma - part.apply(phi) for part in problem.rows]
        lean = inner(*[[cones.shrink(w, v) for w, v in zip(scalings, rest, strict=True)]] * 2)
        return matrix + eye * problem.dropped, problem.border - sum_over_blocks(problem.columns * phi), lean

    matrix, v, lean = equalities(lower, phi)
    root = inverse_cholesky(matrix)
    half = fenced(matvec)(root, v)
    pivot = lean + fold(jnp.add, half * half)
    return _Factors(lower, phi, root, v, pivot)


def _newton(
    problem: ConicMargin,
    scalings: tuple[Scaling, ...],
    factors: _Factors,
    rhs_x: jax.Array,
    rhs_lam: jax.Array,
    rhs_y: jax.Array,
    sides: Parts,
) -> tuple:
    """Newton's system: x, lambda, y, z and the rows r = A x + sigma lambda + sides.

    With z = W^-2 r: A'z + E'y = rhs_x, sigma'z + w'y = rhs_lam, E x + w lambda = rhs_y.
    """

    @fenced
    def without_sides(rhs_x: jax.Array, rhs_lam: jax.Array, sides: Parts) -> tuple:
        pulled, along = problem.adjoint(tuple(cones.weigh(w, u) for w, u in zip(scalings, sides, strict=True)))
        return rhs_x - pulled, rhs_lam - along

    @fenced
    def eliminate(right: jax.Array, right_lam: jax.Array, rhs_y: jax.Array) -> tuple:
        first = solve_3x3(factors.lower, right)
        half = matvec(factors.root, sum_over_blocks(problem.columns * first) - rhs_y)
        across = matvec(factors.root, factors.v)
        lam = right_lam - fold(jnp.add, fold(jnp.add, factors.phi * right)) - fold(jnp.add, across * half)
        lam = lam / jnp.maximum(factors.pivot, jnp.finfo(lam.dtype).tiny)
        y = fold(jnp.add, factors.root * (half + across * lam)[:, None])
        x = first - factors.phi * lam - solve_3x3(factors.lower, problem.pull_back(y))
        return x, lam, y

    @fenced
    def rows(x: jax.Array, lam: jax.Array, sides: Parts) -> tuple:
        lhs = tuple(a + u for a, u in zip(problem.apply(x, lam), sides, strict=True))
        return lhs, tuple(cones.weigh(w, v) for w, v in zip(scalings, lhs, strict=True))

    @fenced
    def lacking(x: jax.Array, lam: jax.Array, y: jax.Array, z: Parts) -> tuple:
        pulled, along = problem.adjoint(z)
        own_lam = rhs_lam - along - fold(jnp.add, problem.border * y)
        return rhs_x - pulled - problem.pull_back(y), own_lam, rhs_y - problem.equality(x, lam)

    def improve(_: jax.Array, carry: tuple) -> tuple:
        (x, lam, y), right, lhs, z, sides = carry
        more = eliminate(*right)
        more_lhs, more_z = rows(more[0], more[1], sides)
        x, lam, y, lhs, z = jax.tree.map(jnp.add, (x, lam, y, lhs, z), (*more, more_lhs, more_z))
        return (x, lam, y), lacking(x, lam, y, z), lhs, z, jax.tree.map(jnp.zeros_like, sides)

    nothing = jnp.zeros_like(rhs_x), jnp.zeros_like(rhs_lam), jnp.zeros_like(rhs_y)
    none = jax.tree.map(jnp.zeros_like, sides)
    start = nothing, (*without_sides(rhs_x, rhs_lam, sides), rhs_y), none, none, sides
    (x, lam, y), _, lhs, z, _ = repeat(1 + _REFINEMENTS, improve, start)
    return x, lam, y, z, lhs


def _total(state: _State) -> jax.Array:
    """Sum of everything, (*lanes): not finite where anything is not."""
    sums = [fold(jnp.add, fold(jnp.add, state.x)), state.lam, fold(jnp.add, state.y), state.tau, state.kappa]
    return fold(jnp.add, [*sums, *(reduce(jnp.add, v) for v in (*state.s, *state.z))])


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda n, o: jnp.where(mask, n, o), new, old)
