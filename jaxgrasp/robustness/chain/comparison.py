"""All formulations of the paper side by side, and forces for disturbances that are given outright, (6) and (9)-(10)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from jaxgrasp.arrays import literal
from jaxgrasp.compiling import own_settings
from jaxgrasp.contact.compliance import Compliance
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import contact_facets, pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.records import record
from jaxgrasp.robustness.chain.formulations import (
    Chain,
    check_tolerance,
    check_vertices,
    choose_tile,
    formulation_margin,
)
from jaxgrasp.robustness.chain.members import polytope_of
from jaxgrasp.robustness.chain.programs import FORMULATIONS
from jaxgrasp.robustness.chain.verdicts import FormulationSolution
from jaxgrasp.robustness.grasps import over_grasps
from jaxgrasp.robustness.interface.arguments import GraspData
from jaxgrasp.robustness.interface.solution import Solution
from jaxgrasp.robustness.tightening.margin import largest_disturbance
from jaxgrasp.solvers.status import Status

# What lies between neighbours of the chain: the larger margin first.
STEPS = {
    "pyramids for cones": ("12", "13"),
    "pyramids for cones, answers fixed": ("12_fixed", "16"),
    "fixed answers": ("13", "16"),
    "fixed answers, exact cones": ("12", "12_fixed"),
    "one f_0 for all directions": ("per_direction_prestrained", "16"),
    "an f_0 at all": ("per_direction", "13"),
    "worst case row by row": ("16", "21"),
}


@record
class Binding:
    """The constraint that decides a margin: it has the largest multiplier, forces in units of their bounds."""

    direction: Int[Array, "*batch"]
    """The disturbance, -1 where the forces at rest decide or there is no answer; 0 for the worst member of a set whose
    directions are refined."""
    contact: Int[Array, "*batch"]
    """-1 where there is no answer."""
    row: Int[Array, "*batch"]
    """Facets 0 .. n_e - 1, then the bound on the force; with exact cones 0 for friction and 1 for the bound."""


@record
class Comparison:
    """Every formulation on the same grasps, in dictionaries.

    By "12", "12_fixed", "13", "16", "per_direction" and "per_direction_prestrained", see `formulation_margin`, and
    "21", which is `largest_disturbance`.
    """

    margins: dict[str, Float[Array, "*batch"]]
    """lambda; NaN where there is no answer, for "21" negative where the required wrench cannot be borne."""
    upper_bounds: dict[str, Float[Array, "*batch"]]
    """Certified."""
    statuses: dict[str, Int[Array, "*batch"]]
    """`Status`."""
    bindings: dict[str, Binding]
    """The constraint that decides each margin."""
    gaps: dict[str, Float[Array, "*batch"]]
    """What each step of the chain costs: differences of margins, by the names of `STEPS`. Those with the same cones and
    the same bound are not negative; NaN where one of the two has no answer."""


@own_settings()
def compare_formulations(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    required_wrench: ArrayLike | None = None,
    compliance: ArrayLike | Compliance | None = None,
    cone_edges: int = 8,
    force_bound: str = "normal",
    tolerance: float | None = None,
    cone_margin: ArrayLike | None = None,
) -> Comparison:
    """The margins of a batch of grasps by every formulation of the paper's chain.

    In comparable forms, which are the default, "21" = "16" <= "13" <= "12": inscribed pyramids, and |f_n| <= f_max in
    all of them. With force_bound = "norm" (12) bounds |f| as the paper prints it; it may then fall below (13).

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D, as in `formulation_margin`.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        compliance: Q of (14), as in `largest_disturbance`; only blocking forces depend on it.
        cone_edges: n_e of the inscribed pyramids.
        force_bound: "normal" or "norm", of "12" and "12_fixed".
        tolerance: as in `formulation_margin`; where directions are refined, margins are lower bounds.
        cone_margin: d, N, >= 0: a grasp or a contact, as in `formulation_margin`. "12" and "12_fixed" have no rows for
            one value a row.

    Returns:
        Comparison with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Derivatives:
        Of margins, upper bounds and gaps, as in `formulation_margin` and `largest_disturbance`.
    """
    if force_bound not in ("normal", "norm"):
        raise ValueError(f"force_bound: got {force_bound!r}, wanted 'normal' or 'norm'")
    pyramid_facets(cone_edges)
    check_tolerance(tolerance)
    data = GraspData.from_arguments(contacts, disturbances, required_wrench, compliance, cone_margin)
    polytope = polytope_of(disturbances)
    if polytope is not None:
        kernel = Chain(tuple(FORMULATIONS), cone_edges, force_bound == "norm", choose_tile(contacts, polytope))
        found = over_grasps(kernel, replace(data, disturbances=polytope))
        unreduced: dict[str, FormulationSolution] = {name: solution for name, (solution, _) in found.items()}
    else:
        bounds = {name: force_bound if form.exact else "normal" for name, form in FORMULATIONS.items()}
        given = required_wrench, compliance, cone_edges
        unreduced = {
            name: formulation_margin(contacts, disturbances, name, *given, bound, tolerance, cone_margin)
            for name, bound in bounds.items()
        }
    reserve = 0.0 if cone_margin is None else cone_margin
    reduced = largest_disturbance(contacts, disturbances, required_wrench, compliance, cone_edges, reserve)
    solutions: dict[str, FormulationSolution | Solution] = {**unreduced, "21": reduced}
    bindings = {name: Binding(direction=s.direction, contact=s.contact, row=s.row) for name, s in unreduced.items()}
    bindings["21"] = _binding(contacts, reduced, unreduced["16"], cone_edges)
    margins = {name: solution.margin for name, solution in solutions.items()}
    return Comparison(
        margins=margins,
        upper_bounds={name: solution.upper_bound for name, solution in solutions.items()},
        statuses={name: solution.status for name, solution in solutions.items()},
        bindings=bindings,
        gaps={step: _difference(margins[more], margins[less]) for step, (more, less) in STEPS.items()},
    )


def _difference(more: jax.Array, less: jax.Array) -> jax.Array:
    """More - less, 0 where both are infinite."""
    same = jnp.isinf(more) & jnp.isinf(less)
    return jnp.where(same, 0, more - jnp.where(same, 0, less))


def _binding(contacts: Contacts, reduced: Solution, unreduced: FormulationSolution, cone_edges: int) -> Binding:
    """What decides (21), whose rows do not tell the direction: the one that loads the deciding row most."""
    # Without friction the rows say that a finger does not pull, see `admit`.
    friction = jnp.where(contacts.friction == 0, 1, contacts.friction)
    friction, bound = (jnp.broadcast_to(x, reduced.bound_multipliers.shape) for x in (friction, contacts.max_force))
    z = jnp.concatenate(
        [reduced.cone_multipliers * (friction * bound)[..., None], (reduced.bound_multipliers * bound)[..., None]], -1
    )
    flat = z.reshape(*z.shape[:-2], z.shape[-2] * z.shape[-1])
    where = jnp.argmax(flat, -1)
    contact, row = where // z.shape[-1], where % z.shape[-1]
    facets = literal(contact_facets(cone_edges, contacts.components), z.dtype)
    # (*batch, directions, n, k), moments in newtons: the blocking forces, as far as the margin goes.
    moved = unreduced.disturbed_forces - unreduced.forces[..., None, :, :]
    moved = jnp.take_along_axis(moved, contact[..., None, None, None], -2)[..., 0, :]
    mu = jnp.take_along_axis(friction, contact[..., None], -1)[..., None]
    slip = moved[..., :2] @ facets[:, :2].T + mu * moved[..., 2:3] * facets[:, 2]
    if contacts.torsional_friction is not None:
        slip = slip + moved[..., 3:] * facets[:, 3]
    loads = jnp.concatenate([slip, -moved[..., 2:3]], -1)
    loads = jnp.take_along_axis(loads, row[..., None, None], -1)[..., 0]
    binds = jnp.isfinite(reduced.margin) & (reduced.margin >= 0) & (jnp.max(flat, -1) > 0)
    direction = jnp.where(jnp.max(loads, -1) > 0, jnp.argmax(loads, -1), -1)
    where_binding = lambda v: jnp.where(binds, v, -1).astype(jnp.int32)
    return Binding(direction=where_binding(direction), contact=where_binding(contact), row=where_binding(row))


@record
class SpecifiedDisturbances:
    """The result of `specified_disturbances`."""

    forces: Float[Array, "*batch contacts 3"]
    """f_0, contact frames, N: as far inside all rows as can be; 0 for absent contacts, NaN where there is none."""
    changes: Float[Array, "*batch directions contacts 3"]
    """delta f_j, contact frames, N."""
    margin: Float[Array, "*batch"]
    """The factor by which the disturbances could be scaled; NaN where b alone cannot be borne."""
    status: Int[Array, "*batch"]
    """SOLVED where there are such forces, INFEASIBLE where there are none; otherwise as for the margin."""
    moments: Float[Array, "*batch contacts"] | None = None
    """The moments about the normals that come with `forces`, N m; None for hard contacts."""
    moment_changes: Float[Array, "*batch directions contacts"] | None = None
    """The same of `changes`."""


@own_settings()
def specified_disturbances(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    equation: str = "9",
    required_wrench: ArrayLike | None = None,
    cone_edges: int = 8,
    force_bound: str | None = None,
    cone_margin: ArrayLike | None = None,
) -> SpecifiedDisturbances:
    """Whether some f_0 holds the object against disturbances that are given outright, and which: (6) or (9)-(10).

    G f_0 = b, G delta f_j = -W_j, f_0 and every f_0 + delta f_j admissible. Equation (6) asks for Coulomb's cones and
    bounds |f|, (9)-(10) for the inscribed pyramids and bound |f_n|. So (9) implies (6) only where (6) bounds |f_n| too
    (force_bound = "normal"), or where (9) is given f_max / sqrt(1 + mu^2); with the norm of (6), as printed, it does
    not.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: W_j, a single `DisturbanceSet.vertices` or `.forces`, at full size.
        equation: "6" or "9".
        required_wrench: b (*batch, 6), N and N m; None is zero.
        cone_edges: n_e of (9).
        force_bound: "norm" or "normal"; None is what the equation says.
        cone_margin: d of (1), N, >= 0: a grasp, a contact or, for (9), a row, as in `formulation_margin`; None is none.

    Returns:
        SpecifiedDisturbances with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit; at trace time.

    Status:
        SOLVED (also where nothing disturbs); INFEASIBLE; otherwise as in `formulation_margin`.

    Derivatives:
        Of the margin, as in `formulation_margin`; forces count as constant.
    """
    if equation not in ("6", "9"):
        raise ValueError(f"equation: got {equation!r}, wanted '6' or '9'")
    exact = equation == "6"
    bound = force_bound or ("norm" if exact else "normal")
    formulation = "12" if exact else "13"
    check_vertices(disturbances)
    given = required_wrench, None, cone_edges, bound
    found = formulation_margin(contacts, disturbances, formulation, *given, cone_margin=cone_margin)
    margin = found.margin
    tolerance = 1e-7 if margin.dtype == jnp.float64 else 1e-4
    has_margin = (found.status == Status.SOLVED) | (found.status == Status.UNBOUNDED)
    holds = has_margin & (margin >= 1 - tolerance)
    status = jnp.where(holds, Status.SOLVED, jnp.where(has_margin, Status.INFEASIBLE, found.status)).astype(jnp.int32)
    # At lambda = margin the forces are admissible, at 0 as well, so they are in between.
    share = jnp.where(holds, 1 / jnp.where(holds, margin, 1), jnp.nan)[..., None, None]
    moved = found.disturbed_forces - found.forces[..., None, :, :]
    moments = moment_changes = None
    if found.moments is not None and found.disturbed_moments is not None:
        moments = jnp.where(holds[..., None], found.moments, jnp.nan)
        moment_changes = share * (found.disturbed_moments - found.moments[..., None, :])
    return SpecifiedDisturbances(
        forces=jnp.where(holds[..., None, None], found.forces, jnp.nan),
        changes=share[..., None] * moved,
        margin=margin,
        status=status,
        moments=moments,
        moment_changes=moment_changes,
    )
