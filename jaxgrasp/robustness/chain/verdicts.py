"""The chain's formulations, from the outcome of their programs to what is told about the grasps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgrasp.records import record
from jaxgrasp.robustness.chain.programs import Basics, Formulation, Scaled
from jaxgrasp.robustness.grasps import Grasps
from jaxgrasp.solvers.conic import embedding
from jaxgrasp.solvers.conic.embedding import ConicOutcome
from jaxgrasp.solvers.conic.margin import ConeRows, ConicMargin
from jaxgrasp.solvers.status import Status

_TOLERANCE = {"float64": 1e-9, "float32": 1e-5}
# On curved cones multipliers, and so derivatives, are off by the root of the gap.
_CURVED = {"float64": 1e-10, "float32": 1e-5}
# Residuals and gaps that did not close to the tolerance still count as solved below this; less than this is zero.
ACCEPTED = {"float64": 1e-7, "float32": 3e-4}
# How far forces may miss what they have to answer in the grasp's own rows, of their sum. The programs' rows are
# orthonormal: where those of G depend on each other nearly, small residuals of the one are large ones of the other.
_BALANCED = {"float64": 4e-8, "float32": 1.3e-5}


@record
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
    tolerance = _CURVED if any(part.second_order for part in problem.rows) else _TOLERANCE
    return embedding.solve(problem, tolerance[problem.rhs.dtype.name], runs)


class Verdict(NamedTuple):
    """What the outcome of its programs says about the margin of a formulation.

    directions, upper: (n_d, *lanes), the largest lambda of every direction and its certified bound; inf for zeros.
    status: (*lanes).
    answered: bool (*lanes), there is a margin.
    """

    directions: jax.Array
    upper: jax.Array
    status: jax.Array
    answered: jax.Array


def verdict(grasps: Grasps, shared: Basics, scale: jax.Array, form: Formulation, out: ConicOutcome) -> Verdict:
    """What the outcome of its programs says about the margin of a formulation."""
    accepted = ACCEPTED[scale.dtype.name]
    value, bound = jnp.minimum(out.point.margin, out.upper), out.upper
    solved = (out.error <= accepted) & ~out.infeasible
    # What is zero to the tolerance is zero; without a load exactly, by no forces at all.
    zero = jnp.where(_unloaded(grasps), 0, jnp.maximum(value, 0))
    value = jnp.where(solved & (jnp.abs(value) <= accepted), zero, value)
    hopeless = out.infeasible | (solved & (value < 0)) | (bound < -accepted)
    infeasible, unknown = _feasibility(shared, form, solved | hopeless, hopeless)

    def each_direction(values: jax.Array) -> jax.Array:
        values = values * scale
        own = jnp.broadcast_to(
            values[: 1 if values.shape[0] == 1 else shared.disturbed.shape[0]], shared.disturbed.shape
        )
        return jnp.where(shared.outside, 0, jnp.where(shared.disturbed, own, jnp.inf))

    status = jnp.select(
        [~grasps.valid, shared.load_outside | infeasible, unknown, ~shared.disturbed.any(0)],
        [Status.INVALID_INPUT, Status.INFEASIBLE, Status.MAX_ITERATIONS, Status.UNBOUNDED],
        Status.SOLVED,
    ).astype(jnp.int32)
    answered = (status == Status.SOLVED) | (status == Status.UNBOUNDED)
    return Verdict(each_direction(value), each_direction(bound), status, answered)


def formulation_answer(
    grasps: Grasps, shared: Basics, scale: jax.Array, rows: list[ConeRows], form: Formulation, out: ConicOutcome
) -> FormulationSolution:
    """The solution of a formulation from the outcome of its programs, with these rows of a contact."""
    directions, upper, status, answered = verdict(grasps, shared, scale, form, out)
    margin, worst = jnp.min(directions, 0), jnp.argmin(directions, 0)
    upper = jnp.maximum(jnp.min(upper, 0), margin)
    program = worst if scale.shape[0] > 1 else jnp.zeros_like(worst)
    forces, disturbed = _forces(shared, form, out.point.x, directions, margin, program)
    nothing = _unloaded(grasps) & (margin == 0)
    forces, disturbed = (jnp.where(nothing, 0, x * grasps.present) for x in (forces, disturbed))
    # What is told of every direction is on the way from f_0 to the most that it allows.
    attained, reached = disturbed, jnp.broadcast_to(margin, directions.shape)
    if form.free:
        attained, reached = jnp.moveaxis(out.point.x, 2, 0)[:-1] * shared.sizes * grasps.present, directions
    missed = answered & ~_balanced(grasps, shared, forces, attained, reached)
    status, answered = jnp.where(missed, Status.MAX_ITERATIONS, status), answered & ~missed
    hide = lambda v: jnp.where(answered, v, jnp.nan)
    finite = answered & shared.disturbed.any(0) & ~shared.outside.any(0)
    direction, contact, row = _binding(shared, rows, form, out.point.z, program)
    told = lambda v: jnp.where(finite, v, -1).astype(jnp.int32)
    return FormulationSolution(
        margin=hide(margin),
        upper_bound=hide(upper),
        directions=hide(directions),
        forces=hide(jnp.moveaxis(forces, 1, 0)),
        disturbed_forces=hide(jnp.moveaxis(disturbed, 2, 1)),
        status=status,
        direction=told(direction),
        contact=told(contact),
        row=told(row),
        iterations=jnp.max(out.iterations, 0),
        primal_residual=hide(jnp.max(jnp.where(out.iterations > 0, out.residual, 0), 0)),
        gap=hide(jnp.where(finite, (upper - margin) / jnp.maximum(_pick(scale, program), margin), 0)),
    )


def _balanced(grasps: Grasps, shared: Basics, rest: jax.Array, forces: jax.Array, reached: jax.Array) -> jax.Array:
    """Whether f_0 (3, n, *lanes) supplies b and forces (n_d, 3, n, *lanes) b - lambda_j W_j, (*lanes).

    Directions without a lambda_j above 0 are not looked at.
    """
    there = jnp.isfinite(reached) & (reached > 0)
    wanted = grasps.wrench - jnp.moveaxis(jnp.where(there, reached, 0) * shared.wrenches, 1, 0)
    wanted = jnp.concatenate([wanted, grasps.wrench[None]])
    there = jnp.concatenate([there, jnp.ones_like(there[:1])])
    supplying = jnp.concatenate([forces, rest[None]])
    supplied = jnp.einsum("eanl,danl->del", grasps.columns, supplying, precision="highest")
    sizes = jnp.sqrt((supplying * supplying).sum(1)).sum(1)
    sizes = jnp.maximum(sizes, jnp.abs(wanted).max(1))
    right = jnp.abs(supplied - wanted).max(1) <= _BALANCED[forces.dtype.name] * sizes
    return (right | ~there).all(0)


def _unloaded(grasps: Grasps) -> jax.Array:
    return (grasps.wrench == 0).all(0)


def _feasibility(
    shared: Basics, form: Formulation, known: jax.Array, hopeless: jax.Array
) -> tuple[jax.Array, jax.Array]:
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
    assert shared.answers is not None
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
    assert shared.answers is not None
    (pyramid,) = rows
    moved = shared.answers / shared.sizes
    moved = jnp.take_along_axis(moved, contact[None, None, None], 2)[:, :, 0]
    loads = pyramid.apply(jnp.moveaxis(moved, 0, 1)[:, :, None])[:, 0, :, 0]
    loads = jnp.take_along_axis(loads, row[None, None], 0)[0]
    worst = jnp.argmax(loads, 0) if form.shared else program
    return jnp.where(_pick(loads, worst) > 0, worst, -1), contact, row
