"""(21) and (22) for grasps in lanes: from scaled programs to solutions with their bounds and statuses."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.robustness.auditing.multipliers import Evidence
from jaxgrasp.robustness.auditing.rows import Rows as WorstRows
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.interface.solution import Solution
from jaxgrasp.robustness.tightening.certificates import balance, certify
from jaxgrasp.robustness.tightening.objectives import (
    LeastEffort,
    Objective,
    compute_effort,
    effort_problem,
    margin_problem,
)
from jaxgrasp.robustness.tightening.points import find_central_point
from jaxgrasp.robustness.tightening.program import ScaledProgram, actuated_values
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.block.kkt import Record, Rows
from jaxgrasp.solvers.block.margin import MarginProblem
from jaxgrasp.solvers.interior_point import Iterate, Outcome, Settings
from jaxgrasp.solvers.status import Status

# A gap that did not close to the tolerance still counts as closed below this one.
_ACCEPTED_GAP = {"float64": 1e-7, "float32": 1e-4}
_MARGIN_SETTINGS = {
    "float64": Settings(
        tolerance=1e-8,
        max_iterations=60,
        step_cap=1e-4,
        mu_floor=0.0,
        equal_steps=False,
        safeguard=0.0,
        patience=8,
        accepted=_ACCEPTED_GAP["float64"],
    ),
    "float32": Settings(
        tolerance=5e-6, max_iterations=40, step_cap=1e-3, mu_floor=3e-8, equal_steps=True, safeguard=1e-3, patience=5
    ),
}
_EFFORT_SETTINGS = {
    "float64": Settings(
        tolerance=1e-8, max_iterations=40, step_cap=1e-4, mu_floor=0.0, equal_steps=True, safeguard=1e-4, patience=8
    ),
    "float32": Settings(
        tolerance=1e-4,
        max_iterations=40,
        step_cap=1e-3,
        mu_floor=1e-10,
        equal_steps=True,
        safeguard=1e-3,
        patience=5,
        gap_share=0.1,
    ),
}
# What a row of (22) may be missed by, in units of its largest force.
_ACCEPTED_MISS = {"float64": 1e-8, "float32": 1e-5}


def evidence(grasps: Grasps, program: ScaledProgram, record: Record) -> Evidence:
    """The evidence for the audit: the worst rows as they were solved, and the multipliers that prove (21)'s bound."""
    unit = program.row_units() / program.scale
    cone_and_bound = jnp.where(program.undisturbed, 0, program.sigma * unit)
    effort = None
    if program.actuators is not None:
        effort = jnp.where(program.undisturbed, 0, program.actuators.sigma * (program.actuators.unit / program.scale))
    multipliers = record.z[0] * program.scale / program.row_units()
    actuated = actuated_values(program, record.x, record, grasps.units, program.scale)
    return Evidence(
        WorstRows(jnp.moveaxis(cone_and_bound[:-1], 0, 1), cone_and_bound[-1], effort),
        jnp.moveaxis(multipliers[:-1], 0, 1),
        multipliers[-1],
        program.wrench_multipliers(record.y, grasps.units) * program.scale,
        actuated.get("actuator_multipliers"),
        actuated.get("joint_multipliers"),
    )


class Case(NamedTuple):
    """A row of a decision table, of which the first one that applies counts."""

    when: jax.Array
    """bool (*lanes)."""
    status: Status
    """The status that a lane then has."""
    margin: float | None = None
    """The margin, and its upper bound, that is then certain; None where the bounds that were found stand."""


class _Found(NamedTuple):
    """The state of (21) when the loop is over; scaled, lanes trail.

    low, high: bounds of the margin.
    size: the unit of their gap, the larger of 1 and |low|.
    x: forces and actuator efforts that attain `low`.
    forceless: bool, without a load no forces at all are an answer, with margin 0.
    closed: bool, the bounds are close and the rows were the right ones.
    hopeless: bool, even b cannot be borne.
    bearable: bool, b can be borne.
    pruned: bool, the margin is below the cutoff.
    """

    low: jax.Array
    high: jax.Array
    size: jax.Array
    x: Rows
    forceless: jax.Array
    closed: jax.Array
    hopeless: jax.Array
    bearable: jax.Array
    pruned: jax.Array


def solve_margin(grasps: Grasps, program: ScaledProgram) -> tuple[Solution, Record, Iterate]:
    """Solve (21) for lanes; also the scaled record, from which (22) starts, and the last iterate."""
    problem = margin_problem(program, grasps.options.cutoff)
    settings = _towards_centre(_MARGIN_SETTINGS[program.rhs.dtype.name], grasps, program, program.scale)
    outcome = interior_point.solve(problem, settings, grasps.valid & ~program.wrench_outside)
    found = _assess_margin(grasps, program, problem, outcome, settings.tolerance)
    record = outcome.record._replace(lower=found.low, upper=found.high, x=found.x)

    # Margin and bound in units of the disturbances.
    low, scale = found.low, program.scale
    margin, upper = low * scale, found.high * scale
    upper = jnp.where(found.hopeless & jnp.isinf(low), 0, upper)
    unknown = found.hopeless & ~found.closed | found.pruned & jnp.isinf(low)
    margin = jnp.where(unknown, jnp.nan, margin)
    cases = margin_cases(grasps, program, found)
    status = _first([(case.when, case.status) for case in cases], Status.MAX_ITERATIONS).astype(jnp.int32)
    certain = [(case.when, jnp.full_like(low, case.margin)) for case in cases if case.margin is not None]
    margin, upper = _first(certain, margin), _first(certain, upper)

    # Where the program's optimum is not the margin, its multipliers say nothing.
    has_margin = ~jnp.isnan(margin)
    where_margin = lambda x: jnp.where(has_margin, x, jnp.nan)
    forces = program.forces(record.x[0]) * program.blocks.present[:, None]
    other = program.disturbance_outside | program.undisturbed
    where_optimal = lambda x: jnp.where(~other, x, 0)
    multipliers = where_optimal(record.z[0] * scale / program.row_units())
    actuated = actuated_values(program, record.x, record, grasps.units, scale)
    for name, value in actuated.items():
        actuated[name] = where_margin(value) if name == "actuator_efforts" else where_optimal(value)
    solution = Solution(
        margin=margin,
        upper_bound=upper,
        forces=where_margin(forces),
        effort=where_margin(compute_effort(forces, None)),
        status=status,
        iterations=outcome.iterations,
        primal_residual=where_margin(problem.violations(record.x, low)),
        dual_residual=_largest(outcome.residuals.dual[0]),
        gap=where_margin((found.high - low) / found.size),
        rank=program.rank,
        cone_multipliers=jnp.moveaxis(multipliers[:-1], 0, 1),
        bound_multipliers=multipliers[-1],
        wrench_multipliers=where_optimal(program.wrench_multipliers(record.y, grasps.units) * scale),
        **actuated,
    )
    return solution, record, outcome.iterate


def margin_cases(grasps: Grasps, program: ScaledProgram, found: _Found) -> list[Case]:
    """The decision table of (21); a lane for which no case applies ran out of iterations."""
    flat = program.disturbance_outside
    return [
        Case(~grasps.valid, Status.INVALID_INPUT, jnp.nan),
        Case(program.doubtful & program.wrench_outside, Status.ILL_CONDITIONED, jnp.nan),
        Case(program.wrench_outside, Status.INFEASIBLE, jnp.nan),
        Case(program.doubtful & flat & found.bearable, Status.ILL_CONDITIONED, 0.0),
        Case(flat & found.bearable, Status.SOLVED, 0.0),
        Case(program.undisturbed & found.bearable, Status.UNBOUNDED, jnp.inf),
        Case((flat | program.undisturbed) & found.hopeless, Status.INFEASIBLE, jnp.nan),
        Case(found.hopeless, Status.INFEASIBLE),
        Case(program.doubtful, Status.ILL_CONDITIONED),
        Case(found.bearable & found.closed, Status.SOLVED),
        Case(found.pruned, Status.PRUNED),
    ]


def _first(cases: list[tuple[jax.Array, Any]], otherwise: Any) -> jax.Array:
    """The value of the first case that applies."""
    return jnp.select([when for when, _ in cases], [value for _, value in cases], otherwise)


def _assess_margin(
    grasps: Grasps, program: ScaledProgram, problem: MarginProblem, outcome: Outcome, tolerance: float
) -> _Found:
    """Hold what the loop of (21) left against the rows as they came."""
    dtype = program.rhs.dtype
    accepted, best = _ACCEPTED_GAP[dtype.name], outcome.record
    point = balance(program, problem, best.x)
    low, high = problem.attained(point.x), certify(program, problem, best)
    # No point met E x = b within the rows.
    low = jnp.where(jnp.isinf(best.lower), -jnp.inf, low)
    # Without a load, no forces at all are an answer with margin 0, exactly.
    nothing = (low < 8 * jnp.finfo(dtype).eps) | ~point.exact & (low <= accepted)
    forceless = (nothing | program.disturbance_outside) & _unloaded(grasps, program)
    low, exact = jnp.where(forceless, 0, low), point.exact | forceless

    # The solver's own bound tells how far it came, the other one whether its rows were the right ones.
    size = jnp.maximum(1, jnp.abs(low))
    unit = jnp.where(jnp.isinf(low), 1, size)
    near = lambda upper, unit: jnp.abs(upper - low) <= accepted * unit
    hopeless = jnp.maximum(low, high) < -tolerance
    proof_unit = jnp.where(hopeless, unit, _gap_unit(program.mean / program.scale, unit))
    closed = exact & near(best.upper, unit) & near(high, proof_unit)
    # Where bounds cross, rounding made one of them false: less is attained in any case, and more is certain.
    low, high = jnp.minimum(low, high), jnp.maximum(low, high)
    bearable = exact & (low >= -tolerance)
    return _Found(
        low=low,
        high=high,
        size=size,
        x=tuple(jnp.where(forceless, 0, x) for x in point.x),
        forceless=forceless,
        closed=closed,
        hopeless=hopeless,
        bearable=bearable,
        pruned=jnp.zeros_like(bearable) if problem.cutoff is None else high < problem.cutoff,
    )


def _gap_unit(strength: jax.Array, size: jax.Array) -> jax.Array:
    """The unit of the gap that proven bounds may have: the mean largest force, or the size of the margin.

    float32 proves bounds less closely than it finds margins, so there the smaller one counts, for disturbances of a
    newton; of far weaker ones the margin is so large that nothing but its size can count. That a load cannot be borne
    is proven without the margin, whose size counts alone.
    """
    return jnp.maximum(strength, size) if strength.dtype == jnp.float64 else jnp.maximum(0.8 * strength, size / 8)


def _unloaded(grasps: Grasps, program: ScaledProgram) -> jax.Array:
    """Whether no forces at all meet every row, but for the disturbances, (*lanes)."""
    unloaded = (program.rhs == 0).all(0) & grasps.reserves_nothing
    return unloaded if program.actuators is None else unloaded & (program.actuators.h >= 0).all((0, 1))


def _towards_centre(settings: Settings, grasps: Grasps, program: ScaledProgram, unit: jax.Array) -> Settings:
    """Settings with which the loop aims at the central point, whose gap is kappa for every row, if one is asked for."""
    if grasps.options.smoothing is None:
        return settings
    kappa = grasps.options.smoothing / unit
    rows = program.sigma.shape[0] * fold(jnp.add, grasps.present)
    if program.actuators is not None:
        rows = rows + program.actuators.h.shape[0] * program.actuators.h.shape[1]
    gap = kappa * rows
    return settings._replace(gap_floor=1.5 * gap, mu_floor=kappa)


def at_centre(
    objective: Objective,
    grasps: Grasps,
    program: ScaledProgram,
    iterate: Iterate,
    solution: Solution,
    possible: jax.Array,
) -> Solution:
    """Put the central point in place of the best one; the lane is solved where it is found."""
    point = find_central_point(objective, grasps, program, iterate, possible)
    values = point._asdict()
    found = values.pop("usable")
    changed = {
        name: jnp.where(found, value, getattr(solution, name)) for name, value in values.items() if value is not None
    }
    proven = (solution.status == Status.INFEASIBLE) | (solution.status == Status.ILL_CONDITIONED)
    status = jnp.where(found & ~proven, Status.SOLVED, solution.status)
    status = jnp.where(possible & ~found & ~proven, Status.MAX_ITERATIONS, status)
    return replace(solution, **changed, status=status)


def _largest(rows: tuple) -> jax.Array:
    return fold(jnp.maximum, [fold(jnp.maximum, fold(jnp.maximum, jnp.abs(group))) for group in rows])


def solve_effort(grasps: Grasps, program: ScaledProgram, first: Solution, record: Record) -> Solution:
    """Solve (22) for lanes, from what (21) left."""
    dtype, asked = program.rhs.dtype, grasps.options.margin
    assert asked is not None
    problem, wanted, unit = effort_problem(grasps, program)
    settings = _towards_centre(_EFFORT_SETTINGS[dtype.name], grasps, program, unit**2)

    # Lanes whose margin is within (21)'s bound; without a load and a margin no forces at all are the answer, exactly.
    reachable = asked <= first.upper_bound * (1 + settings.tolerance)
    has_start = (reachable & jnp.isfinite(record.lower)) | program.undisturbed
    largest = margin_problem(program)
    problem = replace(problem, guess=_effort_guess(largest, record, wanted))
    hopeless = first.status == Status.INFEASIBLE
    active = grasps.valid & ~program.wrench_outside & has_start & ~hopeless
    forceless = active & _unloaded(grasps, program) & (wanted == 0)
    outcome = interior_point.solve(problem, settings, active & ~forceless)
    best = jax.tree.map(lambda x: jnp.where(forceless, 0, x), outcome.record)
    point = balance(program, problem, best.x)
    best = best._replace(x=tuple(jnp.where(forceless, 0, x) for x in point.x))

    # What the forces attain, and whether no others do with less.
    gap = (best.upper - best.lower) / problem.gap_scale(best)
    attained = largest.attained(best.x)
    missed = problem.violations(best.x, jnp.zeros_like(wanted))
    closed = point.exact & (missed <= _ACCEPTED_MISS[dtype.name]) & (jnp.abs(gap) <= _ACCEPTED_GAP[dtype.name])
    closed &= _margin_closed(program, first)
    # A row that lambda hardly moves turns the little that it is missed by into much of lambda.
    attained = jnp.where(closed, jnp.maximum(attained, wanted), attained)
    cases = effort_cases(grasps, program, hopeless, reachable, active, closed)
    status = _first([(case.when, case.status) for case in cases], Status.MAX_ITERATIONS).astype(jnp.int32)

    has_forces = active & jnp.isfinite(best.upper)
    where_forces = lambda x: jnp.where(has_forces, x, jnp.nan)
    attained = jnp.where(program.undisturbed, jnp.inf, attained * program.scale)
    attained = jnp.where(program.disturbance_outside, 0, attained)
    forces = program.forces(best.x[0]) * program.blocks.present[:, None]
    multipliers = best.z[0] * unit**2 / program.row_units()
    actuated = actuated_values(program, best.x, best, grasps.units, unit**2)
    solution = Solution(
        margin=where_forces(jnp.where(attained > first.upper_bound, first.upper_bound, attained)),
        upper_bound=first.upper_bound,
        forces=where_forces(forces),
        effort=where_forces(compute_effort(forces, grasps.options.effort_weights)),
        status=status,
        iterations=first.iterations + outcome.iterations,
        primal_residual=where_forces(missed),
        dual_residual=where_forces(_largest(outcome.residuals.dual)),
        gap=where_forces(gap),
        rank=program.rank,
        cone_multipliers=jnp.moveaxis(multipliers[:-1], 0, 1),
        bound_multipliers=multipliers[-1],
        wrench_multipliers=program.wrench_multipliers(best.y, grasps.units) * unit**2,
        **{name: where_forces(value) for name, value in actuated.items()},
    )
    if grasps.options.smoothing is None:
        return solution
    return at_centre(LeastEffort(), grasps, program, outcome.iterate, solution, active & ~forceless)


def effort_cases(
    grasps: Grasps,
    program: ScaledProgram,
    hopeless: jax.Array,
    reachable: jax.Array,
    active: jax.Array,
    closed: jax.Array,
) -> list[Case]:
    """The decision table of (22); a lane for which no case applies ran out of iterations.

    Args:
        grasps: the grasps.
        program: their scaled programs.
        hopeless: even b cannot be borne.
        reachable: the margin that is asked for is within (21)'s bound.
        active: (22) was solved.
        closed: the bounds are close and the rows were the right ones.
    """
    out_of_reach = hopeless | ~reachable & ~program.undisturbed
    return [
        Case(~grasps.valid, Status.INVALID_INPUT),
        Case(hopeless, Status.INFEASIBLE),
        Case(program.doubtful, Status.ILL_CONDITIONED),
        Case(out_of_reach, Status.INFEASIBLE),
        Case(active & closed, Status.SOLVED),
    ]


def _margin_closed(program: ScaledProgram, first: Solution) -> jax.Array:
    """Whether the bounds of (21), of which the upper one is part of (22)'s solution, are close, (*lanes)."""
    gap = _ACCEPTED_GAP[program.rhs.dtype.name] * _gap_unit(
        program.mean, jnp.maximum(program.scale, jnp.abs(first.margin))
    )
    return (first.upper_bound - first.margin <= gap) | program.undisturbed


def _effort_guess(largest: MarginProblem, record: Record, wanted: jax.Array) -> Rows:
    """Forces between (21)'s solution and its start, which is deep inside the rows but for the wanted margin."""
    start = largest.start().x[0]
    attained = largest.attained(start)
    # Where the start misses rows that lambda does not move, it attains nothing.
    share = (wanted - attained) / jnp.maximum(record.lower - attained, 1e-3)
    share = 0.5 * (1 + jnp.where(jnp.isfinite(attained), jnp.clip(share, 0, 1), 0))
    return tuple(share * x + (1 - share) * c for x, c in zip(record.x, start, strict=True))
