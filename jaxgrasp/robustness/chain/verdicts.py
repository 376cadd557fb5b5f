"""The chain's formulations, from the outcome of their programs to solutions with bounds and statuses."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgrasp.compiling import compiled
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.records import record
from jaxgrasp.robustness.chain.programs import Basics, Formulation, Scaled
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.robustness.interface.solution import split
from jaxgrasp.solvers.conic import embedding
from jaxgrasp.solvers.conic.embedding import ConicOutcome
from jaxgrasp.solvers.conic.margin import ConeRows, ConicMargin
from jaxgrasp.solvers.status import Status

_TOLERANCE = {"float64": 1e-9, "float32": 1e-5}
# On curved cones multipliers, and so derivatives, are off by the root of the gap.
_CONE_TOLERANCE = {"float64": 1e-10, "float32": 1e-5}
# Residuals and gaps that did not close to the tolerance still count as closed below this; margins below it are zero.
ACCEPTED = {"float64": 1e-7, "float32": 3e-4}
# How far forces may miss the wrench that they have to supply in the rows of G itself, of their sum. The programs' rows
# are orthonormal: where those of G nearly depend on each other, small residuals of the one are large ones of the other.
_MISSED = {"float64": 4e-8, "float32": 1.3e-5}


@record
class FormulationSolution:
    """The result of `formulation_margin`."""

    margin: Float[Array, "*batch"]
    """lambda >= 0; NaN where there is no margin, inf where nothing disturbs."""
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
    """The row of that contact: facets 0 .. n_e - 1 (2 n_e - 1 of soft contacts), then the bound on the force; with
    exact cones 0 and 1."""
    iterations: Int[Array, "*batch"]
    """Interior-point steps, the most of any direction."""
    primal_residual: Float[Array, "*batch"]
    """Largest violation of any row or equality, forces in units of f_max (mu f_max along the surface)."""
    gap: Float[Array, "*batch"]
    """(upper_bound - margin) / max(scale, margin), over upper_bound where directions are refined."""
    worst_wrench: Float[Array, "*batch 6"] | None = None
    """The member of the set that decides, N and N m, where directions are refined; else None."""
    moments: Float[Array, "*batch contacts"] | None = None
    """The moments about the normals that come with `forces`, N m; None for hard contacts."""
    disturbed_moments: Float[Array, "*batch directions contacts"] | None = None
    """The same of `disturbed_forces`."""


def with_moments(solution: FormulationSolution, contacts: Contacts) -> FormulationSolution:
    """Split the forces of soft contacts, whose fourth component is m / arm, into forces and moments."""
    return solution if contacts.torsional_friction is None else _split(solution, contacts)


@compiled
def _split(solution: FormulationSolution, contacts: Contacts) -> FormulationSolution:
    forces, moments = split(solution.forces, contacts)
    each = jax.tree.map(lambda x: jnp.expand_dims(x, len(contacts.batch_shape)), contacts)
    disturbed = split(solution.disturbed_forces, each)
    return replace(
        solution, forces=forces, moments=moments, disturbed_forces=disturbed[0], disturbed_moments=disturbed[1]
    )


def select_programs(grasps: Grasps, basics: Basics, scaled: Scaled, free: bool) -> tuple[ConicMargin, jax.Array]:
    """The programs of a formulation, and which of them to solve: all but those whose optimum is known."""
    runs = grasps.valid & ~basics.load_outside & (grasps.present > 0).any(0)
    runs = jnp.broadcast_to(runs, scaled.scale.shape)
    if free:
        unknown = basics.disturbed & ~basics.outside
        runs &= jnp.concatenate([unknown, jnp.ones_like(unknown[:1])])
    return scaled.problem, runs


def solve_program(problem_and_runs: tuple[ConicMargin, jax.Array]) -> ConicOutcome:
    """Solve a program for every lane that asks for it."""
    problem, runs = problem_and_runs
    tolerance = _CONE_TOLERANCE if any(part.second_order for part in problem.rows) else _TOLERANCE
    return embedding.solve(problem, tolerance[problem.rhs.dtype.name], runs)


class Decision(NamedTuple):
    """The margin of a formulation, decided by the outcome of its programs.

    directions, upper: (n_d, *lanes), the largest lambda of every direction and its certified bound; inf for zeros.
    status: (*lanes).
    has_margin: bool (*lanes).
    """

    directions: jax.Array
    upper: jax.Array
    status: jax.Array
    has_margin: jax.Array


def decide(grasps: Grasps, basics: Basics, scale: jax.Array, form: Formulation, out: ConicOutcome) -> Decision:
    """Decide from the outcome of its programs what the margin of a formulation is."""
    accepted = ACCEPTED[scale.dtype.name]
    value, bound = jnp.minimum(out.point.margin, out.upper), out.upper
    # Without contacts there is no program; no forces at all bear a load of zero, and no disturbance.
    empty = (grasps.present == 0).all(0)
    solved = ((out.error <= accepted) & ~out.infeasible) | empty
    # What is zero to the tolerance is zero; without a load exactly, by no forces at all.
    zero = jnp.where(_unloaded(grasps), 0, jnp.maximum(value, 0))
    value = jnp.where(empty, 0, jnp.where(solved & (jnp.abs(value) <= accepted), zero, value))
    bound = jnp.where(empty, 0, bound)
    hopeless = out.infeasible | (solved & (value < 0)) | (bound < -accepted)
    infeasible, unknown = _feasibility(basics, form, solved | hopeless, hopeless)

    def each_direction(values: jax.Array) -> jax.Array:
        values = values * scale
        values = jnp.broadcast_to(
            values[: 1 if values.shape[0] == 1 else basics.disturbed.shape[0]], basics.disturbed.shape
        )
        return jnp.where(basics.outside, 0, jnp.where(basics.disturbed, values, jnp.inf))

    status = jnp.select(
        [~grasps.valid, basics.load_outside | infeasible, unknown, ~basics.disturbed.any(0)],
        [Status.INVALID_INPUT, Status.INFEASIBLE, Status.MAX_ITERATIONS, Status.UNBOUNDED],
        Status.SOLVED,
    ).astype(jnp.int32)
    has_margin = (status == Status.SOLVED) | (status == Status.UNBOUNDED)
    return Decision(each_direction(value), each_direction(bound), status, has_margin)


def build_solution(
    grasps: Grasps, basics: Basics, scale: jax.Array, rows: list[ConeRows], form: Formulation, out: ConicOutcome
) -> FormulationSolution:
    """Build the solution of a formulation from the outcome of its programs, with these rows of a contact."""
    directions, upper, status, has_margin = decide(grasps, basics, scale, form, out)
    margin, worst = jnp.min(directions, 0), jnp.argmin(directions, 0)
    upper = jnp.maximum(jnp.min(upper, 0), margin)
    program = worst if scale.shape[0] > 1 else jnp.zeros_like(worst)
    forces, disturbed = _forces(basics, form, out.point.x, directions, margin, program)
    forceless = _unloaded(grasps) & (margin == 0)
    forces, disturbed = (jnp.where(forceless, 0, x * grasps.transmits) for x in (forces, disturbed))
    # The forces of every direction are on the way from f_0 to the most that the direction allows.
    attained, reached = disturbed, jnp.broadcast_to(margin, directions.shape)
    if form.free:
        attained, reached = jnp.moveaxis(out.point.x, 2, 0)[:-1] * basics.sizes * grasps.present, directions
    missed = has_margin & ~_balance(grasps, basics, forces, attained, reached)
    status, has_margin = jnp.where(missed, Status.MAX_ITERATIONS, status), has_margin & ~missed
    where_margin = lambda v: jnp.where(has_margin, v, jnp.nan)
    finite = has_margin & basics.disturbed.any(0) & ~basics.outside.any(0)
    direction, contact, row = _binding(basics, rows, form, out.point.z, program)
    where_finite = lambda v: jnp.where(finite, v, -1).astype(jnp.int32)
    return FormulationSolution(
        margin=where_margin(margin),
        upper_bound=where_margin(upper),
        directions=where_margin(directions),
        forces=where_margin(jnp.moveaxis(forces, 1, 0)),
        disturbed_forces=where_margin(jnp.moveaxis(disturbed, 2, 1)),
        status=status,
        direction=where_finite(direction),
        contact=where_finite(contact),
        row=where_finite(row),
        iterations=jnp.max(out.iterations, 0),
        primal_residual=where_margin(jnp.max(jnp.where(out.iterations > 0, out.residual, 0), 0)),
        gap=where_margin(jnp.where(finite, (upper - margin) / jnp.maximum(_pick(scale, program), margin), 0)),
    )


def _balance(grasps: Grasps, basics: Basics, rest: jax.Array, forces: jax.Array, reached: jax.Array) -> jax.Array:
    """Whether f_0 (k, n, *lanes) supplies b and forces (n_d, k, n, *lanes) supply b - lambda_j W_j, (*lanes).

    Directions without a lambda_j above 0 do not count.
    """
    counts = jnp.isfinite(reached) & (reached > 0)
    taken = jnp.moveaxis(jnp.where(counts, reached, 0) * basics.wrenches, 1, 0)
    required = jnp.concatenate([grasps.wrench - taken, grasps.wrench[None]])
    counts = jnp.concatenate([counts, jnp.ones_like(counts[:1])])
    supplying = jnp.concatenate([forces, rest[None]])
    supplied = jnp.einsum("eanl,danl->del", grasps.columns, supplying, precision="highest")
    sizes = jnp.sqrt((supplying * supplying).sum(1)).sum(1)
    # A disturbance that takes all of the load off leaves nothing but the rounding of their difference.
    taken = jnp.concatenate([jnp.abs(taken).max(1), jnp.abs(grasps.wrench).max(0)[None]])
    sizes = jnp.maximum(jnp.maximum(sizes, jnp.abs(required).max(1)), taken)
    right = jnp.abs(supplied - required).max(1) <= _MISSED[forces.dtype.name] * sizes
    return (right | ~counts).all(0)


def _unloaded(grasps: Grasps) -> jax.Array:
    """Whether no forces at all are admissible and bear b, (*lanes)."""
    unloaded = (grasps.wrench == 0).all(0)
    return unloaded if grasps.reserve is None else unloaded & grasps.reserves_nothing


def _feasibility(
    basics: Basics, form: Formulation, known: jax.Array, hopeless: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Whether there are no admissible forces, and whether that is unknown, (*lanes)."""
    if not form.free:
        return hopeless.any(0), ~known.all(0)
    counts, undisturbed = basics.disturbed & ~basics.outside, ~basics.disturbed.any(0)
    fails, all_known = hopeless[:-1] & counts, (known[:-1] | ~counts).all(0)
    no_f0, f0_known = hopeless[-1], known[-1]
    if form.one_f0:
        # With an f_0, each direction has forces for lambda = 0 at least.
        return no_f0, ~f0_known | ~no_f0 & (~all_known | fails.any(0))
    # Where a wrench is outside the range of G, or nothing disturbs, only whether there is an f_0 is left to decide.
    by_f0 = basics.outside.any(0) | undisturbed
    return fails.any(0) | by_f0 & no_f0, ~all_known | by_f0 & ~f0_known


def _forces(
    basics: Basics, form: Formulation, x: jax.Array, directions: jax.Array, margin: jax.Array, program: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """f_0 (k, n, *lanes) and f_0 + delta f_j at the margin (n_d, k, n, *lanes), N, of x (k, n, D, *lanes)."""
    each = jnp.moveaxis(x, 2, 0) * basics.sizes
    if form.free:
        # On the way from f_0 to what bears the most that this direction allows.
        positive = jnp.isfinite(directions) & (directions > 0)
        share = jnp.where(positive, margin / jnp.where(positive, directions, 1), 0)
        return each[-1], each[-1] + share[:, None, None] * (each[:-1] - each[-1])
    assert basics.blocking_forces is not None
    return _pick(each, program), each + jnp.where(jnp.isfinite(margin), margin, 0) * basics.blocking_forces


def _pick(values: jax.Array, program: jax.Array) -> jax.Array:
    """Pick the entry of one program, (..., *lanes), out of (D, ..., *lanes)."""
    index = program.reshape(*[1] * (values.ndim - 1), -1)
    return jnp.take_along_axis(values, jnp.broadcast_to(index, (1, *values.shape[1:-1], index.shape[-1])), 0)[0]


def _binding(
    basics: Basics, rows: list[ConeRows], form: Formulation, z: tuple[jax.Array, ...], program: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Find direction, contact and row of the largest multiplier of the program that binds; direction -1 for rest."""
    # (d, J, n, *lanes) each; the head of a second-order cone is the size of the whole.
    parts = [_pick(jnp.moveaxis(z_p, 3, 0), program) for z_p in z]
    parts = [z_p[:1] if part.second_order else z_p for part, z_p in zip(rows, parts, strict=True)]
    flat = jnp.concatenate(parts)
    _, copies, n, lanes = flat.shape
    where = jnp.argmax(flat.reshape(-1, lanes), 0)
    row, copy, contact = where // (copies * n), where // n % copies, where % n
    if form.free:
        return program, contact, row
    if copies > 1:
        # The last copy is rest.
        return jnp.where(copy == copies - 1, -1, copy), contact, row
    # The direction whose blocking forces load the row most.
    assert basics.blocking_forces is not None
    (pyramid,) = rows
    moved = basics.blocking_forces / basics.sizes
    moved = jnp.take_along_axis(moved, contact[None, None, None], 2)[:, :, 0]
    loads = pyramid.apply(jnp.moveaxis(moved, 0, 1)[:, :, None])[:, 0, :, 0]
    loads = jnp.take_along_axis(loads, row[None, None], 0)[0]
    worst = jnp.argmax(loads, 0) if form.one_f0 else program
    return jnp.where(_pick(loads, worst) > 0, worst, -1), contact, row
