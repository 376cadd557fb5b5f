"""The paper's chain of formulations, (12), (13), (16), (21) and their like, each with its own largest disturbance.

All ask for the largest lambda such that forces f_0 hold the object at rest and f_0 + delta f_j while lambda W_j acts:

    G f_0 = b,   G delta f_j = -lambda W_j,   f_0 and every f_0 + delta f_j admissible.

They differ in what is admissible (Coulomb's cone or the inscribed pyramid; |f| or |f_n| at most f_max) and in whether
delta f_j is free or the blocking force (15).
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxgrasp.arrays import fold
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import Vertices, wrenches_of
from jaxgrasp.lanes.differentiable import Along, Tree
from jaxgrasp.lanes.tiles import Each
from jaxgrasp.robustness.auditing import Audited, hidden
from jaxgrasp.robustness.auditing.chain import (
    ChainVerdict,
    admissible,
    all_hold,
    blocking_forces_stand,
    disturbed_wrenches,
    proven_bounds,
    settled,
)
from jaxgrasp.robustness.auditing.problem import Problem, problem_of
from jaxgrasp.robustness.auditing.pyramids import balanced
from jaxgrasp.robustness.blocking import weighted_pseudo_inverse
from jaxgrasp.robustness.chain.cuts import refine_shared
from jaxgrasp.robustness.chain.members import check_known, polytope_of, worst_of_rows
from jaxgrasp.robustness.chain.programs import (
    FORMULATIONS,
    Basics,
    Formulation,
    Scaled,
    compute_basics,
    contact_rows,
    scale_formulation,
)
from jaxgrasp.robustness.chain.refinement import refine
from jaxgrasp.robustness.chain.verdicts import (
    ACCEPTED,
    FormulationSolution,
    build_solution,
    select_programs,
    solve_program,
    with_moments,
)
from jaxgrasp.robustness.grasps import Grasps, admit_all, over_grasps
from jaxgrasp.robustness.interface.arguments import Arguments, GraspData, Options, lay_out
from jaxgrasp.solvers.conic.embedding import ConicOutcome
from jaxgrasp.solvers.conic.margin import ConicPoint
from jaxgrasp.solvers.status import Status

# Contacts under all directions in a tile.
_TILE = 1024
# How far bounds may be apart where directions are refined, as a share.
TOLERANCE = {"float64": 1e-4, "float32": 1e-2}


def formulation_margin(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    formulation: str,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    cone_edges: int = 8,
    force_bound: str = "normal",
    tolerance: float | None = None,
    cone_margin: ArrayLike | None = None,
) -> FormulationSolution:
    """The largest disturbance by one formulation of the paper's chain.

    | name | delta f_j | cones | f_0 |
    |---|---|---|---|
    | "12" | free | Coulomb's | one |
    | "12_fixed" | blocking forces (15) | Coulomb's | one |
    | "13" | free | pyramids | one |
    | "16" | blocking forces (15) | pyramids | one |
    | "per_direction" | free | pyramids | none asked for |
    | "per_direction_prestrained" | blocking forces (15) | pyramids | another for each direction |

    "per_direction" is the measure of the largest disturbance polytope: the smallest over the directions of max lambda
    with G f = b - lambda W_j. (13) and (12) fall apart in the same way, since f_0 + delta f_j is then free, provided
    that some admissible f_0 exists. "per_direction_prestrained" asks every direction for its own admissible f_0, to
    which the blocking forces add. (16) and (19), the rows of (21), are equivalent for lambda >= 0: a row holds for all
    directions if it holds for the worst.

    Sets may be given by vertices, W_j, or be boxes, balls, ellipsoids and sums. Of a box its 64 corners count, in the
    order of itertools.product((-1, 1), repeat=6). For other sets (16) takes the members that load its rows most, which
    is exact: n_c (n_e + 1), and 12 that reach outside the range of G. The other formulations refine directions until
    two bounds meet: margin is then what is proven for the whole set, upper_bound what one of its members allows, and
    the solution is that of this member, `worst_wrench`, as the only direction. That looks at numbers, so it cannot be
    part of jit, vmap or grad.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D, see above.
        formulation: one of the names above.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q of (14), as in `largest_disturbance`; only blocking forces depend on it.
        cone_edges: n_e of the inscribed pyramids.
        force_bound: "normal" bounds |f_n| as (8) and the linear programs do, "norm" bounds |f| as (6) and (12) do. A
            norm is no linear row: only exact cones take it, "12_fixed" for boxes and vertices alone.
        tolerance: where directions are refined, how far margin may be below upper_bound, as a share of it; None is 1e-4
            (float32: 1e-2).
        cone_margin: d, N, >= 0: a grasp, a contact or a row, as in `largest_disturbance`. Exact cones, which have no
            rows, keep |f_t| + mu f_n <= -d, so that with the same d inscribed pyramids are inside them. None is none.

    Returns:
        FormulationSolution with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit; at trace time. Sets whose directions are refined inside a
            transformation.

    Status:
        SOLVED; INFEASIBLE (no admissible f_0, for "per_direction" no f at all; margin NaN); UNBOUNDED (nothing
        disturbs); MAX_ITERATIONS, where directions are refined with bounds that hold but are farther apart than the
        tolerance; INVALID_INPUT. As in `largest_disturbance`, a required wrench outside the range of G
        is INFEASIBLE and a disturbance outside it makes the margin 0, also where one would cancel the other.

    Derivatives:
        Of margin, upper_bound and directions, first order, with respect to everything that is continuous (envelope
        theorem; at kinks a subgradient). Margins of zero have none: they are flat.
    """
    if formulation not in FORMULATIONS:
        raise ValueError(f"formulation: got {formulation!r}, wanted one of {', '.join(FORMULATIONS)}")
    if force_bound not in ("normal", "norm"):
        raise ValueError(f"force_bound: got {force_bound!r}, wanted 'normal' or 'norm'")
    if force_bound == "norm" and not FORMULATIONS[formulation].exact:
        raise ValueError(f"force_bound: got 'norm' for {formulation!r}, wanted 'normal', since pyramids are linear")
    pyramid_facets(cone_edges)
    rows = None if FORMULATIONS[formulation].exact else cone_edges
    given = GraspData.from_arguments(contacts, disturbances, required_wrench, compliance, cone_margin, cone_edges=rows)
    check_tolerance(tolerance)

    def solve(data: GraspData) -> FormulationSolution:
        tile = choose_tile(data.contacts, data.disturbances)
        kernel = Chain((formulation,), cone_edges, force_bound == "norm", tile)
        return over_grasps(kernel, data)[formulation][0]

    polytope, inverse = polytope_of(disturbances), None
    shares_f0 = not FORMULATIONS[formulation].free and FORMULATIONS[formulation].one_f0
    if polytope is None and shares_f0:
        if contacts.torsional_friction is not None:
            raise ValueError(
                f"disturbances: got a set without vertices for {formulation!r} and soft contacts, wanted vertices or a "
                "box, or contacts without torsional_friction"
            )
        if force_bound == "norm":
            raise ValueError("force_bound: got 'norm' for '12_fixed' and a set without vertices, wanted 'normal'")
        inverse = weighted_pseudo_inverse(contacts, compliance)
        polytope = worst_of_rows(contacts, disturbances, inverse, cone_edges)
    if not is_refined(disturbances, formulation) or 0 in contacts.batch_shape:
        vertices = polytope or DisturbanceSet.vertices(jnp.zeros((1, 6)))
        return with_moments(solve(replace(given, disturbances=vertices)), contacts)
    check_known(given)
    tolerance = TOLERANCE[contacts.positions.dtype.name] if tolerance is None else tolerance
    arguments = lay_out(given, Options())
    if polytope is None or inverse is None:
        return with_moments(refine(arguments, solve, tolerance), contacts)
    flat = lambda x: np.asarray(jnp.broadcast_to(x, (*arguments.batch, *x.shape[-2:])).reshape(-1, *x.shape[-2:]))
    return refine_shared(arguments, solve, flat(wrenches_of(polytope.terms)), flat(inverse), tolerance)


def is_refined(disturbances: DisturbanceSet, formulation: str) -> bool:
    """Whether directions of a set have to be refined for a formulation, which no program under jit can do."""
    return formulation != "16" and polytope_of(disturbances) is None


def check_tolerance(tolerance: float | None) -> None:
    """Refuse a tolerance that is no share."""
    if tolerance is not None and not 0 < tolerance < 1:
        raise ValueError(f"tolerance: got {tolerance}, wanted a number in (0, 1), or None")


def check_vertices(disturbances: DisturbanceSet) -> None:
    """Refuse sets that are not given by vertices."""
    terms = getattr(disturbances, "terms", None)
    if terms is not None and (len(terms) != 1 or not isinstance(terms[0], Vertices) or terms[0].width is not None):
        raise ValueError(
            "disturbances: got a set that is not given by vertices, wanted a single DisturbanceSet.vertices or .forces "
            "(--disturbances forces or a FILE)"
        )


def choose_tile(contacts: Contacts, disturbances: DisturbanceSet) -> int:
    """Choose how many grasps to work on at a time.

    With four contacts and six directions 32 were fastest of 32 to 1,024, by a factor of five.
    """
    directions = wrenches_of(disturbances.terms).shape[-2] + 1
    return 1 << max(3, (_TILE // (contacts.n_c * directions)).bit_length() - 1)


@dataclass(frozen=True)
class Chain(Audited):
    """Some formulations as a batched function; its results are pairs of a solution and a scaled point, by name."""

    names: tuple[str, ...]
    cone_edges: int
    norm_bound: bool
    tile: int

    @property
    def rows(self) -> int:
        """The number of rows of a contact."""
        return self.cone_edges

    @property
    def stages(self) -> tuple:
        """Scale the grasps, solve the programs of all formulations, and decide from their outcomes."""
        solved = [name for name in self.names if self._twin(name) == name]
        return (
            lambda grasps, _: self._programs(grasps),
            Each(dict.fromkeys(solved, solve_program)),
            lambda solved: self._solutions(*solved),
        )

    def tangents(self, along: Along, out: dict) -> dict:
        """The derivative by the envelope theorem."""
        values = {name: (solution.margin, solution.directions) for name, (solution, _) in out.items()}
        changes = along.adjoint(self._adjoint, out, values)
        changed = {}
        for name, (solution, point) in out.items():
            margin, directions = changes[name]
            moved: dict[str, Any] = {"margin": margin, "upper_bound": margin, "directions": directions}
            still = jax.tree.map(lambda _: None, point)
            leaves: dict[str, Tree] = {f.name: moved.get(f.name) for f in fields(solution)}
            changed[name] = FormulationSolution(**leaves), still
        return changed

    def judge(self, arguments: Arguments, out: dict, anew: bool) -> dict[str, ChainVerdict]:
        """Hold every lane against the rules of the audit."""
        problem = problem_of(arguments)
        basics, scaled = self._scaled(admit_all(arguments)) if anew else (None, {})
        return {
            name: self._judged(name, problem, solution, point, basics, scaled.get(self._twin(name)))
            for name, (solution, point) in out.items()
        }

    def spot(self, arguments: Arguments, out: dict) -> dict[str, jax.Array]:
        """Nothing: programs put together anew take as long to compile as they did at first."""
        return {name: jnp.zeros(solution.margin.shape, bool) for name, (solution, _) in out.items()}

    def correct(self, out: dict, verdicts: dict[str, ChainVerdict]) -> dict:
        """Take back what the audit does not confirm."""
        changed = {}
        for name, (solution, point) in out.items():
            failed, confirmed = verdicts[name]
            instead = {"margin": confirmed, "status": Status.NOT_VERIFIED}
            instead |= dict.fromkeys(("upper_bound", "directions", "forces", "disturbed_forces", "gap"), jnp.nan)
            fields_changed = {field: hidden(getattr(solution, field), failed, x) for field, x in instead.items()}
            changed[name] = replace(solution, **fields_changed), point
        return changed

    def _judged(
        self,
        name: str,
        problem: Problem,
        solution: FormulationSolution,
        point: ConicPoint,
        basics: Basics | None,
        scaled: Scaled | None,
    ) -> ChainVerdict:
        """The audit of one formulation; with programs put together anew also of what multipliers prove."""
        form, margin, directions = FORMULATIONS[name], solution.margin, solution.directions
        check = form.exact, self.cone_edges, self.norm_bound and form.exact
        holds = jnp.ones(margin.shape, bool)
        if name != "per_direction":
            wrenches = disturbed_wrenches(problem, jnp.broadcast_to(margin[:, None], directions.shape))
            holds &= balanced(problem, solution.forces) & admissible(problem, solution.forces, *check)
            holds &= all_hold(problem, solution.disturbed_forces, wrenches, check)
        else:
            # Nothing ties the directions together but the smallest of their margins.
            sliding = problem.friction * problem.max_force
            sizes = jnp.stack([sliding, sliding, problem.max_force, sliding][: point.x.shape[1]], 1)
            sizes *= jnp.swapaxes(problem.transmits, 1, 2).astype(sizes.dtype)
            forces = jnp.moveaxis(point.x[..., :-1] * sizes[..., None], (3, 2), (1, 2))
            wrenches = disturbed_wrenches(problem, directions)
            looked_at = jnp.isfinite(directions) & (directions > 0)
            each = jax.vmap(lambda f, w: balanced(problem, f, w) & admissible(problem, f, *check), (1, 1), 1)
            holds &= (each(forces, wrenches) | ~looked_at).all(1)
        scale, proven = jnp.ones_like(margin), None
        if basics is not None and scaled is not None:
            last = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), point)
            bounds = proven_bounds(scaled.problem, last) * scaled.scale
            bounds = jnp.broadcast_to(bounds[: 1 if bounds.shape[0] == 1 else directions.shape[1]], directions.T.shape)
            bounds = jnp.where(basics.outside, 0, jnp.where(basics.disturbed, bounds, jnp.inf))
            proven, scale = jnp.min(bounds, 0), jnp.max(scaled.scale, 0)
            if not form.free and form.one_f0 and problem.per_vertex is None:
                changes = solution.disturbed_forces - solution.forces[:, None]
                holds &= blocking_forces_stand(problem, changes, margin)
        else:
            scale = jnp.full_like(margin, jnp.inf)
        solved = settled(margin, solution.upper_bound, proven, scale, holds)
        claimed = solution.status == Status.SOLVED
        return ChainVerdict(claimed & ~solved, jnp.where(holds, margin, jnp.nan))

    def _scaled(self, grasps: Grasps) -> tuple[Basics, dict[str, Scaled]]:
        """The scaled programs by name of the formulation; those that solve the same programs share them."""
        forms = {name: FORMULATIONS[name] for name in self.names}
        basics = compute_basics(grasps, any(not form.free for form in forms.values()))
        found: dict[str, Scaled] = {}
        for name, form in forms.items():
            if self._twin(name) == name:
                norm_bound = self.norm_bound and form.exact
                found[name] = scale_formulation(grasps, basics, form, self.cone_edges, norm_bound)
        return basics, found

    def _twin(self, name: str) -> str:
        """The formulation whose programs this one shares: with free reactions, one f_0 for all costs nothing more."""
        form = FORMULATIONS[name]
        return next(o for o in self.names if FORMULATIONS[o][:2] == form[:2] and (form.free or o == name))

    def _programs(self, grasps: Grasps) -> tuple:
        basics, scaled = self._scaled(grasps)
        selected = {name: select_programs(grasps, basics, own, FORMULATIONS[name].free) for name, own in scaled.items()}
        scales = {name: own.scale for name, own in scaled.items()}
        return (replace(grasps, terms=(), extents=(), compliance=None), basics, scales), selected

    def _solutions(self, scaled_grasps: tuple, solved: dict[str, ConicOutcome]) -> dict:
        grasps, basics, scales = scaled_grasps
        solutions = {}
        for name in self.names:
            twin, form = self._twin(name), FORMULATIONS[name]
            rows = contact_rows(grasps, basics, form.exact, self.cone_edges, self.norm_bound and form.exact)
            solution = build_solution(grasps, basics, scales[twin], rows, form, solved[twin])
            solutions[name] = solution, solved[twin].point
        return solutions

    def _adjoint(self, grasps: Grasps, held: dict, cotangents: dict) -> Grasps:
        """The gradient of the Lagrangians with respect to the data, times cotangents of margins and directions."""
        _, scaled = self._scaled(grasps)
        weights, points = {}, {}
        for name, (solution, point) in held.items():
            given = scaled[self._twin(name)], FORMULATIONS[name]
            weights[name] = _program_weights(solution, cotangents[name], *given)
            # Nothing but the weights may depend on the cotangents, in which the adjoint is linear.
            counted = _program_weights(solution, (None, jnp.ones_like(solution.directions)), *given) != 0
            points[name] = jax.tree.map(lambda x, counted=counted: jnp.where(counted, x, 0), point)

        def value(grasps: Grasps) -> jax.Array:
            _, scaled = self._scaled(grasps)
            lagrangian = lambda name: scaled[self._twin(name)].problem.lagrangian(points[name])
            return -fold(jnp.add, [jnp.sum(weights[name] * lagrangian(name)) for name in held])

        return jax.grad(value, allow_int=True)(grasps)


def _program_weights(solution: FormulationSolution, cotangents: tuple, scaled: Scaled, form: Formulation) -> jax.Array:
    """Turn cotangents of margin and directions into those of the optima of the programs, (D, *lanes)."""
    directions, scale = solution.directions, scaled.scale
    weights = jnp.zeros_like(directions)
    if cotangents[0] is not None:
        binds = jnp.arange(weights.shape[0])[:, None] == jnp.argmin(directions, 0)
        weights = weights + jnp.where(binds, cotangents[0], 0)
    if cotangents[1] is not None:
        weights = weights + cotangents[1]
    # A margin of zero is flat, or zero by definition.
    least = ACCEPTED[scale.dtype.name] * (scale if scale.shape[0] == 1 else scale[: weights.shape[0]])
    weights = jnp.where(jnp.isfinite(directions) & (directions > least), weights, 0)
    if form.free:
        weights = jnp.concatenate([weights, jnp.zeros_like(weights[:1])])
    elif form.one_f0:
        weights = fold(jnp.add, weights)[None]
    return weights * scale
