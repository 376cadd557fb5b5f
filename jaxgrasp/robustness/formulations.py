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
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgrasp.arrays import fold
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import Vertices
from jaxgrasp.robustness.chain import (
    FORMULATIONS,
    Basics,
    Formulation,
    Scaled,
    basics,
    contact_rows,
    scaled_formulation,
)
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.kernels import Along
from jaxgrasp.solvers import embedding
from jaxgrasp.solvers.conic_margin import ConeRows, ConicMargin
from jaxgrasp.solvers.embedding import ConicOutcome
from jaxgrasp.solvers.lanes import Each
from jaxgrasp.solvers.status import Status

_TOLERANCE = {"float64": 1e-9, "float32": 1e-5}
# Contacts under all directions in a tile.
_TILE = 1024
# Residuals and gaps that did not close to the tolerance still count as solved below this; less than this is zero.
_ACCEPTED = {"float64": 1e-7, "float32": 3e-4}


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class FormulationSolution:
    """What `formulation_margin` answers."""

    margin: Float[Array, "*batch"]
    """lambda >= 0; NaN where there is no answer, inf where nothing disturbs."""
    upper_bound: Float[Array, "*batch"]
    """Certified by multipliers: no forces whatever reach more."""
    directions: Float[Array, "*batch directions"]
    """The largest lambda of every direction by itself; where one program has all directions, its margin. inf for zero
    wrenches."""
    forces: Float[Array, "*batch contacts 3"]
    """f_0, contact frames, N; for "per_direction_prestrained" that of the direction that binds. 0 for absent contacts,
    NaN where there is none."""
    disturbed_forces: Float[Array, "*batch directions contacts 3"]
    """f_0 + delta f_j at lambda = margin, contact frames, N; NaN where there are none."""
    status: Int[Array, "*batch"]
    """`Status`."""
    direction: Int[Array, "*batch"]
    """The disturbance that binds, -1 where the forces at rest do or where there is no answer."""
    contact: Int[Array, "*batch"]
    """The contact that binds: of its rows one has the largest multiplier; -1 where there is no answer."""
    row: Int[Array, "*batch"]
    """The row of that contact: facets 0 .. n_e - 1, then the bound on the force; with exact cones 0 and 1."""
    iterations: Int[Array, "*batch"]
    """Interior-point steps, the most of any direction."""
    primal_residual: Float[Array, "*batch"]
    """Largest violation of any row or equality, forces in units of f_max (mu f_max along the surface)."""
    gap: Float[Array, "*batch"]
    """(upper_bound - margin) / max(scale, margin)."""


def formulation_margin(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    formulation: str,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    cone_edges: int = 8,
    force_bound: str = "normal",
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
    which the blocking forces add.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: W_j, a single `DisturbanceSet.vertices` or `.forces`.
        formulation: one of the names above.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q of (14), as in `largest_disturbance`; only blocking forces depend on it.
        cone_edges: n_e of the inscribed pyramids.
        force_bound: "normal" bounds |f_n| as (8) and the linear programs do, "norm" bounds |f| as (6) and (12) do. A
            norm is no linear row: only exact cones take it.

    Returns:
        FormulationSolution with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        SOLVED; INFEASIBLE (no admissible f_0, for "per_direction" no f at all; margin NaN); UNBOUNDED (nothing
        disturbs); MAX_ITERATIONS; INVALID_INPUT. As in `largest_disturbance`, a required wrench outside the range of G
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
    check_vertices(disturbances)
    pyramid_facets(cone_edges)
    kernel = Chain((formulation,), cone_edges, force_bound == "norm", tile_of(contacts, disturbances))
    solved = over_grasps(kernel, contacts, disturbances, required_wrench=required_wrench, compliance=compliance)
    return solved[formulation][0]


def check_vertices(disturbances: DisturbanceSet) -> None:
    """Refuse sets that are not given by vertices."""
    terms = getattr(disturbances, "terms", None)
    if terms is not None and (len(terms) != 1 or not isinstance(terms[0], Vertices) or terms[0].width is not None):
        raise ValueError(
            "disturbances: got a set that is not given by vertices, wanted a single DisturbanceSet.vertices or .forces"
        )


def tile_of(contacts: Contacts, disturbances: DisturbanceSet) -> int:
    """How many grasps to work on at a time.

    Of 32 to 1,024 with four contacts and six directions 32 were fastest, by a factor of five.
    """
    directions = disturbances.terms[0].wrenches.shape[-2] + 1
    return 1 << max(3, (_TILE // (contacts.n_c * directions)).bit_length() - 1)


@dataclass(frozen=True)
class Chain:
    """The kernel of some formulations; its results are pairs of a solution and a scaled point, by name."""

    names: tuple[str, ...]
    cone_edges: int
    norm_bound: bool
    tile: int

    @property
    def rows(self) -> int:
        """See `Kernel`."""
        return self.cone_edges

    @property
    def stages(self) -> tuple:
        """See `Kernel`."""
        solved = [name for name in self.names if self._twin(name) == name]
        return (
            lambda grasps, _: self._programs(grasps),
            Each(dict.fromkeys(solved, solved_program)),
            lambda given: self._answers(*given),
        )

    def tangents(self, along: Along, out: dict) -> dict:
        """See `Kernel`."""
        values = {name: (solution.margin, solution.directions) for name, (solution, _) in out.items()}
        changes = along.adjoint(self._adjoint, out, values)
        changed = {}
        for name, (solution, point) in out.items():
            margin, directions = changes[name]
            moved: dict[str, Any] = {"margin": margin, "upper_bound": margin, "directions": directions}
            still = jax.tree.map(lambda _: None, point)
            changed[name] = FormulationSolution(**{f.name: moved.get(f.name) for f in fields(solution)}), still
        return changed

    def _scaled(self, grasps: Grasps) -> tuple[Basics, dict[str, Scaled]]:
        """By name; formulations that solve the same programs share them."""
        forms = {name: FORMULATIONS[name] for name in self.names}
        shared = basics(grasps, any(not form.free for form in forms.values()))
        found: dict[str, Scaled] = {}
        for name, form in forms.items():
            if self._twin(name) == name:
                norm_bound = self.norm_bound and form.exact
                found[name] = scaled_formulation(grasps, shared, form, self.cone_edges, norm_bound)
        return shared, found

    def _twin(self, name: str) -> str:
        """The formulation whose programs this one shares: with free answers, an f_0 for all costs nothing more."""
        form = FORMULATIONS[name]
        return next(o for o in self.names if FORMULATIONS[o][:2] == form[:2] and (form.free or o == name))

    def _programs(self, grasps: Grasps) -> tuple:
        shared, scaled = self._scaled(grasps)
        wanted = {name: programs(grasps, shared, own, FORMULATIONS[name].free) for name, own in scaled.items()}
        scales = {name: own.scale for name, own in scaled.items()}
        return (replace(grasps, terms=(), extents=()), shared, scales), wanted

    def _answers(self, kept: tuple, solved: dict[str, ConicOutcome]) -> dict:
        grasps, shared, scales = kept
        answers = {}
        for name in self.names:
            twin, form = self._twin(name), FORMULATIONS[name]
            rows = contact_rows(form.exact, self.cone_edges, self.norm_bound and form.exact, grasps.friction)
            solution = formulation_answer(grasps, shared, scales[twin], rows, form, solved[twin])
            answers[name] = solution, solved[twin].point
        return answers

    def _adjoint(self, grasps: Grasps, held: dict, cotangents: dict, names: frozenset) -> Grasps:
        """The gradient of the Lagrangians with respect to the data, times cotangents of margins and directions."""
        _, scaled = self._scaled(grasps)
        weights, points = {}, {}
        for name, (solution, point) in held.items():
            weight = _program_weights(solution, cotangents[name], scaled[self._twin(name)], FORMULATIONS[name])
            weights[name] = weight
            points[name] = jax.tree.map(lambda x, weight=weight: jnp.where(weight != 0, x, 0), point)

        def value(grasps: Grasps) -> jax.Array:
            _, scaled = self._scaled(grasps)
            lagrangian = lambda name: scaled[self._twin(name)].problem.lagrangian(points[name])  # noqa: E731
            return -fold(jnp.add, [jnp.sum(weights[name] * lagrangian(name)) for name in held])

        return jax.grad(value, allow_int=True)(grasps)


def _program_weights(solution: FormulationSolution, cotangents: tuple, scaled: Scaled, form: Formulation) -> jax.Array:
    """What cotangents of margin and directions ask of the optima of the programs, (D, *lanes)."""
    directions, scale = solution.directions, scaled.scale
    given = jnp.zeros_like(directions)
    if cotangents[0] is not None:
        binds = jnp.arange(given.shape[0])[:, None] == jnp.argmin(directions, 0)
        given = given + jnp.where(binds, cotangents[0], 0)
    if cotangents[1] is not None:
        given = given + cotangents[1]
    # What is zero is flat, or zero by definition.
    least = _ACCEPTED[scale.dtype.name] * (scale if scale.shape[0] == 1 else scale[: given.shape[0]])
    given = jnp.where(jnp.isfinite(directions) & (directions > least), given, 0)
    if form.free:
        given = jnp.concatenate([given, jnp.zeros_like(given[:1])])
    elif form.shared:
        given = fold(jnp.add, given)[None]
    return given * scale


def programs(grasps: Grasps, shared: Basics, scaled: Scaled, free: bool) -> tuple[ConicMargin, jax.Array]:
    """The programs of a formulation, and which of them to solve: all but those whose answer is known."""
    runs = jnp.broadcast_to(grasps.valid & ~shared.load_outside, scaled.scale.shape)
    if free:
        there = shared.disturbed & ~shared.outside
        runs &= jnp.concatenate([there, jnp.ones_like(there[:1])])
    return scaled.problem, runs


def solved_program(given: tuple[ConicMargin, jax.Array]) -> ConicOutcome:
    """The outcome of a program for every lane that asks for it."""
    problem, runs = given
    return embedding.solve(problem, _TOLERANCE[problem.rhs.dtype.name], runs)


def formulation_answer(
    grasps: Grasps, shared: Basics, scale: jax.Array, rows: list[ConeRows], form: Formulation, out: ConicOutcome
) -> FormulationSolution:
    """What the outcome of its programs, with these rows of a contact, says about a formulation."""
    accepted = _ACCEPTED[scale.dtype.name]
    value, bound = jnp.minimum(out.point.margin, out.upper), out.upper
    solved = (out.error <= accepted) & ~out.infeasible
    # What is zero to the tolerance is zero.
    value = jnp.where(solved & (jnp.abs(value) <= accepted), jnp.maximum(value, 0), value)
    hopeless = out.infeasible | (solved & (value < 0)) | (bound < -accepted)
    infeasible, unknown = _verdict(shared, form, solved | hopeless, hopeless)

    def each_direction(values: jax.Array) -> jax.Array:
        values = values * scale
        own = jnp.broadcast_to(
            values[: 1 if values.shape[0] == 1 else shared.disturbed.shape[0]], shared.disturbed.shape
        )
        return jnp.where(shared.outside, 0, jnp.where(shared.disturbed, own, jnp.inf))

    directions, upper = each_direction(value), each_direction(bound)
    undisturbed = ~shared.disturbed.any(0)
    status = jnp.select(
        [~grasps.valid, shared.load_outside | infeasible, unknown, undisturbed],
        [Status.INVALID_INPUT, Status.INFEASIBLE, Status.MAX_ITERATIONS, Status.UNBOUNDED],
        Status.SOLVED,
    ).astype(jnp.int32)
    answered = (status == Status.SOLVED) | (status == Status.UNBOUNDED)
    hide = lambda v: jnp.where(answered, v, jnp.nan)  # noqa: E731
    margin, worst = jnp.min(directions, 0), jnp.argmin(directions, 0)
    upper = jnp.maximum(jnp.min(upper, 0), margin)
    program = worst if scale.shape[0] > 1 else jnp.zeros_like(worst)
    forces, disturbed = _forces(shared, form, out.point.x, directions, margin, program)
    finite = answered & ~undisturbed & ~shared.outside.any(0)
    direction, contact, row = _binding(shared, rows, form, out.point.z, program)
    told = lambda v: jnp.where(finite, v, -1).astype(jnp.int32)  # noqa: E731
    return FormulationSolution(
        margin=hide(margin),
        upper_bound=hide(upper),
        directions=hide(directions),
        forces=hide(jnp.moveaxis(forces * grasps.present, 1, 0)),
        disturbed_forces=hide(jnp.moveaxis(disturbed * grasps.present, 2, 1)),
        status=status,
        direction=told(direction),
        contact=told(contact),
        row=told(row),
        iterations=jnp.max(out.iterations, 0),
        primal_residual=hide(jnp.max(jnp.where(out.iterations > 0, out.residual, 0), 0)),
        gap=hide(jnp.where(finite, (upper - margin) / jnp.maximum(_pick(scale, program), margin), 0)),
    )


def _verdict(shared: Basics, form: Formulation, known: jax.Array, hopeless: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whether there are no admissible forces, and whether that cannot be told, (*lanes)."""
    if not form.free:
        return hopeless.any(0), ~known.all(0)
    there, idle = shared.disturbed & ~shared.outside, ~shared.disturbed.any(0)
    fails, told = hopeless[:-1] & there, (known[:-1] | ~there).all(0)
    no_rest, rest_known = hopeless[-1], known[-1]
    if form.shared:
        # With an f_0, each direction has forces for lambda = 0 at least.
        return no_rest, ~rest_known | ~no_rest & (~told | fails.any(0))
    # Of a direction that contact forces do not reach, nothing can be borne, and that by an f_0.
    by_rest = shared.outside.any(0) | idle
    return fails.any(0) | by_rest & no_rest, ~told | by_rest & ~rest_known


def _forces(
    shared: Basics, form: Formulation, x: jax.Array, directions: jax.Array, margin: jax.Array, program: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """f_0 (3, n, *lanes) and f_0 + delta f_j at the margin (n_d, 3, n, *lanes), N, of x (3, n, D, *lanes)."""
    own = jnp.moveaxis(x, 2, 0) * shared.sizes
    if form.free:
        # On the way from f_0 to what bears the most that this direction allows.
        some = jnp.isfinite(directions) & (directions > 0)
        share = jnp.where(some, margin / jnp.where(some, directions, 1), 0)
        return own[-1], own[-1] + share[:, None, None] * (own[:-1] - own[-1])
    return _pick(own, program), own + jnp.where(jnp.isfinite(margin), margin, 0) * shared.answers


def _pick(values: jax.Array, program: jax.Array) -> jax.Array:
    """Of (D, ..., *lanes) what belongs to the program, (..., *lanes)."""
    index = program.reshape(*[1] * (values.ndim - 1), -1)
    return jnp.take_along_axis(values, jnp.broadcast_to(index, (1, *values.shape[1:-1], index.shape[-1])), 0)[0]


def _binding(
    shared: Basics, rows: list[ConeRows], form: Formulation, z: tuple[jax.Array, ...], program: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Direction, contact and row of the largest multiplier of the program that binds; direction -1 for rest."""
    # (d, J, n, *lanes) each; of a second-order cone the head is the size of the whole.
    own = [_pick(jnp.moveaxis(z_p, 3, 0), program) for z_p in z]
    own = [z_p[:1] if part.second_order else z_p for part, z_p in zip(rows, own, strict=True)]
    flat = jnp.concatenate(own)
    _, copies, n, lanes = flat.shape
    where = jnp.argmax(flat.reshape(-1, lanes), 0)
    row, copy, contact = where // (copies * n), where // n % copies, where % n
    if form.free:
        return program, contact, row
    if copies > 1:
        # The last copy is rest.
        return jnp.where(copy == copies - 1, -1, copy), contact, row
    # What of the blocking forces loads the row most.
    (pyramid,) = rows
    moved = shared.answers / shared.sizes
    moved = jnp.take_along_axis(moved, contact[None, None, None], 2)[:, :, 0]
    loads = pyramid.apply(jnp.moveaxis(moved, 0, 1)[:, :, None])[:, 0, :, 0]
    loads = jnp.take_along_axis(loads, row[None, None], 0)[0]
    worst = jnp.argmax(loads, 0) if form.shared else program
    return jnp.where(_pick(loads, worst) > 0, worst, -1), contact, row
