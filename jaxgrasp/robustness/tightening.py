"""Tightening forces: the largest-minimum resisted disturbance (21) and the least effort (22)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxgrasp.arrays import fold
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.robustness.arguments import Arguments
from jaxgrasp.robustness.auditing import Audited
from jaxgrasp.robustness.auditing.pyramids import Evidence, Verdict, corrected, judge, spot
from jaxgrasp.robustness.auditing.rows import Rows as WorstRows
from jaxgrasp.robustness.certificates import balanced, certified
from jaxgrasp.robustness.derivatives import CentralPoint, Point, central_kappa, centred, envelope_adjoint
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.kernels import Along, OfPyramids
from jaxgrasp.robustness.problems import effort_of, effort_problem, margin_problem
from jaxgrasp.robustness.program import Program, actuated_values, prepared
from jaxgrasp.robustness.solution import Solution
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.block_kkt import Record
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


def largest_disturbance(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike = 0.0,
    smoothing: ArrayLike | None = None,
    actuation: Actuation | None = None,
    cutoff: ArrayLike | None = None,
) -> Solution:
    """The robustness margin (21): the largest factor by which the disturbances may be scaled while the grasp holds.

    max lambda over (f_0, lambda) subject to G f_0 = b, C f_0 - S_1 lambda <= -d, -E f_0 + S_2 lambda <= f_max.

    lambda is left free: where even b cannot be borne the status is INFEASIBLE and a negative margin is the proof. A
    grasp without force closure and without load has margin 0.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D; without batch axes it is shared by all grasps.
        required_wrench: b (*batch, 6), N and N m, see `required_wrench`; None is zero.
        compliance: Q of (14), contact frames, symmetric positive definite: blocks (*batch, n_c, 3, 3), full
            (*batch, 3 n_c, 3 n_c), or `Compliance.per_direction`; None is the identity.
        cone_edges: n_e, edges of the friction pyramid, which is inscribed in Coulomb's cone.
        cone_margin: d (*batch,), N, >= 0: what every facet row keeps in reserve.
        smoothing: kappa (*batch,), > 0, in units of the margin: answer with the central point, where s z = kappa in
            every row, instead of the optimum. Margin and forces are then smooth and unique, and the margin is below
            the optimum by about kappa for every active row. None is the exact optimum.
        actuation: what the hand can do: efforts u with J'f_0 = B u that stay within their limits while the worst
            disturbance acts join the unknowns, and G* leaves joint directions that no actuator reaches without torque.
            None lets every finger push at will.
        cutoff: (*batch,), in units of the margin: grasps are given up as soon as a certified upper bound is below, with
            the bounds found so far. None (or NaN) gives up none.

    Returns:
        Solution with `*batch` axes. `margin` is attained by `forces`, and no forces reach more than `upper_bound`.

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        SOLVED; INFEASIBLE (b cannot be borne); UNBOUNDED (nothing disturbs, margin inf); INVALID_INPUT (data not
        admissible, for that grasp alone); PRUNED (below the cutoff); MAX_ITERATIONS, ILL_CONDITIONED (float32 cannot
        tell). With smoothing, SOLVED means that the central point was found; its margin may be negative, which then
        proves nothing.

    Derivatives:
        Of margin (and upper_bound), forces, effort and multipliers with respect to everything that is continuous, of
        any order. The exact margin's gradient is that of the Lagrangian (envelope theorem), at kinks a subgradient;
        that of exact forces belongs to the central point for 1e-6 (float32: 1e-4) of the margin's natural scale. With
        smoothing all are those of the answer. Exactly zero for grasps without a finite margin.
    """
    pyramid_facets(cone_edges)
    return over_grasps(
        _LargestDisturbance(cone_edges, smoothing is not None),
        contacts,
        disturbances,
        required_wrench=required_wrench,
        compliance=compliance,
        cone_margin=cone_margin,
        smoothing=smoothing,
        cutoff=cutoff,
        actuation=actuation,
    )[0]


def least_effort(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    margin: ArrayLike,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    effort_weights: ArrayLike | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike = 0.0,
    smoothing: ArrayLike | None = None,
    actuation: Actuation | None = None,
) -> Solution:
    """The tightening forces of least effort that give a chosen margin, program (22).

    min 1/2 f_0' Q_0 f_0 subject to the rows of (21) with lambda = margin. Solves (21) first, for a start and for the
    certificate where the margin cannot be had.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D.
        margin: lambda (*batch,), >= 0; usually a share, say 75 %, of (21)'s.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q, as in `largest_disturbance`.
        effort_weights: Q_0 as blocks (*batch, n_c, 3, 3), contact frames, symmetric positive definite; None is the
            identity.
        cone_edges: n_e.
        cone_margin: d (*batch,), N, >= 0.
        smoothing: kappa (*batch,), > 0, N^2: s z = kappa in every row, as in `largest_disturbance` but in units of the
            effort, this program's objective. None is the exact optimum.
        actuation: what the hand can do, as in `largest_disturbance`; actuator efforts cost nothing.

    Returns:
        Solution; `margin` is what `forces` certify, at least the one asked for up to rounding, `upper_bound` that of
        (21).

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        As in `largest_disturbance`; INFEASIBLE where the margin is above what (21) allows; INVALID_INPUT where it is
        negative or NaN.

    Derivatives:
        As in `largest_disturbance`, the margin asked for included; of exact forces those of the central point for 1e-8
        (float32: 1e-5) of the effort's scale. `margin` varies like the one asked for, `upper_bound` counts as constant.
        Zero for grasps without an answer.
    """
    pyramid_facets(cone_edges)
    return over_grasps(
        _LeastEffort(cone_edges, smoothing is not None),
        contacts,
        disturbances,
        required_wrench=required_wrench,
        compliance=compliance,
        cone_margin=cone_margin,
        effort_weights=effort_weights,
        margin=margin,
        smoothing=smoothing,
        actuation=actuation,
    )[0]


@dataclass(frozen=True)
class _Tightening(OfPyramids, Audited, ABC):
    """What the kernels of (21) and (22) share; their results are a solution and evidence for its audit."""

    smooth: bool

    @property
    def stages(self) -> tuple:
        return (lambda grasps, _: prepared(grasps, self.cone_edges), lambda given: self._solve(*given))

    @abstractmethod
    def _solve(self, grasps: Grasps, program: Program) -> tuple[Solution, Evidence]: ...

    def judge(self, arguments: Arguments, out: tuple[Solution, Evidence], anew: bool) -> Verdict:
        return judge(arguments, *out, anew, self.smooth)

    def spot(self, arguments: Arguments, out: tuple[Solution, Evidence]) -> jax.Array:
        return spot(arguments, *out)

    def correct(self, out: tuple[Solution, Evidence], verdicts: Verdict) -> tuple[Solution, Evidence]:
        return corrected(out[0], verdicts), out[1]

    def _point(self, out: Solution, usable: jax.Array) -> Point:
        if self.smooth:
            # At a central point all multipliers are positive; where there is none they are zero, or it was not found.
            usable &= (out.status != Status.MAX_ITERATIONS) & jnp.any(out.bound_multipliers > 0, -1)
        return Point(usable=usable, **{name: getattr(out, name) for name in Point._fields if name != "usable"})

    def _central(self, along: Along, point: Point) -> Point:
        """The derivative of everything at the central point, which is the point itself where smoothing is asked for."""
        kernel = CentralPoint(self.cone_edges)
        return kernel.tangents(along, point if self.smooth else along.value(kernel, point))


class _LargestDisturbance(_Tightening):
    def _solve(self, grasps: Grasps, program: Program) -> tuple[Solution, Evidence]:
        best, record, iterate = _solve_margin(grasps, program)
        solution = best
        if grasps.smoothing is not None:
            possible = ~(program.wrench_outside | program.disturbance_outside | program.undisturbed)
            solution = _at_centre(grasps, program, iterate, best, grasps.valid & possible)
        return solution, _evidence(grasps, program, record)

    def tangents(self, along: Along, found: tuple[Solution, Evidence]) -> tuple[Solution, Evidence]:
        out = found[0]
        point = self._point(out, jnp.isfinite(out.margin) & (out.status != Status.PRUNED))
        change = self._central(along, point)
        if not self.smooth:
            adjoint = partial(envelope_adjoint, self.cone_edges)
            change = change._replace(margin=along.adjoint(adjoint, point, (out.margin,))[0])
        return _changed(found, change, change.margin)


class _LeastEffort(_Tightening):
    def _solve(self, grasps: Grasps, program: Program) -> tuple[Solution, Evidence]:
        first, record, _ = _solve_margin(replace(grasps, smoothing=None), program)
        return _solve_effort(grasps, program, first, record), _evidence(grasps, program, record)

    def tangents(self, along: Along, found: tuple[Solution, Evidence]) -> tuple[Solution, Evidence]:
        out = found[0]
        return _changed(found, self._central(along, self._point(out, jnp.isfinite(out.effort))), None)


def _changed(found: tuple[Solution, Evidence], change: Point, upper_bound: jax.Array | None) -> tuple:
    """A change of the results; None for what does not vary, or counts as if it did not."""
    varying = change._asdict() | {"upper_bound": upper_bound}
    still = jax.tree.map(lambda _: None, found[1])
    return Solution(**{f.name: varying.get(f.name) for f in fields(Solution)}), still


def _evidence(grasps: Grasps, program: Program, record: Record) -> Evidence:
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


def _solve_margin(grasps: Grasps, program: Program) -> tuple[Solution, Record, Iterate]:
    """(21) for lanes; also the scaled record, from which (22) starts, and the last iterate."""
    dtype = program.rhs.dtype
    problem = margin_problem(program, grasps.cutoff)
    settings = _towards_centre(_SETTINGS[dtype.name], grasps, program, program.scale)
    outcome = interior_point.solve(problem, settings, grasps.valid & ~program.wrench_outside)
    point = balanced(program, problem, outcome.record.x)
    low, high = problem.attained(point.x), certified(program, problem, outcome.record)
    # Without a load, no forces at all are an answer with margin 0, exactly.
    accepted = _ACCEPTED_GAP[dtype.name]
    nothing = (low < 8 * jnp.finfo(dtype).eps) | ~point.exact & (low <= accepted)
    flat = program.disturbance_outside | program.slippery
    idle = (nothing | flat) & _unloaded(grasps, program)
    low, exact = jnp.where(idle, 0, low), point.exact | idle
    size = jnp.maximum(1, jnp.abs(low))
    # The solver's own bound tells how far it came, the other one whether its rows were the right ones.
    came = jnp.where(jnp.isinf(low), 1, size)
    apart = lambda upper, unit: jnp.abs(upper - low) <= accepted * unit  # noqa: E731
    closed = exact & apart(outcome.record.upper, came) & apart(high, jnp.maximum(came, program.mean / program.scale))
    # Where bounds cross, rounding made one of them false: less is attained in any case, and more is certain.
    low, high = jnp.minimum(low, high), jnp.maximum(low, high)
    record = outcome.record._replace(lower=low, upper=high, x=tuple(jnp.where(idle, 0, x) for x in point.x))
    bearable = exact & (low >= -settings.tolerance)
    pruned = jnp.zeros_like(bearable) if problem.cutoff is None else high < problem.cutoff

    margin, upper = low * program.scale, high * program.scale
    margin = jnp.where(program.slippery, jnp.minimum(margin, 0), margin)
    upper = jnp.where(program.slippery, jnp.minimum(upper, 0), upper)
    hopeless = high < -settings.tolerance
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


def _unloaded(grasps: Grasps, program: Program) -> jax.Array:
    """Where no forces at all meet every row, but for the disturbances."""
    idle = (program.rhs == 0).all(0) & (grasps.reserve == 0)
    return idle if program.efforts is None else idle & (program.efforts.h >= 0).all((0, 1))


def _towards_centre(settings: Settings, grasps: Grasps, program: Program, unit: jax.Array) -> Settings:
    """Where smoothing is asked for, the loop aims at the central point, whose gap is kappa for every row."""
    if grasps.smoothing is None:
        return settings
    kappa = central_kappa(grasps, program, unit)
    rows = program.sigma.shape[0] * fold(jnp.add, grasps.present)
    if program.efforts is not None:
        rows = rows + program.efforts.h.shape[0] * program.efforts.h.shape[1]
    gap = kappa * rows
    return settings._replace(gap_floor=1.5 * gap, mu_floor=kappa)


def _at_centre(grasps: Grasps, program: Program, iterate: Iterate, solution: Solution, possible: jax.Array) -> Solution:
    """The solution with the central point in place of the best one; solved where that is found."""
    point = centred(grasps, program, iterate, possible)
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


def _solve_effort(grasps: Grasps, program: Program, first: Solution, record: Record) -> Solution:
    """(22) for lanes, from what (21) left."""
    dtype, blocks = program.rhs.dtype, program.blocks
    problem, wanted, unit = effort_problem(grasps, program)
    settings = _towards_centre(_EFFORT_SETTINGS[dtype.name], grasps, program, unit**2)
    reachable = grasps.margin <= first.upper_bound * (1 + settings.tolerance)
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
    kept = program.undisturbed | (attained >= wanted - accepted * jnp.maximum(1, wanted))
    closed = kept & point.exact & (jnp.abs(gap) <= accepted)

    out_of_reach = hopeless | ~reachable & ~program.undisturbed
    status = jnp.select(
        [~grasps.valid, hopeless, program.doubtful, out_of_reach, active & closed],
        [Status.INVALID_INPUT, Status.INFEASIBLE, Status.ILL_CONDITIONED, Status.INFEASIBLE, Status.SOLVED],
        Status.MAX_ITERATIONS,
    ).astype(jnp.int32)
    answered = active & jnp.isfinite(best.upper)
    hide = lambda x: jnp.where(answered, x, jnp.nan)  # noqa: E731
    attained = jnp.where(program.undisturbed, jnp.inf, attained * program.scale)
    attained = jnp.where(program.disturbance_outside | program.slippery, 0, attained)
    forces = program.forces(best.x[0]) * blocks.present[:, None]
    multipliers = best.z[0] * unit**2 / program.row_units()
    solution = Solution(
        margin=hide(jnp.where(attained > first.upper_bound, first.upper_bound, attained)),
        upper_bound=first.upper_bound,
        forces=hide(forces),
        effort=hide(effort_of(forces, grasps.weights)),
        status=status,
        iterations=first.iterations + outcome.iterations,
        primal_residual=hide(problem.violations(best.x, jnp.zeros_like(wanted))),
        dual_residual=hide(_largest(outcome.residuals.dual)),
        gap=hide(gap),
        rank=program.rank,
        cone_multipliers=jnp.moveaxis(multipliers[:-1], 0, 1),
        bound_multipliers=multipliers[-1],
        wrench_multipliers=program.wrench_multipliers(best.y, grasps.units) * unit**2,
        **{name: hide(value) for name, value in actuated_values(program, best.x, best, grasps.units, unit**2).items()},
    )
    if grasps.smoothing is None:
        return solution
    return _at_centre(grasps, program, outcome.iterate, solution, active & ~idle)
