"""(21) and (22) for grasps in lanes: from scaled programs to answers with their bounds and statuses."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.robustness.auditing.pyramids import Evidence
from jaxgrasp.robustness.auditing.rows import Rows as WorstRows
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.interface.solution import Solution
from jaxgrasp.robustness.tightening.certificates import balanced, certified
from jaxgrasp.robustness.tightening.objectives import (
    LeastEffort,
    Objective,
    effort_of,
    effort_problem,
    margin_problem,
)
from jaxgrasp.robustness.tightening.points import centred
from jaxgrasp.robustness.tightening.program import Program, actuated_values
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.block.kkt import Record
from jaxgrasp.solvers.interior_point import Iterate, Settings
from jaxgrasp.solvers.status import Status

_SETTINGS = {
    "float64": Settings(
        tolerance=1e-8, max_iterations=40, step_cap=1e-4, mu_floor=0.0, equal_steps=False, safeguard=0.0, patience=8
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
# A gap that did not close to the tolerance still counts as solved below this one.
_ACCEPTED_GAP = {"float64": 1e-7, "float32": 1e-4}
# What a row of (22) may be missed by, in units of its largest force.
_ACCEPTED_MISS = {"float64": 1e-8, "float32": 1e-5}


def evidence(grasps: Grasps, program: Program, record: Record) -> Evidence:
    """What the audit needs beside the answer: the worst rows as they were solved, and what proves (21)'s bound."""
    unit = program.row_units() / program.scale
    cone_and_bound = jnp.where(program.undisturbed, 0, program.sigma * unit)
    effort = None
    if program.efforts is not None:
        effort = jnp.where(program.undisturbed, 0, program.efforts.sigma * (program.efforts.unit / program.scale))
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


def solve_margin(grasps: Grasps, program: Program) -> tuple[Solution, Record, Iterate]:
    """(21) for lanes; also the scaled record, from which (22) starts, and the last iterate."""
    dtype = program.rhs.dtype
    problem = margin_problem(program, grasps.options.cutoff)
    settings = _towards_centre(_SETTINGS[dtype.name], grasps, program, program.scale)
    outcome = interior_point.solve(problem, settings, grasps.valid & ~program.wrench_outside)
    point = balanced(program, problem, outcome.record.x)
    low, high = problem.attained(point.x), certified(program, problem, outcome.record)
    # No point met E x = b within the rows.
    low = jnp.where(jnp.isinf(outcome.record.lower), -jnp.inf, low)
    # Without a load, no forces at all are an answer with margin 0, exactly.
    accepted = _ACCEPTED_GAP[dtype.name]
    nothing = (low < 8 * jnp.finfo(dtype).eps) | ~point.exact & (low <= accepted)
    idle = (nothing | program.disturbance_outside) & _unloaded(grasps, program)
    low, exact = jnp.where(idle, 0, low), point.exact | idle
    size = jnp.maximum(1, jnp.abs(low))
    # The solver's own bound tells how far it came, the other one whether its rows were the right ones.
    came = jnp.where(jnp.isinf(low), 1, size)
    apart = lambda upper, unit: jnp.abs(upper - low) <= accepted * unit
    hopeless = jnp.maximum(low, high) < -settings.tolerance
    told = jnp.where(hopeless, came, _told(program.mean / program.scale, came))
    closed = exact & apart(outcome.record.upper, came) & apart(high, told)
    # Where bounds cross, rounding made one of them false: less is attained in any case, and more is certain.
    low, high = jnp.minimum(low, high), jnp.maximum(low, high)
    record = outcome.record._replace(lower=low, upper=high, x=tuple(jnp.where(idle, 0, x) for x in point.x))
    bearable = exact & (low >= -settings.tolerance)
    pruned = jnp.zeros_like(bearable) if problem.cutoff is None else high < problem.cutoff

    margin, upper = low * program.scale, high * program.scale
    margin = jnp.where(program.slippery, jnp.minimum(margin, 0), margin)
    upper = jnp.where(program.slippery, jnp.minimum(upper, 0), upper)
    upper = jnp.where(hopeless & jnp.isinf(low), 0, upper)
    margin = jnp.where(hopeless & ~closed | pruned & jnp.isinf(low), jnp.nan, margin)
    decided = [
        (~grasps.valid, Status.INVALID_INPUT, jnp.nan),
        (program.doubtful & program.wrench_outside, Status.ILL_CONDITIONED, jnp.nan),
        (program.wrench_outside, Status.INFEASIBLE, jnp.nan),
        (program.doubtful & program.disturbance_outside & bearable, Status.ILL_CONDITIONED, 0.0),
        (program.disturbance_outside & bearable, Status.SOLVED, 0.0),
        (program.slippery & idle & ~program.doubtful, Status.SOLVED, 0.0),
        (program.undisturbed & bearable, Status.UNBOUNDED, jnp.inf),
        ((program.disturbance_outside | program.undisturbed) & hopeless, Status.INFEASIBLE, jnp.nan),
    ]
    status = jnp.select(
        [c for c, _, _ in decided] + [hopeless, program.doubtful, bearable & closed, pruned],
        [s for _, s, _ in decided] + [Status.INFEASIBLE, Status.ILL_CONDITIONED, Status.SOLVED, Status.PRUNED],
        Status.MAX_ITERATIONS,
    ).astype(jnp.int32)
    margin = jnp.select([c for c, _, _ in decided], [jnp.full_like(low, m) for *_, m in decided], margin)
    upper = jnp.select([c for c, _, _ in decided], [jnp.full_like(low, m) for *_, m in decided], upper)

    answered = ~jnp.isnan(margin)
    forces = program.forces(record.x[0]) * program.blocks.present[:, None]
    scale = program.scale
    # Where the program's optimum is not the margin, its multipliers say nothing.
    told = ~(program.disturbance_outside | program.undisturbed | program.slippery & ((low > 0) | idle))
    multipliers = jnp.where(told, record.z[0] * scale / program.row_units(), 0)
    actuated = actuated_values(program, record.x, record, grasps.units, scale)
    for name, value in actuated.items():
        is_primal = name == "actuator_efforts"
        actuated[name] = jnp.where(answered, value, jnp.nan) if is_primal else jnp.where(told, value, 0)
    solution = Solution(
        margin=margin,
        upper_bound=upper,
        forces=jnp.where(answered, forces, jnp.nan),
        effort=jnp.where(answered, effort_of(forces, None), jnp.nan),
        status=status,
        iterations=outcome.iterations,
        primal_residual=jnp.where(answered, problem.violations(record.x, low), jnp.nan),
        dual_residual=_largest(outcome.residuals.dual[0]),
        gap=jnp.where(answered, (high - low) / size, jnp.nan),
        rank=program.rank,
        cone_multipliers=jnp.moveaxis(multipliers[:-1], 0, 1),
        bound_multipliers=multipliers[-1],
        wrench_multipliers=jnp.where(told, program.wrench_multipliers(record.y, grasps.units) * scale, 0),
        **actuated,
    )
    return solution, record, outcome.iterate


def _told(strength: jax.Array, size: jax.Array) -> jax.Array:
    """What the accepted gap of proven bounds is a share of: the mean largest force, or the size of the margin.

    float32 proves bounds less closely than it finds margins, so there the smaller one counts, for disturbances of a
    newton; of far weaker ones the margin is so large that nothing but its size can count. Of loads that cannot be
    borne the proof stands without the margin, whose size counts alone.
    """
    return jnp.maximum(strength, size) if strength.dtype == jnp.float64 else jnp.maximum(0.8 * strength, size / 8)


def _unloaded(grasps: Grasps, program: Program) -> jax.Array:
    """Where no forces at all meet every row, but for the disturbances."""
    idle = (program.rhs == 0).all(0) & (grasps.reserve == 0)
    return idle if program.efforts is None else idle & (program.efforts.h >= 0).all((0, 1))


def _towards_centre(settings: Settings, grasps: Grasps, program: Program, unit: jax.Array) -> Settings:
    """Where smoothing is asked for, the loop aims at the central point, whose gap is kappa for every row."""
    if grasps.options.smoothing is None:
        return settings
    kappa = grasps.options.smoothing / unit
    rows = program.sigma.shape[0] * fold(jnp.add, grasps.present)
    if program.efforts is not None:
        rows = rows + program.efforts.h.shape[0] * program.efforts.h.shape[1]
    gap = kappa * rows
    return settings._replace(gap_floor=1.5 * gap, mu_floor=kappa)


def at_centre(
    objective: Objective, grasps: Grasps, program: Program, iterate: Iterate, solution: Solution, possible: jax.Array
) -> Solution:
    """The solution with the central point in place of the best one; solved where that is found."""
    point = centred(objective, grasps, program, iterate, possible)
    margin = jnp.where(program.slippery, jnp.minimum(point.margin, 0), point.margin)
    values = point._replace(margin=margin)._asdict()
    found = values.pop("usable")
    kept = {
        name: jnp.where(found, value, getattr(solution, name)) for name, value in values.items() if value is not None
    }
    proven = (solution.status == Status.INFEASIBLE) | (solution.status == Status.ILL_CONDITIONED)
    status = jnp.where(found & ~proven, Status.SOLVED, solution.status)
    status = jnp.where(possible & ~found & ~proven, Status.MAX_ITERATIONS, status)
    return replace(solution, **kept, status=status)


def _largest(rows: tuple) -> jax.Array:
    return fold(jnp.maximum, [fold(jnp.maximum, fold(jnp.maximum, jnp.abs(group))) for group in rows])


def solve_effort(grasps: Grasps, program: Program, first: Solution, record: Record) -> Solution:
    """(22) for lanes, from what (21) left."""
    dtype, blocks = program.rhs.dtype, program.blocks
    problem, wanted, unit = effort_problem(grasps, program)
    settings = _towards_centre(_EFFORT_SETTINGS[dtype.name], grasps, program, unit**2)
    assert grasps.options.margin is not None
    reachable = grasps.options.margin <= first.upper_bound * (1 + settings.tolerance)
    held = (reachable & jnp.isfinite(record.lower)) | program.undisturbed

    # Between (21)'s answer and its start, which is deep inside the rows, but for those that the margin asks for.
    largest = margin_problem(program)
    centre = largest.start().x[0]
    attained = largest.attained(centre)
    # Where the start misses rows that lambda does not move, it attains nothing.
    share = (wanted - attained) / jnp.maximum(record.lower - attained, 1e-3)
    share = 0.5 * (1 + jnp.where(jnp.isfinite(attained), jnp.clip(share, 0, 1), 0))
    problem = replace(problem, guess=tuple(share * x + (1 - share) * c for x, c in zip(record.x, centre, strict=True)))
    hopeless = first.status == Status.INFEASIBLE
    active = grasps.valid & ~program.wrench_outside & held & ~hopeless
    # Without a load and a margin no forces at all are the answer, exactly.
    idle = active & _unloaded(grasps, program) & (wanted == 0)
    outcome = interior_point.solve(problem, settings, active & ~idle)
    best = jax.tree.map(lambda x: jnp.where(idle, 0, x), outcome.record)
    point = balanced(program, problem, best.x)
    best = best._replace(x=tuple(jnp.where(idle, 0, x) for x in point.x))
    gap, accepted = (best.upper - best.lower) / problem.gap_scale(best), _ACCEPTED_GAP[dtype.name]
    attained = largest.attained(best.x)
    missed = problem.violations(best.x, jnp.zeros_like(wanted))
    closed = point.exact & (missed <= _ACCEPTED_MISS[dtype.name]) & (jnp.abs(gap) <= accepted)
    # The upper bound is part of the answer.
    told = accepted * _told(program.mean, jnp.maximum(program.scale, jnp.abs(first.margin)))
    closed &= (first.upper_bound - first.margin <= told) | program.undisturbed
    # A row that lambda hardly moves turns the little that it is missed by into much of lambda.
    attained = jnp.where(closed, jnp.maximum(attained, wanted), attained)

    out_of_reach = hopeless | ~reachable & ~program.undisturbed
    status = jnp.select(
        [~grasps.valid, hopeless, program.doubtful, out_of_reach, active & closed],
        [Status.INVALID_INPUT, Status.INFEASIBLE, Status.ILL_CONDITIONED, Status.INFEASIBLE, Status.SOLVED],
        Status.MAX_ITERATIONS,
    ).astype(jnp.int32)
    answered = active & jnp.isfinite(best.upper)
    hide = lambda x: jnp.where(answered, x, jnp.nan)
    attained = jnp.where(program.undisturbed, jnp.inf, attained * program.scale)
    attained = jnp.where(program.disturbance_outside | program.slippery, 0, attained)
    forces = program.forces(best.x[0]) * blocks.present[:, None]
    multipliers = best.z[0] * unit**2 / program.row_units()
    solution = Solution(
        margin=hide(jnp.where(attained > first.upper_bound, first.upper_bound, attained)),
        upper_bound=first.upper_bound,
        forces=hide(forces),
        effort=hide(effort_of(forces, grasps.options.effort_weights)),
        status=status,
        iterations=first.iterations + outcome.iterations,
        primal_residual=hide(missed),
        dual_residual=hide(_largest(outcome.residuals.dual)),
        gap=hide(gap),
        rank=program.rank,
        cone_multipliers=jnp.moveaxis(multipliers[:-1], 0, 1),
        bound_multipliers=multipliers[-1],
        wrench_multipliers=program.wrench_multipliers(best.y, grasps.units) * unit**2,
        **{name: hide(value) for name, value in actuated_values(program, best.x, best, grasps.units, unit**2).items()},
    )
    if grasps.options.smoothing is None:
        return solution
    return at_centre(LeastEffort(), grasps, program, outcome.iterate, solution, active & ~idle)
