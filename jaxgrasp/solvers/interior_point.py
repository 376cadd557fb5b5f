"""The primal-dual interior-point loop for linear rows: Mehrotra's predictor-corrector over a batch of lanes.

A problem says what its unknowns are and how to solve its Newton system; the loop owns step lengths, centring, freezing
of finished lanes and the stopping rule. All arrays carry the batch in their trailing axes ("lanes"), so that one lane
is one problem and every elementwise operation works on a full vector of problems; with no trailing axis the same code
is the program of a single problem. Programs with second-order cones have a loop of their own, `conic.embedding`.

The problems have the form: minimise f(x) over x subject to E x = b and A x + s = h, s >= 0, with multipliers y and
z >= 0. The loop follows the points with

    grad f(x) + A'z + E'y = 0,    E x = b,    A x + s = h,    s_i z_i = mu        for mu -> 0.

Source: Mehrotra (1992), "On the implementation of a primal-dual interior point method"; the step rule and the freezing
are described in `solve`.
"""

import math
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced

Tree = Any


class Settings(NamedTuple):
    """Numbers of the loop. All but those marked static may be traced: changing them costs no recompilation.

    tolerance: the loop stops at upper - lower <= tolerance * the problem's gap_scale.
    max_iterations: the largest number of steps.
    step_cap: a step goes at most max(0.99, 1 - step_cap) of the way to the boundary.
    mu_floor: the smallest complementarity that a step aims at.
    equal_steps: whether primal and dual unknowns take one step length (static).
    safeguard: keeps s z >= safeguard * mu in every row after a step (static; 0.0 switches it off).
    patience: how many steps in a row may fail to cut the gap by a tenth.
    gap_floor: gaps up to this one count as closed, whatever their scale; the loop then ends near a central point.
    gap_share: no step aims at less than this share of the wanted gap (static): nearer to the boundary rounding spoils
        the Newton system, and with it the stationarity that the bounds need.
    accepted: a lane that stalls with a larger gap, relative to gap_scale, goes on with care, see `solve` (static).
    """

    tolerance: float
    max_iterations: int
    step_cap: float
    mu_floor: float | jax.Array
    equal_steps: bool
    safeguard: float
    patience: int = 3
    gap_floor: float | jax.Array = 0.0
    gap_share: float = 0.0
    accepted: float = float("inf")


class Iterate(NamedTuple):
    """The unknowns; every leaf has trailing lane axes. `s` and `z` are trees of rows, alike in structure."""

    x: Tree
    y: Tree
    s: Tree
    z: Tree


class Residuals(NamedTuple):
    """Residuals of the optimality conditions: `dual` like x, `primal` like y, `rows` = A x + s - h like s."""

    dual: Tree
    primal: Tree
    rows: Tree


class Problem(Protocol):
    """The interface between a problem and the loop."""

    @property
    def lanes(self) -> tuple[int, ...]:
        """The shape of the trailing axes."""
        ...

    @property
    def present(self) -> Tree:
        """A mask that broadcasts to s: 1 where a row counts, 0 where it belongs to something absent."""
        ...

    def start(self) -> Iterate:
        """Choose the first iterate, s > 0; z > 0 on rows that count and exactly 0 on the others."""
        ...

    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals of the optimality conditions."""
        ...

    def factor(self, weights: Tree) -> Any:
        """Factor the Newton system for weights z/s (like s)."""
        ...

    @property
    def predictor(self) -> "Problem":
        """The problem for the predictor, whose direction only tells how far a step can go and need not be exact."""
        ...

    def solve(self, factors: Any, residuals: Residuals, shift: Tree) -> tuple[Tree, Tree, Tree]:
        """Solve the Newton system with dz = shift + weights * A dx for the directions (dx, dy, A dx)."""
        ...

    def first_record(self) -> Any:
        """Make the record before the first step; it has `lower` and `upper`, certified bounds per lane."""
        ...

    def gap_scale(self, record: Any) -> jax.Array:
        """Compute the scale of gaps, per lane: `Settings.tolerance` is relative to it."""
        ...

    def assess(self, iterate: Iterate, residuals: Residuals, record: Any) -> Any:
        """Update the record with this iterate; bounds only ever get better."""
        ...


class Outcome(NamedTuple):
    """The last iterate of every lane with its residuals, its record and the number of steps that it took."""

    iterate: Iterate
    residuals: Residuals
    record: Any
    iterations: jax.Array


class _Carry(NamedTuple):
    iterate: Iterate
    residuals: Residuals
    record: Any
    best_gap: jax.Array
    stalled: jax.Array
    active: jax.Array
    iterations: jax.Array
    mu: jax.Array
    step: jax.Array


def solve(problem: Problem, settings: Settings, active: jax.Array) -> Outcome:
    """Run the loop until every active lane is finished.

    Centring is (mu_aff / mu)^3; a step goes to max(0.99, 1 - max(mu, step_cap)) of the way to the boundary. A lane is
    finished when its certified bounds have met, or when `patience` steps in a row cut their gap by less than a tenth;
    then it freezes: nothing of it changes any more, whatever its neighbours do. A step that is not finite is not taken.

    A few lanes in a million stall with a gap that is not `accepted`: s z is far below mu in some rows, where the term
    of second order outgrows the step. They get four times as many steps again, without it and aiming at mu/10 at least.

    Args:
        problem: the problem to solve.
        settings: numbers of the loop.
        active: bool (*lanes); the loop does not touch lanes that are False.
    """
    lanes, present = len(problem.lanes), problem.present
    retries = math.isfinite(settings.accepted)

    # Start: mu is the mean of s z over the rows that count.
    iterate = fenced(problem.start)()
    count = reduce_rows(jnp.add, jax.tree.map(lambda p, s: jnp.broadcast_to(p, s.shape), present, iterate.s), lanes)
    inverse_count = 1 / jnp.maximum(count, 1)
    mu = _product(iterate.s, iterate.z, lanes) * inverse_count

    def unfinished(carry: _Carry) -> jax.Array:
        return (carry.step < settings.max_iterations) & jnp.any(carry.active)

    def body(carry: _Carry) -> _Carry:
        # Take a step, where it is finite.
        least_aim = settings.mu_floor
        if settings.gap_share:
            # On the central path the gap is the sum of s z, mu times the number of rows.
            gap_aim = settings.gap_share * settings.tolerance * problem.gap_scale(carry.record)
            least_aim = jnp.maximum(least_aim, gap_aim * inverse_count)
        careful = carry.stalled >= settings.patience if retries else None
        stepped, mu = _predict_correct(
            problem, settings, carry.iterate, carry.residuals, carry.mu, inverse_count, least_aim, careful
        )
        active = carry.active
        take = active & jnp.isfinite(mu)
        iterate = _where(take, stepped, carry.iterate)
        residuals = fenced(problem.residuals)(iterate)

        # Bound the optimum, and freeze the lanes whose bounds have met or no longer move.
        record = _where(active, fenced(problem.assess)(iterate, residuals, carry.record), carry.record)
        gap = record.upper - record.lower
        improved = gap < 0.9 * carry.best_gap
        # Until both bounds exist there is no gap to stall.
        stalled = jnp.where(improved | jnp.isinf(gap), 0, carry.stalled + 1)
        size = problem.gap_scale(record)
        closed = gap <= jnp.maximum(settings.tolerance * size, settings.gap_floor)
        given_up = stalled >= settings.patience
        if retries:
            given_up &= (gap <= settings.accepted * size) | (stalled >= 5 * settings.patience)
        return _Carry(
            iterate=iterate,
            residuals=residuals,
            record=record,
            best_gap=jnp.where(improved, gap, carry.best_gap),
            stalled=stalled,
            active=active & ~closed & ~given_up,
            iterations=carry.iterations + active.astype(jnp.int32),
            mu=jnp.where(take, mu, carry.mu),
            step=carry.step + 1,
        )

    first = _Carry(
        iterate=iterate,
        residuals=fenced(problem.residuals)(iterate),
        record=fenced(problem.first_record)(),
        best_gap=jnp.full_like(mu, jnp.inf),
        stalled=jnp.zeros(problem.lanes, jnp.int32),
        active=active,
        iterations=jnp.zeros(problem.lanes, jnp.int32),
        mu=mu,
        step=jnp.zeros((), jnp.int32),
    )
    last = lax.while_loop(unfinished, body, first)
    return Outcome(last.iterate, last.residuals, last.record, last.iterations)


def _predict_correct(
    problem: Problem,
    settings: Settings,
    iterate: Iterate,
    residuals: Residuals,
    mu: jax.Array,
    inverse_count: jax.Array,
    least_aim: float | jax.Array,
    careful: jax.Array | None,
) -> tuple[Iterate, jax.Array]:
    """Take one step, a careful one in some lanes, see `solve`.

    A direction that aims at s z = a in every row has z ds + s dz = a - s z. With the weights w = z/s and the rows' own
    equation ds = -r - A dx this is dz = e + w A dx, with the shift e = w r - z + a/s, which `problem.solve` takes.

    Returns:
        The new iterate and its complementarity, NaN where the step is unusable.
    """
    lanes, present = len(problem.lanes), problem.present

    # Factor the Newton system, which both directions share.
    inverse_s, inverse_z, weights, affine_shift = fenced(partial(_weigh, present))(iterate.s, iterate.z, residuals.rows)
    factors = problem.factor(weights)

    # Predictor, a = 0: how far it can go tells how much centring is needed.
    _, _, rows = problem.predictor.solve(factors, residuals, affine_shift)
    ds, dz, primal, dual = fenced(partial(_affine_direction, settings, lanes))(
        iterate.z, rows, weights, residuals.rows, inverse_s
    )

    # Corrector, a = sigma mu - ds dz, with the predictor's ds and dz.
    correct = partial(_correct, affine_shift, inverse_s, present, inverse_count, least_aim, careful, lanes)
    shift = fenced(correct)(iterate, ds, dz, primal, dual, mu)
    dx, dy, rows = problem.solve(factors, residuals, shift)

    # Step, almost to the boundary.
    ds, dz, primal, dual = fenced(partial(_test_ratios, settings, lanes))(
        rows, shift, weights, residuals.rows, inverse_s, inverse_z
    )
    advance = partial(_advance, settings, present, inverse_count, lanes)
    return fenced(advance)(iterate, Iterate(dx, dy, ds, dz), primal, dual, mu)


def _weigh(present: Tree, s: Tree, z: Tree, rows: Tree) -> tuple[Tree, Tree, Tree, Tree]:
    """Compute 1/s, 1/z, the weights z/s, and the shift that aims at s z = 0."""
    # One division serves weights and both ratio tests; absent rows (z = 0) divide by 1 instead of 0.
    guarded = jax.tree.map(lambda z, p: z + (1 - p), z, present)
    inverse = jax.tree.map(lambda s, g: 1 / (s * g), s, guarded)
    inverse_s = jax.tree.map(jnp.multiply, guarded, inverse)
    inverse_z = jax.tree.map(jnp.multiply, s, inverse)
    weights = jax.tree.map(jnp.multiply, z, inverse_s)
    return inverse_s, inverse_z, weights, jax.tree.map(lambda z, w, r: w * r - z, z, weights, rows)


def _affine_direction(
    settings: Settings, lanes: int, z: Tree, rows: Tree, weights: Tree, residual: Tree, inverse_s: Tree
) -> tuple[Tree, Tree, jax.Array, jax.Array]:
    """Compute the predictor's ds and dz, and the reciprocals of the steps that reach the boundary.

    As s z = 0 is aimed at, dz / z = -1 - ds / s, so the ratios of ds / s tell both steps.
    """
    ds = jax.tree.map(lambda r, a: -r - a, residual, rows)
    dz = jax.tree.map(lambda z, w, d: -(z + w * d), z, weights, ds)
    relative = jax.tree.map(jnp.multiply, ds, inverse_s)
    primal, dual = -reduce_rows(jnp.minimum, relative, lanes), 1 + reduce_rows(jnp.maximum, relative, lanes)
    if settings.equal_steps:
        primal = dual = jnp.maximum(primal, dual)
    return ds, dz, primal, dual


def _correct(
    affine_shift: Tree,
    inverse_s: Tree,
    present: Tree,
    inverse_count: jax.Array,
    least_aim: float | jax.Array,
    careful: jax.Array | None,
    lanes: int,
    iterate: Iterate,
    ds: Tree,
    dz: Tree,
    primal: jax.Array,
    dual: jax.Array,
    mu: jax.Array,
) -> Tree:
    """Compute the corrector's shift: aim at sigma mu and make up for the second-order term ds dz."""
    primal, dual = 1 / jnp.maximum(primal, 1), 1 / jnp.maximum(dual, 1)
    # mu_aff, the mean of (s + primal ds) (z + dual dz), of which s z + z ds + s dz is zero.
    along = inverse_count * _product(iterate.z, ds, lanes)
    across = inverse_count * _product(ds, dz, lanes)
    ratio = ((1 - dual) * mu + (primal - dual) * along + primal * dual * across) / mu
    # sigma mu with Mehrotra's sigma = (mu_aff / mu)^3.
    aim = jnp.maximum(ratio * ratio * ratio * mu, least_aim)
    second = jax.tree.map(jnp.multiply, ds, dz)
    if careful is not None:
        aim = jnp.where(careful, jnp.maximum(aim, 0.1 * mu), aim)
        second = jax.tree.map(lambda d: jnp.where(careful, 0, d), second)
    return jax.tree.map(lambda e, d, i, p: e + (aim * p - d) * i, affine_shift, second, inverse_s, present)


def _test_ratios(
    settings: Settings,
    lanes: int,
    rows: Tree,
    shift: Tree,
    weights: Tree,
    residual: Tree,
    inverse_s: Tree,
    inverse_z: Tree,
) -> tuple[Tree, Tree, jax.Array, jax.Array]:
    """Compute the corrector's ds and dz, and the reciprocals of the steps that reach the boundary."""
    ds = jax.tree.map(lambda r, a: -r - a, residual, rows)
    dz = jax.tree.map(lambda e, w, a: e + w * a, shift, weights, rows)
    primal = -reduce_rows(jnp.minimum, jax.tree.map(jnp.multiply, ds, inverse_s), lanes)
    dual = -reduce_rows(jnp.minimum, jax.tree.map(jnp.multiply, dz, inverse_z), lanes)
    if settings.equal_steps:
        primal = dual = jnp.maximum(primal, dual)
    return ds, dz, primal, dual


def _advance(
    settings: Settings,
    present: Tree,
    inverse_count: jax.Array,
    lanes: int,
    iterate: Iterate,
    step: Iterate,
    primal: jax.Array,
    dual: jax.Array,
    mu: jax.Array,
) -> tuple[Iterate, jax.Array]:
    """Go max(0.99, 1 - max(mu, step_cap)) of the way to the boundary; returns the iterate and its complementarity."""
    eta = jnp.maximum(0.99, 1 - jnp.maximum(mu, settings.step_cap))
    primal, dual = eta / jnp.maximum(primal, eta), eta / jnp.maximum(dual, eta)
    new = Iterate(
        x=_axpy(primal, step.x, iterate.x),
        y=_axpy(dual, step.y, iterate.y),
        s=_axpy(primal, step.s, iterate.s),
        z=_axpy(dual, step.z, iterate.z),
    )
    mu_new = _product(new.s, new.z, lanes) * inverse_count
    if settings.safeguard:
        # Raise both to s z >= safeguard mu, so that no row runs ahead of the others to the boundary.
        low = settings.safeguard * mu_new
        guarded = jax.tree.map(lambda z, p: z + (1 - p), new.z, present)
        lift = jax.tree.map(lambda s, g, p: low * p / (s * g), new.s, guarded, present)
        lifted_s = jax.tree.map(lambda s, r: s * jnp.maximum(1, r), new.s, lift)
        lifted_z = jax.tree.map(lambda z, r: z * jnp.maximum(1, r), new.z, lift)
        new = new._replace(s=lifted_s, z=lifted_z)
    return new, mu_new


def _axpy(step: jax.Array, direction: Tree, point: Tree) -> Tree:
    return jax.tree.map(lambda d, x: x + step * d, direction, point)


def _product(a: Tree, b: Tree, lanes: int) -> jax.Array:
    return reduce_rows(jnp.add, jax.tree.map(jnp.multiply, a, b), lanes)


def reduce_rows(op: Any, tree: Tree, lanes: int) -> jax.Array:
    """Reduce all leaves over everything but the trailing lane axes, unrolled: XLA's CPU code vectorises over lanes."""
    if not lanes:
        # Nothing to vectorise over, and a hundred rows would be a hundred operations.
        return fold(op, [op.reduce(leaf, axis=None) for leaf in jax.tree.leaves(tree)])
    parts = []
    for leaf in jax.tree.leaves(tree):
        part = leaf
        while part.ndim > lanes:
            part = fold(op, part)
        parts.append(part)
    return fold(op, parts)


def _where(mask: jax.Array, new: Tree, old: Tree) -> Tree:
    return jax.tree.map(lambda n, o: jnp.where(mask, n, o), new, old)
