"""How much of a task the grasp wrench space holds."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgrasp.arrays import broadcast_batch, safe_norm
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.metrics.columns import over_grasps
from jaxgrasp.metrics.least_weight import CLOSED, least_weight
from jaxgrasp.metrics.task_gauge import MISSED, task_gauge
from jaxgrasp.metrics.wrench_space import Edges, WrenchSpace, checked, edges_of
from jaxgrasp.robustness.chain.members import polytope_of
from jaxgrasp.solvers.dense.gauge import Gauge, gauge_of


def task_wrench(contacts: Contacts, task: DisturbanceSet, space: WrenchSpace | None = None) -> Float[Array, "*batch"]:
    """The largest factor by which a set of task wrenches may be scaled and still lies in the grasp wrench space.

    Borst, Fischer and Hirzinger, "Grasp planning: how to choose a suitable task wrench space" (ICRA 2004); Haschke,
    Steil, Steuwer and Ritter, "Task-oriented quality measures for dextrous grasping" (CIRA 2005). The fingers' normal
    forces sum up to at most 1 (L1), so the factor is per newton of them. For every vertex W_j, of which the smallest
    value counts:

        max s   over (z, s)   such that   sum z_k w_k = s W_j,   sum z_k <= 1,   z_k >= 0.

    It does not depend on the unit of moments, nor on the reference, since the wrenches of the task move along with it.

    Args:
        contacts: the grasps.
        task: wrenches by vertices, or a box, about the centre of mass; zero wrenches do not count.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        (*batch,), to 1e-7 of itself (float32: 1e-4), exactly 0 where all but a share of 1e-8 (float32: 1e-4) of some
        wrench cannot be exerted, inf without any wrench; NaN for data that are not admissible or a program whose two
        bounds did not meet. Differentiable.

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
    dtype = edges.wrenches.dtype
    vertices = vertices.astype(dtype)
    batch = broadcast_batch(contacts=edges.valid.shape, task=vertices.shape[:-2])
    force, moment = vertices[..., :3], vertices[..., 3:]
    if space.reference is not None:
        moment = moment - jnp.cross(jnp.asarray(space.reference, dtype)[..., None, :], force)
    size = (*batch, vertices.shape[-2], 3)
    moment = jnp.broadcast_to(moment, size) / edges.length[..., None, None]
    wanted = jnp.concatenate([jnp.broadcast_to(force, size), moment], -1)
    valid = edges.valid & jnp.isfinite(wanted).all((-2, -1))
    size = safe_norm(jnp.where(valid[..., None, None], wanted, 0))
    wanted = jnp.where((size > 0)[..., None], wanted, 0)
    gauge = _gauges(contacts, space, edges, wanted)
    # A wrench is told from zero to this share of the longest one that the fingers can exert.
    longest = jnp.max(safe_norm(edges.flat), -1, initial=0)[..., None]
    exerted = size >= MISSED[dtype.name] * longest * gauge
    factor = jnp.where(exerted, 1 / jnp.where(exerted & (gauge > 0), gauge, 1), 0)
    factor = jnp.where(size > 0, jnp.where(jnp.isnan(gauge), jnp.nan, factor), jnp.inf)
    least = jnp.min(jnp.where(jnp.isnan(factor), jnp.inf, factor), -1, initial=jnp.inf)
    known = valid & (~jnp.isnan(factor).any(-1) | (least == 0))
    return jnp.where(known, least, jnp.nan)


def _gauges(contacts: Contacts, space: WrenchSpace, edges: Edges, wanted: jax.Array) -> jax.Array:
    """The gauges (*batch, vertices) of wrenches (*batch, vertices, 6); inf where not to be exerted, NaN if unsolved."""
    dtype = wanted.dtype
    closure = over_grasps(least_weight, contacts, space)
    cancels = closure.solved & (1 - closure.gauge > CLOSED[dtype.name])
    weights = closure.number[..., None] * closure.excess + (1 - closure.gauge)[..., None]
    balance = jnp.where(cancels[..., None] & edges.counted, weights, 0)
    # Most wrenches that cannot be exerted do work on a twist that no edge resists.
    beyond = jnp.zeros(wanted.shape[:-1], bool)
    for twist in (closure.twist, closure.idle, -closure.idle):
        work = jnp.where(edges.counted, jnp.sum(edges.flat * twist[..., None, :], -1), 0)
        resisted, task = jnp.max(work, -1, initial=0)[..., None], jnp.sum(wanted * twist[..., None, :], -1)
        # Less work than that is rounding.
        least = MISSED[dtype.name] * safe_norm(wanted) * safe_norm(twist)[..., None]
        beyond |= (task > least) & (resisted <= MISSED[dtype.name] * task)
    asked = jnp.where(beyond[..., None], 0, wanted)
    found = over_grasps(task_gauge, *_by_vertex(contacts, space), asked, balance[..., None, :])
    usable = found.solved & ~beyond & jnp.isfinite(found.gauge)
    flat = jnp.broadcast_to(edges.flat[..., None, :, :], (*usable.shape, *edges.flat.shape[-2:]))
    value = gauge_of(flat, wanted, Gauge(found.gauge, found.twist, found.shares), usable).value
    return jnp.where(beyond, jnp.inf, jnp.where(found.solved, value, jnp.nan))


def _by_vertex(contacts: Contacts, space: WrenchSpace) -> tuple[Contacts, WrenchSpace]:
    """Both with an axis for vertices after those of the batch."""
    own = len(contacts.batch_shape)
    length, reference = space.length, space.reference
    return jax.tree.map(lambda x: jnp.expand_dims(x, own), contacts), replace(
        space,
        length=None if length is None else jnp.asarray(length)[..., None],
        reference=None if reference is None else jnp.asarray(reference)[..., None, :],
    )
