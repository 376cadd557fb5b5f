"""How much of a task the grasp wrench space holds."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgrasp.arrays import broadcast_batch, safe_norm
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.metrics.wrench_space import WrenchSpace, checked, edges_of
from jaxgrasp.robustness.chain.members import polytope_of
from jaxgrasp.solvers import solve_qp
from jaxgrasp.solvers.status import Status

_ROUNDING = {"float64": 1e-8, "float32": 1e-4}


def task_wrench(contacts: Contacts, task: DisturbanceSet, space: WrenchSpace | None = None) -> Float[Array, "*batch"]:
    """The largest factor by which a set of task wrenches may be scaled and still lies in the grasp wrench space.

    Borst, Fischer and Hirzinger, "Grasp planning: how to choose a suitable task wrench space" (ICRA 2004); Haschke,
    Steil, Steuwer and Ritter, "Task-oriented quality measures for dextrous grasping" (CIRA 2005). The fingers' normal
    forces sum up to at most 1 (L1), so the factor is per newton of them. A linear program with seven unknowns for every
    vertex W_j, whose smallest value counts:

        min nu   over (y, nu)   such that   w_k'y <= nu,   nu >= 0,   W_j'y = 1.

    It does not depend on the unit of moments, nor on the reference, since the wrenches of the task move along with it.

    Args:
        contacts: the grasps.
        task: wrenches by vertices, or a box, about the centre of mass; zero wrenches do not count.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        (*batch,), exactly 0 where some wrench cannot be exerted, inf without any; NaN for data that are not admissible
        or a program that could not be solved. Differentiable.

    Raises:
        ValueError: a set that is not given by vertices, options or shapes that do not fit.
    """
    space = checked(contacts, space)
    polytope = polytope_of(task)
    if polytope is None:
        raise ValueError(
            "task: got a set without vertices, wanted DisturbanceSet.vertices, forces or a box "
            "(--disturbances forces, box or a FILE)"
        )
    return _scaled(contacts, wrenches_of(polytope.terms), space)


@compiled
def _scaled(contacts: Contacts, vertices: jax.Array, space: WrenchSpace) -> jax.Array:
    """The least of what the vertices, one by one, may be scaled by."""
    edges = edges_of(contacts, space)
    W, dtype = edges.flat, edges.wrenches.dtype
    vertices = vertices.astype(dtype)
    batch = broadcast_batch(contacts=edges.valid.shape, task=vertices.shape[:-2])
    force, moment = vertices[..., :3], vertices[..., 3:]
    if space.reference is not None:
        moment = moment - jnp.cross(jnp.asarray(space.reference, dtype)[..., None, :], force)
    length = edges.length[..., None, None]
    size = (*batch, vertices.shape[-2], 3)
    scaled = jnp.concatenate([jnp.broadcast_to(force, size), jnp.broadcast_to(moment / length, size)], -1)
    valid = jnp.broadcast_to(edges.valid, batch) & jnp.isfinite(scaled).all((-2, -1))
    counted = jnp.any(scaled != 0, -1) & valid[..., None]
    wanted = jnp.where(counted[..., None], scaled, jnp.eye(1, 6, dtype=dtype)[0])
    rows = jnp.concatenate([W, -jnp.ones_like(W[..., :1])], -1)
    rows = jnp.concatenate([rows, -jnp.eye(1, 7, k=6, dtype=dtype) + jnp.zeros_like(rows[..., :1, :])], -2)
    equality = jnp.concatenate([wanted, jnp.zeros_like(wanted[..., :1])], -1)[..., None, :]
    found = solve_qp(
        None,
        jnp.zeros(7, dtype).at[6].set(1),
        equality,
        jnp.ones(1, dtype),
        rows[..., None, :, :],
        jnp.zeros(rows.shape[-2], dtype),
    )
    each = jnp.where(found.status == Status.SOLVED, jnp.where(counted, found.objective, 0), jnp.nan)
    # The solver tells a wrench from zero to this share of the longest one that the fingers can exert.
    longest = jnp.max(safe_norm(W), -1, initial=0)[..., None]
    each = jnp.where((each * safe_norm(wanted) <= _ROUNDING[dtype.name] * longest) | (longest == 0), 0, each)
    value = jnp.min(jnp.where(counted, each, jnp.inf), -1)
    return jnp.where(valid, value, jnp.nan)
