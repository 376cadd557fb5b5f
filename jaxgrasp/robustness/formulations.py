"""The paper's chain of formulations, (12), (13), (16), (21) and their like, each with its own largest disturbance.

All ask for the largest lambda such that forces f_0 hold the object at rest and f_0 + delta f_j while lambda W_j acts:

    G f_0 = b,   G delta f_j = -lambda W_j,   f_0 and every f_0 + delta f_j admissible.

They differ in what is admissible (Coulomb's cone or the inscribed pyramid; |f| or |f_n| at most f_max) and in whether
delta f_j is free or the blocking force (15).
"""

from dataclasses import dataclass, fields
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxgrasp.arrays import fold
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import Vertices
from jaxgrasp.robustness.chain import FORMULATIONS, Scaled, scaled_formulation
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.kernels import Along
from jaxgrasp.solvers import conic_margin
from jaxgrasp.solvers.conic_margin import ConicOutcome, ConicPoint
from jaxgrasp.solvers.status import Status

_TOLERANCE = {"float64": 1e-9, "float32": 1e-5}
# Residuals and gaps that did not close to the tolerance still count as solved below this, and bounds below zero as zero.
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
        disturbs); MAX_ITERATIONS; INVALID_INPUT.

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
    kernel = _LargestBy(formulation, cone_edges, force_bound == "norm")
    return over_grasps(kernel, contacts, disturbances, required_wrench=required_wrench, compliance=compliance)[0]


def check_vertices(disturbances: DisturbanceSet) -> None:
    """Refuse sets that are not given by vertices."""
    terms = getattr(disturbances, "terms", None)
    if terms is not None and (len(terms) != 1 or not isinstance(terms[0], Vertices) or terms[0].width is not None):
        raise ValueError(
            "disturbances: got a set that is not given by vertices, wanted a single DisturbanceSet.vertices or .forces"
        )


@dataclass(frozen=True)
class _LargestBy:
    """The kernel of one formulation."""

    formulation: str
    cone_edges: int
    norm_bound: bool
    compact = False

    @property
    def rows(self) -> int:
        return self.cone_edges

    @property
    def stages(self) -> tuple:
        """See `Kernel`."""
        return (lambda grasps, _: (grasps, self._scaled(grasps)), lambda given: self._solve(*given))

    def tangents(self, along: Along, out: tuple) -> tuple:
        """See `Kernel`."""
        solution, point = out
        margin, directions = along.adjoint(self._adjoint, (solution, point), (solution.margin, solution.directions))
        changes = {"margin": margin, "upper_bound": margin, "directions": directions}
        still = ConicPoint(None, None, None, (None,) * len(point.z))
        return FormulationSolution(**{f.name: changes.get(f.name) for f in fields(solution)}), still

    def _scaled(self, grasps: Grasps) -> Scaled:
        return scaled_formulation(grasps, FORMULATIONS[self.formulation], self.cone_edges, self.norm_bound)

    def _solve(self, grasps: Grasps, scaled: Scaled) -> tuple[FormulationSolution, ConicPoint]:
        form, problem = FORMULATIONS[self.formulation], scaled.problem
        dtype = scaled.scale.dtype
        accepted = _ACCEPTED[dtype.name]
        count, rest = scaled.disturbed.shape[0], slice(-1, None)
        runs = jnp.broadcast_to(grasps.valid & ~scaled.wrench_outside, scaled.scale.shape)
        if form.free:
            runs &= jnp.concatenate([scaled.disturbed & ~scaled.outside, jnp.ones_like(runs[rest])])
        out = conic_margin.solve(problem, _TOLERANCE[dtype.name], runs)
        size = jnp.maximum(1, jnp.abs(out.point.margin))
        solved = (out.error <= accepted) & ~out.infeasible
        value, bound = jnp.minimum(out.point.margin, out.upper), out.upper
        # What is zero to the tolerance is zero.
        value = jnp.where(solved & (jnp.abs(value) <= accepted), jnp.maximum(value, 0), value)
        hopeless = out.infeasible | (solved & (value < 0)) | (bound < -accepted)
        known = solved | hopeless

        if form.free:
            holds = known[-1] & ~hopeless[-1]
            lost = known[-1] & hopeless[-1]
            own_known = known[:-1] | ~scaled.disturbed | scaled.outside
            fails = hopeless[:-1] & scaled.disturbed & ~scaled.outside
            # Directions that contact forces do not reach: only none of it can be borne, by an admissible f_0.
            fails |= scaled.outside & lost
            unknown = ~own_known.all(0)
            if form.shared:
                infeasible, unknown = lost, unknown | ~known[-1] | (holds & fails.any(0))
            else:
                infeasible, unknown = fails.any(0), unknown | (scaled.outside.any(0) & ~known[-1])
            idle = ~scaled.disturbed.any(0)
            infeasible |= idle & lost
            unknown |= idle & ~known[-1]
        else:
            infeasible, unknown = hopeless.any(0), ~known.all(0)
        each = lambda v: jnp.broadcast_to(v[:count] if v.shape[0] != 1 else v, scaled.disturbed.shape)  # noqa: E731
        scale = scaled.scale
        told = lambda v: jnp.where(scaled.outside, 0, jnp.where(scaled.disturbed, each(v * scale), jnp.inf))  # noqa: E731
        directions, upper = told(value), told(bound)
        undisturbed = ~scaled.disturbed.any(0)
        decided = [
            (~grasps.valid, Status.INVALID_INPUT),
            (scaled.wrench_outside | infeasible, Status.INFEASIBLE),
            (unknown, Status.MAX_ITERATIONS),
            (undisturbed, Status.UNBOUNDED),
        ]
        status = jnp.select([c for c, _ in decided], [s for _, s in decided], Status.SOLVED).astype(jnp.int32)
        answered = (status == Status.SOLVED) | (status == Status.UNBOUNDED)
        hide = lambda v: jnp.where(answered, v, jnp.nan)  # noqa: E731
        if not (form.free or form.shared):
            # Each direction has its own program: an f_0 that fails one of them fails all.
            directions = jnp.where(scaled.disturbed, directions, jnp.inf)
        margin, worst = jnp.min(directions, 0), jnp.argmin(directions, 0)
        upper = jnp.maximum(jnp.min(upper, 0), margin)
        program = worst if scale.shape[0] > 1 else jnp.zeros_like(worst)
        forces, disturbed = _forces(scaled, form.shared, out, directions, margin, program)
        finite = answered & ~undisturbed & ~scaled.outside.any(0)
        direction, contact, row = _binding(scaled, out.point, program, finite)
        binds = _pick(scale, program)
        solution = FormulationSolution(
            margin=hide(margin),
            upper_bound=hide(upper),
            directions=hide(directions),
            forces=jnp.where(answered, jnp.moveaxis(forces * grasps.present, 1, 0), jnp.nan),
            disturbed_forces=jnp.where(answered, jnp.moveaxis(disturbed * grasps.present, 2, 1), jnp.nan),
            status=status,
            direction=jnp.where(finite & (direction < 0), worst if form.free else direction, direction)
            if form.free
            else direction,
            contact=contact,
            row=row,
            iterations=jnp.max(out.iterations, 0),
            primal_residual=hide(jnp.max(jnp.where(runs, out.residual, 0), 0)),
            gap=hide(jnp.where(finite, (upper - margin) / jnp.maximum(binds, margin), 0)),
        )
        return solution, jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-2], *scale.shape)), out.point)

    def _adjoint(self, grasps: Grasps, held: tuple, cotangents: tuple, names: frozenset) -> Grasps:
        """The gradient of the Lagrangians with respect to the data, times cotangents of margin and directions."""
        solution, point = held
        scaled = self._scaled(grasps)
        finite = jnp.isfinite(solution.directions) & (solution.directions > _ACCEPTED[scaled.scale.dtype.name] * scaled.scale[: solution.directions.shape[0]])
        finite &= ~scaled.outside
        weight = jnp.zeros_like(solution.directions)
        worst = jnp.argmin(solution.directions, 0)
        if cotangents[0] is not None:
            weight = weight + jnp.where(jnp.arange(weight.shape[0])[:, None] == worst, cotangents[0], 0)
        if cotangents[1] is not None:
            weight = weight + cotangents[1]
        weight = jnp.where(finite, weight, 0)
        if scaled.scale.shape[0] == 1:
            weight = fold(jnp.add, weight)[None]
        elif scaled.free:
            weight = jnp.concatenate([weight, jnp.zeros_like(weight[:1])])
        weight = weight * scaled.scale
        point = jax.tree.map(lambda x: jnp.where(weight != 0, x, 0), point)

        def value(grasps: Grasps) -> jax.Array:
            return -jnp.sum(weight * self._scaled(grasps).problem.lagrangian(point))

        return jax.grad(value, allow_int=True)(grasps)


def _forces(
    scaled: Scaled, shared: bool, out: ConicOutcome, directions: jax.Array, margin: jax.Array, program: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """f_0 (3, n, *lanes) and f_0 + delta f_j at the margin (n_d, 3, n, *lanes), N."""
    x = jnp.moveaxis(out.point.x, 2, 0) * scaled.sizes
    if scaled.free:
        rest = x[-1]
        # On the way from f_0 to what bears the most that this direction allows.
        share = jnp.where(jnp.isfinite(directions) & (directions > 0), margin / jnp.where(directions > 0, directions, 1), 0)
        return rest, rest + share[:, None, None] * (x[:-1] - rest)
    reach = jnp.where(jnp.isfinite(margin), margin, 0)
    disturbed = x + reach * scaled.answers
    return _pick(x, program), disturbed


def _pick(values: jax.Array, program: jax.Array) -> jax.Array:
    """Of (D, ..., *lanes) what belongs to the program, (..., *lanes)."""
    index = program.reshape(*[1] * (values.ndim - 1), -1)
    return jnp.take_along_axis(values, jnp.broadcast_to(index, (1, *values.shape[1:-1], index.shape[-1])), 0)[0]


def _binding(
    scaled: Scaled, point: ConicPoint, program: jax.Array, finite: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Direction, contact and row of the largest multiplier of the program that binds; -1 where there is none."""
    rows = []
    for part, z in zip(scaled.problem.rows, point.z, strict=True):
        # (d, J, n, *lanes): of a second-order cone the head is the size of the whole.
        own = _pick(jnp.moveaxis(z, 3, 0), program)
        rows.append(own[:1] if part.second_order else own)
    z = jnp.concatenate(rows)
    count, copies, n, lanes = z.shape
    where = jnp.argmax(z.reshape(-1, lanes), 0)
    row, copy, contact = where // (copies * n), where // n % copies, where % n
    if scaled.free:
        direction = program
    else:
        # Copies are the directions and, last, the forces at rest.
        direction = jnp.where(copy == copies - 1, -1, program if copies == 2 and scaled.scale.shape[0] > 1 else copy)
    hide = lambda v: jnp.where(finite, v, -1).astype(jnp.int32)  # noqa: E731
    return hide(direction), hide(contact), hide(row)
