"""The audit of (21) and (22): what their answers claim, against the public arguments.

Forces f_0, checked against G f_0 = b and the rows, prove a margin from below. Multipliers z >= 0 of the rows and y of
G f = b prove one from above, whatever they are: for every admissible f with lambda >= 0,

    lambda (z'sigma) <= h'z + b'y - r'f,  r = A'z + G'y,

with rows A f + sigma lambda <= h, and |f_t| <= mu f_max, |f_n| <= f_max bound r'f.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp import linalg
from jaxgrasp.arrays import fold, fold_last
from jaxgrasp.robustness.auditing import hidden
from jaxgrasp.robustness.auditing.problem import Hand, Problem, facets, problem_of
from jaxgrasp.robustness.auditing.rows import Range, Rows, cross, own_rows
from jaxgrasp.robustness.interface.arguments import Arguments
from jaxgrasp.robustness.interface.solution import Solution
from jaxgrasp.solvers.status import Status

# Shares of the largest force by which rows and G f = b may be missed, and of the margin's natural scale between a bound
# and its proof. An answer counts as wrong at twice as much for rows, and at five times as much for bounds.
MISSED = {"float64": 5e-8, "float32": 1.5e-5}
CLOSED = {"float64": 2e-7, "float32": 2e-4}
# Forces below this share of the largest are rounding.
_NOTHING = {"float64": 1e-15, "float32": 1e-6}

_sum, _max, _min, _all, _any = (
    partial(fold_last, op) for op in (jnp.add, jnp.maximum, jnp.minimum, jnp.logical_and, jnp.logical_or)
)


class Evidence(NamedTuple):
    """What the solver adds to its answer for the audit; lanes lead.

    rows: S_1 and S_2 as it used them.
    cone_multipliers, bound_multipliers, wrench_multipliers, actuator_multipliers, joint_multipliers: those of (21) that
        prove the upper bound, as in `Solution`.
    """

    rows: Rows
    cone_multipliers: jax.Array
    bound_multipliers: jax.Array
    wrench_multipliers: jax.Array
    actuator_multipliers: jax.Array | None
    joint_multipliers: jax.Array | None


class Verdict(NamedTuple):
    """failed: bool (lanes,); margin, upper_bound: (lanes,), what the audit itself confirms, NaN and inf if nothing."""

    failed: jax.Array
    margin: jax.Array
    upper_bound: jax.Array


def judge(arguments: Arguments, solution: Solution, evidence: Evidence, anew: bool, smooth: bool) -> Verdict:
    """Audit every lane.

    Args:
        arguments: the public arguments.
        solution: of (21), or of (22) where a margin is asked for; leaves (lanes, ...).
        evidence: what the solver adds.
        anew: with S_1 and S_2 computed anew, not those that the solver used.
        smooth: whether a central point is claimed, which need not be optimal.
    """
    problem, rows, place = problem_of(arguments), evidence.rows, None
    if anew:
        rows, place = own_rows(problem, edges_of(problem, solution.cone_multipliers), solution.rank)
    return _judged(problem, solution, evidence, rows, place, smooth)


def spot(arguments: Arguments, solution: Solution, evidence: Evidence) -> jax.Array:
    """Where S_1 and S_2 are not those that the solver used, or the set does not lie where it claims, (lanes,)."""
    problem, used = problem_of(arguments), evidence.rows
    rows, place = own_rows(problem, edges_of(problem, solution.cone_multipliers), solution.rank)
    # What counts is what a row loses at the margin, or at the disturbance that takes a whole row by itself.
    force, there = problem.max_force, problem.present
    taken = jnp.maximum(_max(used.cone) / jnp.where(problem.friction > 0, problem.friction, jnp.inf), used.bound)
    taken = _max(jnp.where(there, taken / force, 0))
    margin = jnp.where(jnp.isfinite(solution.margin), jnp.abs(solution.margin), 0)
    margin = jnp.maximum(margin, jnp.where(taken > 0, 1 / jnp.where(taken > 0, taken, 1), 0))[:, None]
    near = 4 * MISSED[margin.dtype.name]
    apart = margin * jnp.maximum(_max(jnp.abs(rows.cone - used.cone)), jnp.abs(rows.bound - used.bound))
    right = _all((apart <= near * force) | ~there) & place.rank_stands
    if problem.hand is not None:
        assert rows.effort is not None and used.effort is not None
        right &= (margin * jnp.abs(rows.effort - used.effort).max(1) <= near * effort_unit(problem.hand)).all(-1)
    # Where the set is said to reach outside, and multipliers do not bound the margin.
    proven = _upper_bound(problem, evidence, used)[0]
    unproven = proven > CLOSED[margin.dtype.name] * natural_scale(problem, used)
    flat = (solution.status == Status.SOLVED) & _claims_flat(solution)
    # Rows of wrenches outside the range mean nothing; where only that makes the margin zero, they have to be outside.
    right = jnp.where(flat & place.disturbance_outside, place.rank_stands, right & ~(flat & unproven))
    claims = (solution.status <= Status.UNBOUNDED) | (solution.status == Status.PRUNED)
    return claims & jnp.isfinite(solution.upper_bound) & ~right


def corrected(solution: Solution, verdict: Verdict) -> Solution:
    """The solution with what the audit confirms in place of what it does not."""
    instead = {
        "margin": verdict.margin,
        "upper_bound": verdict.upper_bound,
        "status": Status.NOT_VERIFIED,
        **dict.fromkeys(("forces", "effort", "gap", "actuator_efforts"), jnp.nan),
        **dict.fromkeys(("cone_multipliers", "bound_multipliers", "wrench_multipliers", "actuator_multipliers"), 0.0),
        "joint_multipliers": 0.0,
    }

    given = {name: getattr(solution, name) for name in instead}
    changed = {name: hidden(x, verdict.failed, instead[name]) for name, x in given.items() if x is not None}
    return replace(solution, **changed)


def _judged(
    problem: Problem, solution: Solution, evidence: Evidence, rows: Rows, place: Range | None, smooth: bool
) -> Verdict:
    dtype = solution.margin.dtype.name
    status, asked = solution.status, problem.margin
    scale = natural_scale(problem, rows)
    proven, refuted = _upper_bound(problem, evidence, rows)
    proven = jnp.where(_flat(solution, place), 0, proven)
    holds, attained = _primal(problem, solution, rows)
    slack = CLOSED[dtype] * jnp.maximum(scale, jnp.abs(jnp.where(jnp.isfinite(attained), attained, 0)))

    margin, upper = solution.margin, solution.upper_bound
    bounded = proven <= upper + slack
    solved = holds & (margin <= attained) & (margin <= upper) & bounded
    if asked is not None:
        solved &= asked <= attained
    if not smooth:
        # A margin below zero proves that b cannot be borne.
        solved &= margin >= -slack
        solved &= upper - margin <= slack if asked is None else _least(problem, solution, rows)
    idle = holds & (attained == jnp.inf) & (margin == jnp.inf)
    unbearable = refuted | jnp.isnan(margin) & _outside(problem, solution, place)
    if asked is not None:
        unbearable |= proven < asked
    stands = (status != Status.SOLVED) | solved
    stands &= (status != Status.UNBOUNDED) | idle
    stands &= (status != Status.INFEASIBLE) | unbearable
    stands &= (status != Status.PRUNED) | bounded
    confirmed = jnp.where(holds & (attained > -jnp.inf), attained, jnp.nan)
    return Verdict(~stands, confirmed, jnp.where(jnp.isnan(proven), jnp.inf, proven))


def natural_scale(problem: Problem, rows: Rows) -> jax.Array:
    """The disturbance that takes a row of the mean force, (lanes,), 1 where nothing disturbs."""
    present = problem.present.astype(problem.max_force.dtype)
    mean = _sum(problem.max_force * present) / jnp.maximum(_sum(present), 1)
    largest = rows_size(rows)
    return jnp.where(largest > 0, mean / jnp.where(largest > 0, largest, 1), 1)


def rows_size(rows: Rows) -> jax.Array:
    """The most that any row loses, (lanes,)."""
    most = jnp.maximum(_max(rows.cone, 2), _max(rows.bound))
    return most if rows.effort is None else jnp.maximum(most, _max(rows.effort, 2))


def _primal(problem: Problem, solution: Solution, rows: Rows) -> tuple[jax.Array, jax.Array]:
    """Whether G f_0 = b, and the margin that f_0 attains, -inf where a row fails that nothing disturbs; (lanes,)."""
    forces, missed = solution.forces, MISSED[solution.forces.dtype.name]
    there = problem.present
    cone, bound = row_values(problem, forces, edges_of(problem, rows.cone))
    slack = missed * problem.max_force
    assert problem.reserve is not None
    spare = (slack[:, :, None] - problem.reserve) - cone
    parts = [_most(jnp.where(there[:, :, None], spare, jnp.inf), rows.cone)]
    parts += [_most(jnp.where(there, problem.max_force + slack - bound, jnp.inf), rows.bound)]
    holds = balanced(problem, forces)
    if problem.hand is not None:
        efforts, slack = solution.actuator_efforts, missed * effort_unit(problem.hand)
        assert efforts is not None and rows.effort is not None
        spare = jnp.stack([problem.hand.upper + slack - efforts, efforts - problem.hand.lower + slack], 1)
        parts += [_most(spare, rows.effort)]
        holds &= _driven(problem.hand, forces, efforts)
    return holds, fold(jnp.minimum, parts)


def _most(spare: jax.Array, loss: jax.Array) -> jax.Array:
    """The largest lambda with lambda loss <= spare in every row, (lanes,)."""
    moved = loss > 0
    still = jnp.where(spare >= 0, jnp.inf, -jnp.inf)
    return _min(jnp.where(moved, spare / jnp.where(moved, loss, 1), still), loss.ndim - 1)


def edges_of(problem: Problem, cone: jax.Array) -> int:
    """n_e, from numbers of every facet (..., facets)."""
    return cone.shape[-1] if problem.arms is None else cone.shape[-1] // 2


def row_values(problem: Problem, forces: jax.Array, cone_edges: int) -> tuple[jax.Array, jax.Array]:
    """C f (lanes, n, n_e), 2 n_e of soft contacts, and -f_n (lanes, n)."""
    moments = [forces[..., a] for a in range(3, forces.shape[-1])]
    pressed = jnp.stack([forces[..., 0], forces[..., 1], problem.friction * forces[..., 2], *moments], -1)
    pattern = facets(problem, cone_edges)
    cone = fold(jnp.add, [pressed[..., a, None] * pattern[:, a] for a in range(pressed.shape[-1])])
    return cone, -forces[..., 2]


def balanced(problem: Problem, forces: jax.Array, wrench: jax.Array | None = None) -> jax.Array:
    """Whether G f = b, or another wrench (lanes, 6), moments over the grasp's size, by forces that can be; (lanes,)."""
    f, frames = forces, problem.frames
    pushes = frames[..., 0] * f[..., :1] + frames[..., 1] * f[..., 1:2] + frames[..., 2] * f[..., 2:3]
    size = problem.size[:, None]
    wanted = problem.wrench if wrench is None else wrench
    turns = cross(problem.positions, pushes, -1)
    if problem.arms is not None:
        turns = turns + frames[..., 2] * (problem.arms * f[..., 3])[..., None]
    moments = fold(jnp.add, jnp.moveaxis(turns, 1, 0))
    missing = jnp.concatenate(
        [fold(jnp.add, jnp.moveaxis(pushes, 1, 0)) - wanted[:, :3], (moments - wanted[:, 3:]) / size], -1
    )
    largest = jnp.maximum(_max(jnp.abs(wanted[:, :3])), _max(jnp.abs(wanted[:, 3:] / size)))
    if wrench is not None:
        # What a disturbance leaves of the load is rounded as the load itself is.
        load = problem.wrench
        largest = jnp.maximum(largest, jnp.maximum(_max(jnp.abs(load[:, :3])), _max(jnp.abs(load[:, 3:] / size))))
    # Forces that are nothing but rounding are none.
    largest = jnp.maximum(largest, _sum(jnp.sqrt(_sum(f * f))))
    largest = jnp.maximum(largest, _NOTHING[f.dtype.name] * _max(jnp.where(problem.present, problem.max_force, 0)))
    possible = _all((f == 0) | problem.transmits, 2)
    return possible & (_max(jnp.abs(missing)) <= MISSED[f.dtype.name] * largest)


def effort_unit(hand: Hand) -> jax.Array:
    """The larger limit of every actuator, (lanes, n_u); a millionth of the largest where it is less, 0 for example."""
    larger = jnp.maximum(jnp.abs(hand.upper), jnp.abs(hand.lower))
    return jnp.maximum(larger, 1e-6 * jnp.maximum(larger.max(-1, keepdims=True), 1e-6))


def _driven(hand: Hand, forces: jax.Array, efforts: jax.Array) -> jax.Array:
    """Whether J'f = B u, (lanes,)."""
    given = jnp.einsum("liav,lia->lv", hand.jacobian, forces, precision="highest")
    taken = jnp.einsum("...vu,...u->...v", hand.transmission, efforts, precision="highest")
    largest = jnp.einsum("liav,lia->lv", jnp.abs(hand.jacobian), jnp.abs(forces)).max(-1)
    largest = jnp.maximum(largest, jnp.einsum("...vu,...u->...v", jnp.abs(hand.transmission), jnp.abs(efforts)).max(-1))
    return jnp.abs(given - taken).max(-1) <= MISSED[forces.dtype.name] * largest


def _pulled(problem: Problem, cone: jax.Array, bound: jax.Array, y: jax.Array) -> jax.Array:
    """A'z + G'y, (lanes, n, k)."""
    patterns = facets(problem, edges_of(problem, cone))
    pull = fold(jnp.add, [cone[..., k, None] * patterns[k] for k in range(cone.shape[-1])])
    turned = y[:, None, :3] + cross(jnp.broadcast_to(y[:, None, 3:], problem.positions.shape), problem.positions, -1)
    frames = problem.frames
    along = frames[:, :, 0] * turned[..., :1] + frames[:, :, 1] * turned[..., 1:2] + frames[:, :, 2] * turned[..., 2:]
    normal = pull[..., 2] * problem.friction - bound
    residual = jnp.stack([pull[..., 0], pull[..., 1], normal], -1) + along
    if problem.arms is None:
        return residual
    turn = problem.arms * (frames[..., 2] * y[:, None, 3:]).sum(-1)
    return jnp.concatenate([residual, (pull[..., 3] + turn)[..., None]], -1)


def _held(problem: Problem, cone: jax.Array, bound: jax.Array) -> jax.Array:
    """Add up h'z of every contact, (lanes, n)."""
    assert problem.reserve is not None
    return bound * problem.max_force - _sum(cone * problem.reserve)


def _lost(problem: Problem, residual: jax.Array) -> jax.Array:
    """The most that r'f can be for the admissible forces of every contact, (lanes, n)."""
    residual = jnp.abs(residual)
    tangential = residual[..., 0] + residual[..., 1]
    for a in range(3, residual.shape[-1]):
        tangential = tangential + residual[..., a]
    tangential = tangential * problem.friction
    return (tangential + residual[..., 2]) * problem.max_force


def _upper_bound(problem: Problem, evidence: Evidence, rows: Rows) -> tuple[jax.Array, jax.Array]:
    """The bound that the multipliers prove, inf where none, and whether they prove that b cannot be borne; (lanes,)."""
    cone, bound, y = evidence.cone_multipliers, evidence.bound_multipliers, evidence.wrench_multipliers
    residual = _pulled(problem, cone, bound, y)
    pull = _sum(cone * rows.cone, 2) + _sum(bound * rows.bound)
    sound = (_min(cone, 2) >= 0) & (_min(bound) >= 0)
    value, more = _sum(problem.wrench * y), 0.0
    if problem.hand is not None:
        more, held, spent = _of_efforts(problem.hand, evidence, rows)
        pull, value = pull + held[0], value + held[1] + spent
        assert evidence.actuator_multipliers is not None
        sound &= _min(evidence.actuator_multipliers, 2) >= 0
    each = _held(problem, cone, bound) + _lost(problem, residual + more)
    value = value + _sum(jnp.where(problem.present, each, 0))
    bound = jnp.where(sound & (pull > 0), value / jnp.where(pull > 0, pull, 1), jnp.inf)
    return bound, sound & (value < 0)


def _of_efforts(hand: Hand, evidence: Evidence | Solution, rows: Rows) -> tuple:
    """What the multipliers of actuators and joints add: to r, (to z'sigma, to h'z), and the most that r_u'u can be."""
    z, y = evidence.actuator_multipliers, evidence.joint_multipliers
    assert z is not None and y is not None and rows.effort is not None
    more = jnp.einsum("liav,lv->lia", hand.jacobian, y, precision="highest")
    left = jnp.einsum("...vu,...v->...u", hand.transmission, y, precision="highest")
    residual = z[..., 0] - z[..., 1] - left
    pull = (z[..., 0] * rows.effort[:, 0] + z[..., 1] * rows.effort[:, 1]).sum(-1)
    value = (z[..., 0] * hand.upper - z[..., 1] * hand.lower).sum(-1)
    return more, (pull, value), (jnp.abs(residual) * effort_unit(hand)).sum(-1)


def _flat(solution: Solution, place: Range | None) -> jax.Array:
    """Where the margin cannot be positive: wrenches lie outside the range of G.

    Without S_1 and S_2 of its own the audit takes the solver's word for it, where the rank allows it.
    """
    return _claims_flat(solution) if place is None else place.disturbance_outside & place.rank_stands


def _claims_flat(solution: Solution) -> jax.Array:
    """Where the set is said to reach outside the range of G, (lanes,)."""
    return (solution.upper_bound == 0) & (solution.rank < 6)


def _outside(problem: Problem, solution: Solution, place: Range | None) -> jax.Array:
    """Where b lies outside the range of G, or of what G has left where contacts have no friction, (lanes,)."""
    slippery = _any((problem.friction < 1e-6) & problem.present)
    return slippery | (solution.rank < 6 if place is None else place.wrench_outside & place.rank_stands)


def _least(problem: Problem, solution: Solution, rows: Rows) -> jax.Array:
    """Whether no forces need less effort, by the multipliers of (22), (lanes,).

    1/2 f'Q_0 f >= min (1/2 f'Q_0 f + r'f) - h'z - b'y with r = A'z + G'y, for all admissible f.
    """
    dtype, there, forces, asked = solution.forces.dtype.name, problem.present, solution.forces, problem.margin
    cone, bound, y = solution.cone_multipliers, solution.bound_multipliers, solution.wrench_multipliers
    sound = (_min(cone, 2) >= 0) & (_min(bound) >= 0)
    residual = _pulled(problem, cone, bound, y)
    held = _sum(jnp.where(there, _held(problem, cone, bound), 0)) + _sum(problem.wrench * y)
    assert asked is not None
    held -= asked * (_sum(cone * rows.cone, 2) + _sum(bound * rows.bound))
    if problem.hand is not None:
        more, (pull, value), spent = _of_efforts(problem.hand, solution, rows)
        residual, held = residual + more, held + value + spent - pull * asked
        assert solution.actuator_multipliers is not None
        sound &= _min(solution.actuator_multipliers, 2) >= 0
    if problem.weights is None:
        largest, weighed, answered = 1.0, forces, residual
    else:
        both = problem.transmits[..., None] & problem.transmits[..., None, :]
        weights = jnp.where(both, problem.weights, jnp.eye(forces.shape[-1], dtype=forces.dtype))
        largest = _max(jnp.abs(weights), 2)
        weighed, answered = jnp.einsum("...ab,...b->...a", weights, forces), _divided(residual, weights)
    own = 0.5 * _sum(forces * weighed)
    # Of every contact the better of two bounds: without its limits, and by the tangent at f_0 within them.
    least = jnp.maximum(-0.5 * _sum(residual * answered), -own - _lost(problem, weighed + residual))
    effort, lower = (_sum(jnp.where(there, part, 0)) for part in (own, least))
    unit = _max(jnp.where(there, largest * problem.max_force**2, 0))
    near = CLOSED[dtype] * jnp.maximum(effort, 1e-3 * unit)
    return sound & (effort - (lower - held) <= near) & (jnp.abs(effort - solution.effort) <= near)


def _divided(vectors: jax.Array, matrices: jax.Array) -> jax.Array:
    """Q^-1 v for blocks (..., 3, 3), by their adjugates, or of another size."""
    if matrices.shape[-1] != 3:
        return linalg.solve_positive(matrices, vectors[..., None])[..., 0]
    a, b, c = matrices[..., 0, :], matrices[..., 1, :], matrices[..., 2, :]
    adjugate = jnp.stack([cross(b, c, -1), cross(c, a, -1), cross(a, b, -1)], -1)
    return jnp.einsum("...ab,...b->...a", adjugate, vectors) / (a * adjugate[..., 0]).sum(-1)[..., None]
