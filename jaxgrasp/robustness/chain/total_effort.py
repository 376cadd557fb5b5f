"""The least-effort program (11) over the tightening forces and all reactions to the disturbances."""

from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgrasp.arrays import as_float
from jaxgrasp.compiling import compiled
from jaxgrasp.contact.compliance import Compliance, is_full
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import contact_facets, pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.lanes.differentiable import Along, OfPyramids, Tree
from jaxgrasp.lanes.tiles import Each
from jaxgrasp.records import record
from jaxgrasp.robustness.auditing import Audited, hidden
from jaxgrasp.robustness.auditing.chain import (
    EffortVerdict,
    admissible,
    all_hold,
    disturbed_wrenches,
    least_total_effort_stands,
)
from jaxgrasp.robustness.auditing.problem import problem_of
from jaxgrasp.robustness.auditing.pyramids import balanced
from jaxgrasp.robustness.chain.formulations import check_vertices, choose_tile
from jaxgrasp.robustness.chain.programs import FORMULATIONS, Basics, compute_basics, scale_formulation
from jaxgrasp.robustness.chain.verdicts import Decision, decide, select_programs, solve_program
from jaxgrasp.robustness.grasps import Grasps, admit_all, over_grasps
from jaxgrasp.robustness.interface.arguments import Arguments, GraspData, Options, optional_float
from jaxgrasp.robustness.interface.solution import split
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.block.arrow import ArrowProblem, build_rows
from jaxgrasp.solvers.conic.embedding import ConicOutcome
from jaxgrasp.solvers.interior_point import Settings
from jaxgrasp.solvers.small_matrices import flatten
from jaxgrasp.solvers.status import Status

_FREE = FORMULATIONS["13"]
_SETTINGS = {
    "float64": Settings(
        tolerance=1e-9, max_iterations=40, step_cap=1e-4, mu_floor=0.0, equal_steps=True, safeguard=1e-4, patience=4
    ),
    "float32": Settings(
        tolerance=1e-4, max_iterations=40, step_cap=1e-3, mu_floor=1e-8, equal_steps=True, safeguard=1e-3, patience=5
    ),
}
_ACCEPTED_GAP = {"float64": 1e-7, "float32": 1e-3}
# Wrenches up to this, in units of the mean of f_max, are rounding.
_NO_WRENCH = {"float64": 1e-8, "float32": 1e-5}


@record
class TotalEffortSolution:
    """The result of `least_total_effort`."""

    effort: Float[Array, "*batch"]
    """The optimum: 1/2 f_0' Q_0 f_0 + sum_j 1/2 delta f_j' Q_j delta f_j; NaN where there is no answer."""
    lower_bound: Float[Array, "*batch"]
    """Certified by multipliers: no forces do with less."""
    forces: Float[Array, "*batch contacts 3"]
    """f_0, contact frames, N; 0 for absent contacts, NaN where there is no answer."""
    changes: Float[Array, "*batch directions contacts 3"]
    """delta f_j, contact frames, N."""
    status: Int[Array, "*batch"]
    """`Status`."""
    iterations: Int[Array, "*batch"]
    """Interior-point steps, after those of (13)."""
    moments: Float[Array, "*batch contacts"] | None = None
    """The moments about the normals that come with `forces`, N m; None for hard contacts."""
    moment_changes: Float[Array, "*batch directions contacts"] | None = None
    """The same of `changes`."""


def least_total_effort(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    margin: ArrayLike = 1.0,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    effort_weights: ArrayLike | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike | None = None,
) -> TotalEffortSolution:
    """Program (11): tightening forces and free answers to every disturbance, of least effort together.

    min 1/2 f_0' Q_0 f_0 + sum_j 1/2 delta f_j' Q_j delta f_j over (f_0, delta f_1 .. delta f_nd) subject to G f_0 = b,
    G delta f_j = -margin W_j, and the rows of the pyramids and of |f_n| <= f_max for f_0 and for every f_0 + delta f_j.

    Solves (13) first, which says whether there are such forces, and where to start.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: W_j, a single `DisturbanceSet.vertices` or `.forces`.
        margin: (*batch,), >= 0: what the disturbances are scaled by.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q of (14), contact frames, symmetric positive definite: blocks (*batch, n_c, 3, 3), full
            (*batch, 3 n_c, 3 n_c), or one Q_j a direction, `Compliance.per_direction`; None is the identity. Full ones
            take dense linear algebra for every direction.
        effort_weights: Q_0, blocks or full; None is the identity.
        cone_edges: n_e.
        cone_margin: d, N, >= 0: a grasp, a contact or a row, as in `largest_disturbance`; None is none.

    Returns:
        TotalEffortSolution with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        SOLVED; INFEASIBLE (no such forces: the margin is above (13)'s); MAX_ITERATIONS; INVALID_INPUT.

    Derivatives:
        Of effort and lower_bound, first order, with respect to everything that is continuous (envelope theorem).
    """
    pyramid_facets(cone_edges)
    check_vertices(disturbances)
    data = GraspData.from_arguments(
        contacts, disturbances, required_wrench, compliance, cone_margin, cone_edges=cone_edges
    )
    options = Options(
        margin=as_float("margin", margin, ()), effort_weights=optional_float("effort_weights", effort_weights)
    )
    found = over_grasps(_TotalEffort(cone_edges, choose_tile(contacts, disturbances)), data, options)[0]
    return found if contacts.torsional_friction is None else _split(found, contacts)


@compiled
def _split(found: TotalEffortSolution, contacts: Contacts) -> TotalEffortSolution:
    """Split the forces of soft contacts, whose fourth component is m / arm, into forces and moments."""
    forces, moments = split(found.forces, contacts)
    each = jax.tree.map(lambda x: jnp.expand_dims(x, len(contacts.batch_shape)), contacts)
    changes, moment_changes = split(found.changes, each)
    return replace(found, forces=forces, moments=moments, changes=changes, moment_changes=moment_changes)


@dataclass(frozen=True)
class _TotalEffort(OfPyramids, Audited):
    tile: int

    @property
    def stages(self) -> tuple:
        return (
            lambda grasps, _: self._free(grasps),
            Each({"13": solve_program}),
            lambda solved: self._start(*solved),
            lambda start: self._solve(*start),
        )

    def tangents(self, along: Along, out: tuple) -> tuple:
        solution, record = out
        (change,) = along.adjoint(self._adjoint, out, (solution.effort,))
        moved = {"effort": change, "lower_bound": change}
        changes: dict[str, Tree] = {f.name: moved.get(f.name) for f in fields(solution)}
        return TotalEffortSolution(**changes), jax.tree.map(lambda _: None, record)

    def judge(self, arguments: Arguments, out: tuple, anew: bool) -> EffortVerdict:
        """Hold every lane against the rules of the audit."""
        problem, (solution, record) = problem_of(arguments), out
        assert problem.margin is not None
        wrenches = disturbed_wrenches(problem, jnp.broadcast_to(problem.margin[:, None], solution.changes.shape[:2]))
        disturbed, check = solution.forces[:, None] + solution.changes, (False, self.cone_edges, False)
        holds = balanced(problem, solution.forces) & admissible(problem, solution.forces, *check)
        holds &= all_hold(problem, disturbed, wrenches, check) & (solution.lower_bound <= solution.effort)
        if anew:
            grasps = admit_all(arguments)
            last = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), record)
            effort, unit = _problem(grasps, compute_basics(grasps, False), self.cone_edges, last.x)
            found = effort.objective(last.x), effort.proven(last)
            holds &= least_total_effort_stands(solution.effort, found[1] * unit, found[0] * unit, unit)
        return EffortVerdict((solution.status == Status.SOLVED) & ~holds)

    def spot(self, arguments: Arguments, out: tuple) -> jax.Array:
        """Nothing: the program put together anew takes as long to compile as it did at first."""
        return jnp.zeros(out[0].effort.shape, bool)

    def correct(self, out: tuple, verdicts: EffortVerdict) -> tuple:
        """Take back what the audit does not confirm."""
        solution, record = out
        changed = {
            f.name: hidden(getattr(solution, f.name), verdicts.failed, jnp.nan)
            for f in fields(solution)
            if f.name not in ("status", "iterations", "moments", "moment_changes")
        }
        status = hidden(solution.status, verdicts.failed, Status.NOT_VERIFIED)
        return replace(solution, **changed, status=status), record

    def _free(self, grasps: Grasps) -> tuple:
        basics = compute_basics(grasps, False)
        scaled = scale_formulation(grasps, basics, _FREE, self.cone_edges, False)
        scaled_grasps = replace(grasps, terms=(), extents=()), basics, scaled.scale
        return scaled_grasps, {"13": select_programs(grasps, basics, scaled, True)}

    def _start(self, scaled_grasps: tuple, solved: dict[str, ConicOutcome]) -> tuple:
        grasps, basics, scale = scaled_grasps
        outcome = solved["13"]
        decision = decide(grasps, basics, scale, _FREE, outcome)
        # Each direction on its way from f_0 to the most that it allows: inside the rows.
        positive = decision.has_margin & jnp.isfinite(decision.directions) & (decision.directions > 0)
        share = jnp.where(positive, _asked(grasps) / jnp.where(positive, decision.directions, 1), 0)
        x, rest = outcome.point.x, outcome.point.x[:, :, -1:]
        guess = jnp.concatenate([rest + jnp.clip(share, 0, 1) * (x[:, :, :-1] - rest), rest], 2)
        return grasps, basics, decision, guess

    def _solve(self, grasps: Grasps, basics: Basics, decision: Decision, guess: jax.Array) -> tuple:
        problem, unit = _problem(grasps, basics, self.cone_edges, guess)
        dtype = unit.dtype.name
        settings = _SETTINGS[dtype]
        bearable = decision.has_margin
        most = jnp.maximum(jnp.min(decision.upper, 0), jnp.min(decision.directions, 0))
        active = bearable & (_asked(grasps) <= most * (1 + settings.tolerance))
        # Without a load and disturbances no forces at all are the optimum. What rounding leaves of no wrench counts as
        # none: a grasp that withstands none has no room inside its rows.
        forceless = active & (jnp.abs(problem.rhs) <= _NO_WRENCH[dtype]).all((0, 1))
        forceless = forceless if grasps.reserve is None else forceless & grasps.reserves_nothing
        out = interior_point.solve(problem, settings, active & ~forceless)
        record = jax.tree.map(lambda v: jnp.where(forceless, 0, v), out.record)
        gap = (record.upper - record.lower) / problem.gap_scale(record)
        status = jnp.select(
            [~grasps.valid, bearable & ~active, ~bearable, gap <= _ACCEPTED_GAP[dtype]],
            [Status.INVALID_INPUT, Status.INFEASIBLE, decision.status, Status.SOLVED],
            Status.MAX_ITERATIONS,
        ).astype(jnp.int32)
        has_forces = active & jnp.isfinite(record.upper)
        where_forces = lambda v: jnp.where(has_forces, v, jnp.nan)
        forces = jnp.moveaxis(record.x * (basics.sizes * grasps.transmits)[:, :, None], (2, 1), (0, 1))
        solution = TotalEffortSolution(
            effort=where_forces(record.upper * unit),
            lower_bound=where_forces(record.lower * unit),
            forces=where_forces(forces[-1]),
            changes=where_forces(forces[:-1] - forces[-1]),
            status=status,
            iterations=out.iterations,
        )
        return solution, record

    def _adjoint(self, grasps: Grasps, held: tuple, cotangents: tuple) -> Grasps:
        solution, record = held
        solved = jnp.isfinite(solution.effort)
        weight = jnp.where(solved, cotangents[0], 0)
        record = jax.tree.map(lambda x: jnp.where(solved, x, 0), record)

        def value(grasps: Grasps) -> jax.Array:
            problem, unit = _problem(grasps, compute_basics(grasps, False), self.cone_edges, record.x)
            return jnp.sum(weight * unit * problem.lagrangian(record))

        return jax.grad(value, allow_int=True)(grasps)


def _asked(grasps: Grasps) -> jax.Array:
    """The margin that is asked for, (*lanes)."""
    assert grasps.options.margin is not None
    return grasps.options.margin


def _scaled_weights(matrices: jax.Array | None, sizes: jax.Array, present: jax.Array) -> jax.Array:
    """D Q D with copies before the lanes, (k, k, n, 1 or n_d, *lanes) or (k n, k n, 1 or n_d, *lanes).

    Args:
        matrices: Q, blocks (1 or n_d, n, k, k, *lanes) or full (1 or n_d, k n, k n, *lanes); None for the identity.
        sizes: D, (k, n, *lanes).
        present: (n, *lanes).
    """
    k, n = sizes.shape[:2]
    if matrices is not None and is_full(matrices[0], n):
        flat, there = flatten(sizes), jnp.repeat(present, k, 0)
        eye = jnp.eye(k * n, dtype=sizes.dtype)[..., None]
        scaled = (matrices + jnp.swapaxes(matrices, 1, 2)) / 2 * flat[:, None] * flat * (there[:, None] * there)
        return jnp.moveaxis(scaled + eye * (1 - there), 0, 2)
    eye = jnp.broadcast_to(jnp.eye(k, dtype=sizes.dtype)[..., None, None], (k, k, *present.shape))
    if matrices is None:
        return (eye * sizes[:, None] * sizes * present + eye * (1 - present))[:, :, :, None]
    blocks = jnp.moveaxis((matrices + jnp.swapaxes(matrices, 2, 3)) / 2, (2, 3, 1, 0), (0, 1, 2, 3))
    across = lambda x: jnp.expand_dims(x, -1 - (present.ndim - 1))
    scaled = blocks * across(sizes[:, None]) * across(sizes) * across(present)
    return scaled + across(eye * (1 - present))


def _problem(grasps: Grasps, basics: Basics, cone_edges: int, guess: jax.Array) -> tuple[ArrowProblem, jax.Array]:
    """(11) in scaled forces, and the unit of effort."""
    dtype, weights, k = basics.sizes.dtype, grasps.options.effort_weights, len(basics.sizes)
    rest = _scaled_weights(None if weights is None else weights[None], basics.sizes, grasps.present)
    change = _scaled_weights(grasps.compliance, basics.sizes, grasps.present)
    over = lambda h: jnp.max(jnp.abs(h), tuple(range(h.ndim - 1)))
    largest = jnp.maximum(over(rest), over(change))
    unit = lax.stop_gradient(jnp.where(largest > 0, largest, 1))
    targets = jnp.concatenate([basics.load[:, None] - _asked(grasps) * basics.targets, basics.load[:, None]], 1)
    facets = contact_facets(cone_edges, k)
    patterns, h = build_rows(facets, dtype, 3)
    if grasps.reserve is not None:
        reserve = grasps.row_reserves(basics.sizes[0], len(facets))[:, :, None]
        h = jnp.concatenate([h[:-1] - reserve, jnp.broadcast_to(h[-1:], reserve[:1].shape)])
    problem = ArrowProblem(
        patterns=patterns,
        h=h,
        columns=basics.columns[:, :, :, None],
        rhs=targets,
        dropped=basics.dropped[:, None],
        hub_hessian=rest / unit,
        copy_hessian=change / unit,
        guess=guess,
    )
    return problem, unit
