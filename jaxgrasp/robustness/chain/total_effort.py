"""The least-effort program (11) over the tightening forces and all answers to the disturbances."""

from dataclasses import dataclass, fields, replace

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgrasp import linalg
from jaxgrasp.arrays import fold
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
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
from jaxgrasp.robustness.chain.formulations import check_vertices, tile_of
from jaxgrasp.robustness.chain.programs import FORMULATIONS, Basics, basics, scaled_formulation
from jaxgrasp.robustness.chain.verdicts import Verdict, programs, solved_program, verdict
from jaxgrasp.robustness.grasps import Grasps, grasps_of, over_grasps
from jaxgrasp.robustness.interface.arguments import Arguments
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.block.arrow import ArrowProblem, patterns_of
from jaxgrasp.solvers.conic.embedding import ConicOutcome
from jaxgrasp.solvers.interior_point import Settings
from jaxgrasp.solvers.status import Status

_FREE = FORMULATIONS["13"]
_SETTINGS = {
    "float64": Settings(
        tolerance=1e-8, max_iterations=40, step_cap=1e-4, mu_floor=0.0, equal_steps=True, safeguard=1e-4, patience=8
    ),
    "float32": Settings(
        tolerance=1e-4, max_iterations=40, step_cap=1e-3, mu_floor=1e-8, equal_steps=True, safeguard=1e-3, patience=5
    ),
}
_ACCEPTED = {"float64": 1e-7, "float32": 1e-3}
# Wrenches up to this, in units of the mean of f_max.
_NOTHING = {"float64": 1e-8, "float32": 1e-5}


@record
class TotalEffortSolution:
    """What `least_total_effort` answers."""

    effort: Float[Array, "*batch"]
    """The optimum: 1/2 f_0' Q_0 f_0 + sum_j 1/2 delta f_j' Q delta f_j; NaN where there is no answer."""
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


def least_total_effort(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    margin: ArrayLike = 1.0,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | None = None,
    effort_weights: ArrayLike | None = None,
    cone_edges: int = 8,
) -> TotalEffortSolution:
    """Program (11): tightening forces and free answers to every disturbance, of least effort together.

    min 1/2 f_0' Q_0 f_0 + sum_j 1/2 delta f_j' Q delta f_j over (f_0, delta f_1 .. delta f_nd) subject to G f_0 = b,
    G delta f_j = -margin W_j, and the rows of the pyramids and of |f_n| <= f_max for f_0 and for every f_0 + delta f_j.

    Solves (13) first, which says whether there are such forces, and where to start.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: W_j, a single `DisturbanceSet.vertices` or `.forces`.
        margin: (*batch,), >= 0: what the disturbances are scaled by.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q as blocks (*batch, n_c, 3, 3), contact frames, symmetric positive definite; None is the identity.
        effort_weights: Q_0, as blocks; None is the identity.
        cone_edges: n_e.

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
    if compliance is not None and jnp.shape(compliance)[-3:] != (contacts.n_c, 3, 3):
        raise ValueError(f"compliance: got shape {jnp.shape(compliance)}, wanted blocks (*batch, {contacts.n_c}, 3, 3)")
    return over_grasps(
        _TotalEffort(cone_edges, tile_of(contacts, disturbances)),
        contacts,
        disturbances,
        required_wrench=required_wrench,
        compliance=compliance,
        effort_weights=effort_weights,
        margin=margin,
    )[0]


@dataclass(frozen=True)
class _TotalEffort(OfPyramids, Audited):
    tile: int

    @property
    def stages(self) -> tuple:
        return (
            lambda grasps, _: self._free(grasps),
            Each({"13": solved_program}),
            lambda given: self._start(*given),
            lambda given: self._solve(*given),
        )

    def tangents(self, along: Along, out: tuple) -> tuple:
        solution, record = out
        (change,) = along.adjoint(self._adjoint, out, (solution.effort,))
        moved = {"effort": change, "lower_bound": change}
        changes: dict[str, Tree] = {f.name: moved.get(f.name) for f in fields(solution)}
        return TotalEffortSolution(**changes), jax.tree.map(lambda _: None, record)

    def judge(self, arguments: Arguments, out: tuple, anew: bool) -> EffortVerdict:
        """See `Audited`."""
        problem, (solution, record) = problem_of(arguments), out
        assert problem.margin is not None
        wrenches = disturbed_wrenches(problem, jnp.broadcast_to(problem.margin[:, None], solution.changes.shape[:2]))
        disturbed, check = solution.forces[:, None] + solution.changes, (False, self.cone_edges, False)
        holds = balanced(problem, solution.forces) & admissible(problem, solution.forces, *check)
        holds &= all_hold(problem, disturbed, wrenches, check) & (solution.lower_bound <= solution.effort)
        if anew:
            grasps = grasps_of(arguments)
            last = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), record)
            effort, unit = _problem(grasps, basics(grasps, False), self.cone_edges, last.x)
            found = effort.objective(last.x), effort.proven(last)
            holds &= least_total_effort_stands(solution.effort, found[1] * unit, found[0] * unit, unit)
        return EffortVerdict((solution.status == Status.SOLVED) & ~holds)

    def spot(self, arguments: Arguments, out: tuple) -> jax.Array:
        """See `Audited`: the program put together anew takes as long to compile as it did at first."""
        return jnp.zeros(out[0].effort.shape, bool)

    def correct(self, out: tuple, verdicts: EffortVerdict) -> tuple:
        """See `Audited`."""
        solution, record = out
        changed = {
            f.name: hidden(getattr(solution, f.name), verdicts.failed, jnp.nan)
            for f in fields(solution)
            if f.name not in ("status", "iterations")
        }
        status = hidden(solution.status, verdicts.failed, Status.NOT_VERIFIED)
        return replace(solution, **changed, status=status), record

    def _free(self, grasps: Grasps) -> tuple:
        shared = basics(grasps, False)
        scaled = scaled_formulation(grasps, shared, _FREE, self.cone_edges, False)
        kept = replace(grasps, terms=(), extents=()), shared, scaled.scale
        return kept, {"13": programs(grasps, shared, scaled, True)}

    def _start(self, kept: tuple, solved: dict[str, ConicOutcome]) -> tuple:
        grasps, shared, scale = kept
        found = solved["13"]
        answer = verdict(grasps, shared, scale, _FREE, found)
        # Each direction on its way from f_0 to the most that it allows: inside the rows.
        some = answer.answered & jnp.isfinite(answer.directions) & (answer.directions > 0)
        share = jnp.where(some, grasps.asked / jnp.where(some, answer.directions, 1), 0)
        x, rest = found.point.x, found.point.x[:, :, -1:]
        guess = jnp.concatenate([rest + jnp.clip(share, 0, 1) * (x[:, :, :-1] - rest), rest], 2)
        return grasps, shared, answer, guess

    def _solve(self, grasps: Grasps, shared: Basics, answer: Verdict, guess: jax.Array) -> tuple:
        problem, unit = _problem(grasps, shared, self.cone_edges, guess)
        dtype = unit.dtype.name
        settings = _SETTINGS[dtype]
        bearable = answer.answered
        most = jnp.maximum(jnp.min(answer.upper, 0), jnp.min(answer.directions, 0))
        active = bearable & (grasps.asked <= most * (1 + settings.tolerance))
        # Without a load and disturbances no forces at all are the answer. What rounding leaves of nothing counts as
        # nothing: a grasp that withstands none has no room inside its rows.
        idle = active & (jnp.abs(problem.rhs) <= _NOTHING[dtype]).all((0, 1))
        out = interior_point.solve(problem, settings, active & ~idle)
        record = jax.tree.map(lambda v: jnp.where(idle, 0, v), out.record)
        gap = (record.upper - record.lower) / problem.gap_scale(record)
        status = jnp.select(
            [~grasps.valid, bearable & ~active, ~bearable, gap <= _ACCEPTED[dtype]],
            [Status.INVALID_INPUT, Status.INFEASIBLE, answer.status, Status.SOLVED],
            Status.MAX_ITERATIONS,
        ).astype(jnp.int32)
        answered = active & jnp.isfinite(record.upper)
        hide = lambda v: jnp.where(answered, v, jnp.nan)
        forces = jnp.moveaxis(record.x * (shared.sizes * grasps.present)[:, :, None], (2, 1), (0, 1))
        solution = TotalEffortSolution(
            effort=hide(record.upper * unit),
            lower_bound=hide(record.lower * unit),
            forces=hide(forces[-1]),
            changes=hide(forces[:-1] - forces[-1]),
            status=status,
            iterations=out.iterations,
        )
        return solution, record

    def _adjoint(self, grasps: Grasps, held: tuple, cotangents: tuple, names: frozenset) -> Grasps:
        solution, record = held
        weight = jnp.where(jnp.isfinite(solution.effort), cotangents[0], 0)
        record = jax.tree.map(lambda x: jnp.where(weight != 0, x, 0), record)

        def value(grasps: Grasps) -> jax.Array:
            problem, unit = _problem(grasps, basics(grasps, False), self.cone_edges, record.x)
            return jnp.sum(weight * unit * problem.lagrangian(record))

        return jax.grad(value, allow_int=True)(grasps)


def _problem(grasps: Grasps, shared: Basics, cone_edges: int, guess: jax.Array) -> tuple[ArrowProblem, jax.Array]:
    """(11) in scaled forces, and the unit of effort."""
    dtype, present = shared.sizes.dtype, grasps.present
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype)[..., None, None], (3, 3, *present.shape))

    def scaled(blocks: jax.Array | None) -> jax.Array:
        """D Q D."""
        blocks = eye if blocks is None else blocks
        return blocks * shared.sizes[:, None] * shared.sizes * present + eye * (1 - present)

    own = scaled(None if grasps.weights is None else jnp.moveaxis(grasps.weights, 0, 2))
    change = None
    if grasps.half is not None:
        inverse = jnp.einsum("nab...,ncb...->n...ac", grasps.half, grasps.half)
        compliance = linalg.solve_positive(inverse, jnp.broadcast_to(jnp.eye(3, dtype=dtype), inverse.shape))
        change = jnp.moveaxis(compliance, (0, -2, -1), (2, 0, 1))
    change = scaled(change)
    largest = fold(jnp.maximum, [jnp.max(jnp.abs(h), (0, 1, 2)) for h in (own, change)])
    unit = lax.stop_gradient(jnp.where(largest > 0, largest, 1))
    targets = jnp.concatenate([shared.load[:, None] - grasps.asked * shared.targets, shared.load[:, None]], 1)
    patterns, h = patterns_of(pyramid_facets(cone_edges), dtype, 3)
    problem = ArrowProblem(
        patterns=patterns,
        h=h,
        columns=shared.columns[:, :, :, None],
        rhs=targets,
        dropped=shared.dropped[:, None],
        own=(own / unit)[:, :, :, None],
        change=(change / unit)[:, :, :, None],
        guess=guess,
    )
    return problem, unit
