"""The audit of (21) and (22): what their answers claim, against the public arguments.

Forces f_0, checked against G f_0 = b and the rows, prove a margin from below. Multipliers z >= 0 of the rows and y of
G f = b prove one from above, whatever they are: for every admissible f with lambda >= 0,

    lambda (z'sigma) <= h'z + b'y - r'f,  r = A'z + G'y,

with rows A f + sigma lambda <= h, and |f_t| <= mu f_max, |f_n| <= f_max bound r'f.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.robustness.auditing import hidden
from jaxgrasp.robustness.auditing.multipliers import (
    CLOSED,
    Evidence,
    effort_unit,
    needs_no_less,
    proven_bounds,
    reserves,
    weighed_sum,
)
from jaxgrasp.robustness.auditing.parts import (
    all_last,
    any_last,
    cross,
    inner,
    max_last,
    min_last,
    once,
    parts_of,
    sum_last,
)
from jaxgrasp.robustness.auditing.problem import Hand, Problem, edges_of, facets, problem_of
from jaxgrasp.robustness.auditing.rows import Range, Rows, own_rows
from jaxgrasp.robustness.interface.arguments import Arguments
from jaxgrasp.robustness.interface.solution import Solution
from jaxgrasp.solvers.status import Status

# Shares of the largest force by which rows and G f = b may be missed. An answer counts as wrong at twice as much.
MISSED = {"float64": 5e-8, "float32": 1.5e-5}
# Forces below this share of the largest are rounding.
_NOTHING = {"float64": 1e-15, "float32": 1e-6}


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
    taken = jnp.maximum(max_last(used.cone) / jnp.where(problem.friction > 0, problem.friction, jnp.inf), used.bound)
    taken = max_last(jnp.where(there, taken / force, 0))
    margin = jnp.where(jnp.isfinite(solution.margin), jnp.abs(solution.margin), 0)
    margin = jnp.maximum(margin, jnp.where(taken > 0, 1 / jnp.where(taken > 0, taken, 1), 0))[:, None]
    near = 4 * MISSED[margin.dtype.name]
    apart = margin * jnp.maximum(max_last(jnp.abs(rows.cone - used.cone)), jnp.abs(rows.bound - used.bound))
    right = all_last((apart <= near * force) | ~there) & place.rank_stands
    if problem.hand is not None:
        assert rows.effort is not None and used.effort is not None
        right &= (margin * jnp.abs(rows.effort - used.effort).max(1) <= near * effort_unit(problem.hand)).all(-1)
    # Where the set is said to reach outside, and multipliers do not bound the margin.
    proven = proven_bounds(problem, evidence, used)[0]
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
    proven, refuted = proven_bounds(problem, evidence, rows)
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
        solved &= upper - margin <= slack if asked is None else needs_no_less(problem, solution, rows)
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
    mean = sum_last(problem.max_force * present) / jnp.maximum(sum_last(present), 1)
    largest = rows_size(rows)
    return jnp.where(largest > 0, mean / jnp.where(largest > 0, largest, 1), 1)


def rows_size(rows: Rows) -> jax.Array:
    """The most that any row loses, (lanes,)."""
    most = jnp.maximum(max_last(rows.cone, 2), max_last(rows.bound))
    return most if rows.effort is None else jnp.maximum(most, max_last(rows.effort, 2))


def _primal(problem: Problem, solution: Solution, rows: Rows) -> tuple[jax.Array, jax.Array]:
    """Whether G f_0 = b, and the margin that f_0 attains, -inf where a row fails that nothing disturbs; (lanes,)."""
    forces, missed = solution.forces, MISSED[solution.forces.dtype.name]

    @once
    def attained(problem: Problem, forces: jax.Array, rows: Rows) -> jax.Array:
        """By every contact, (lanes, n)."""
        slack = missed * problem.max_force
        cone, bound = row_values(problem, forces, edges_of(problem, rows.cone))
        reserve = reserves(problem, len(cone))
        parts = [_most(slack - reserve[k] - row, rows.cone[..., k]) for k, row in enumerate(cone)]
        parts += [_most(problem.max_force + slack - bound, rows.bound)]
        return jnp.where(problem.present, fold(jnp.minimum, parts), jnp.inf)

    most, holds = min_last(attained(problem, forces, rows)), balanced(problem, forces)
    if problem.hand is not None:
        efforts, slack = solution.actuator_efforts, missed * effort_unit(problem.hand)
        assert efforts is not None and rows.effort is not None
        spare = jnp.stack([problem.hand.upper + slack - efforts, efforts - problem.hand.lower + slack], 1)
        most = jnp.minimum(most, min_last(_most(spare, rows.effort), 2))
        holds &= _driven(problem.hand, forces, efforts)
    return holds, most


def _most(spare: jax.Array, loss: jax.Array) -> jax.Array:
    """The largest lambda with lambda loss <= spare, of every row."""
    moved = loss > 0
    still = jnp.where(spare >= 0, jnp.inf, -jnp.inf)
    return jnp.where(moved, spare / jnp.where(moved, loss, 1), still)


def row_values(problem: Problem, forces: jax.Array, cone_edges: int) -> tuple[list[jax.Array], jax.Array]:
    """C f of every facet, and -f_n, (lanes, n) each."""
    pressed = parts_of(forces)
    pressed[2] = problem.friction * pressed[2]
    return [weighed_sum(facet, pressed) for facet in facets(problem, cone_edges)], -forces[..., 2]


def balanced(problem: Problem, forces: jax.Array, wrench: jax.Array | None = None) -> jax.Array:
    """Whether G f = b, or another wrench (lanes, 6), moments over the grasp's size, by forces that can be; (lanes,)."""

    @once
    def turned(problem: Problem, forces: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Forces in the object's frame, (lanes, n, 3), their sizes, and whether contacts can have them, (lanes, n)."""
        acting = jnp.where(problem.transmits, forces, 0)
        columns = [problem.frames[..., k] * acting[..., k : k + 1] for k in range(3)]
        pushes = jnp.where(problem.present[..., None], fold(jnp.add, columns), 0)
        f = parts_of(forces)
        return pushes, jnp.sqrt(inner(f, f)), all_last((forces == 0) | problem.transmits)

    @once
    def moments(problem: Problem, pushes: jax.Array, forces: jax.Array | None) -> list[jax.Array]:
        turns = cross(parts_of(problem.positions), parts_of(pushes))
        if problem.arms is not None and forces is not None:
            twist = jnp.where(problem.transmits[..., 3], problem.arms * forces[..., 3], 0)
            turns = [x + n * twist for x, n in zip(turns, parts_of(problem.frames[..., 2]), strict=True)]
        return [jnp.where(problem.present, x, 0) for x in turns]

    pushes, sizes, possible = turned(problem, forces)
    soft = None if problem.arms is None else forces
    given = [sum_last(part) for part in parts_of(pushes) + moments(problem, pushes, soft)]
    in_newtons = lambda parts: parts[:3] + [moment / problem.size for moment in parts[3:]]
    load = in_newtons(parts_of(problem.wrench))
    wanted = load if wrench is None else in_newtons(parts_of(wrench))
    given = in_newtons(given)
    missing = fold(jnp.maximum, [jnp.abs(have - want) for have, want in zip(given, wanted, strict=True)])
    # What a disturbance leaves of the load is rounded as the load itself is.
    largest = fold(jnp.maximum, [jnp.abs(part) for part in (wanted if wrench is None else wanted + load)])
    # Forces that are nothing but rounding are none.
    largest = jnp.maximum(largest, sum_last(sizes))
    largest = jnp.maximum(
        largest, _NOTHING[forces.dtype.name] * max_last(jnp.where(problem.present, problem.max_force, 0))
    )
    return all_last(possible) & (missing <= MISSED[forces.dtype.name] * largest)


def _driven(hand: Hand, forces: jax.Array, efforts: jax.Array) -> jax.Array:
    """Whether J'f = B u, (lanes,)."""
    given = jnp.einsum("liav,lia->lv", hand.jacobian, forces, precision="highest")
    taken = jnp.einsum("...vu,...u->...v", hand.transmission, efforts, precision="highest")
    largest = jnp.einsum("liav,lia->lv", jnp.abs(hand.jacobian), jnp.abs(forces)).max(-1)
    largest = jnp.maximum(largest, jnp.einsum("...vu,...u->...v", jnp.abs(hand.transmission), jnp.abs(efforts)).max(-1))
    return jnp.abs(given - taken).max(-1) <= MISSED[forces.dtype.name] * largest


def _flat(solution: Solution, place: Range | None) -> jax.Array:
    """Where the margin cannot be positive: wrenches lie outside the range of G.

    Without S_1 and S_2 of its own the audit takes the solver's word for it, where the rank allows it.
    """
    return _claims_flat(solution) if place is None else place.disturbance_outside & place.rank_stands


def _claims_flat(solution: Solution) -> jax.Array:
    """Where the set is said to reach outside the range of G, (lanes,)."""
    return (solution.upper_bound == 0) & (solution.rank < 6)


def _outside(problem: Problem, solution: Solution, place: Range | None) -> jax.Array:
    """Where b lies outside the range of G, or of what G has left where contacts have hardly any friction, (lanes,)."""
    slippery = any_last((problem.friction < 1e-6) & problem.present)
    return slippery | (solution.rank < 6 if place is None else place.wrench_outside & place.rank_stands)
