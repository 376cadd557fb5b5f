"""Force closure: the min-weight of the edges, and what proves that there is closure or none."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgrasp.arrays import safe_divide
from jaxgrasp.contact import Contacts
from jaxgrasp.metrics.columns import over_grasps
from jaxgrasp.metrics.least_weight import CLOSED, LeastWeight, least_weight, varying
from jaxgrasp.metrics.wrench_space import WrenchSpace, edges_of, metric
from jaxgrasp.records import record
from jaxgrasp.solvers.dense.gauge import Gauge
from jaxgrasp.solvers.status import Status


@record
class ForceClosure:
    """Whether grasps have force closure, with the certificate of either answer."""

    closed: Bool[Array, "*batch"]
    """True where every wrench can be exerted by large enough forces within the pyramids; False, too, for data that are
    not admissible."""
    internal_forces: Float[Array, "*batch contacts 3"]
    """Where closed: forces in contact frames, strictly inside every pyramid, whose wrenches cancel, normal forces
    summing up to 1 (or the lengths of the edges' shares, with `unit_edges`). NaN elsewhere."""
    separating_twist: Float[Array, "*batch 6"]
    """Where not closed: a twist (v, w) of the object about the reference, object frame, largest entry of (v, length w)
    1, against which no force within the pyramids does positive work: nothing resists it. NaN elsewhere."""
    min_weight: Float[Array, "*batch"]
    """See `min_weight`."""
    status: Int[Array, "*batch"]
    """SOLVED, INVALID_INPUT, or MAX_ITERATIONS where the program could not be solved and nothing is proved."""
    internal_moments: Float[Array, "*batch contacts"] | None = None
    """The moments about the normals that come with `internal_forces`, N m; None for hard contacts."""


@metric
def min_weight(contacts: Contacts, space: WrenchSpace | None = None) -> Float[Array, "*batch"]:
    """The largest least weight with which the edge wrenches average to zero.

    Li, Culbertson and Ames, "FRoGGeR: Fast robust grasp generation via the min-weight metric" (IROS 2023):

        max l   over (alpha, l)   such that   sum alpha_k w_k = 0,   sum alpha_k = 1,   alpha_k >= l.

    Positive exactly where there is force closure, and then at most one over the number of edges. Edges that do not span
    the space of wrenches may cancel with positive weights, too (those of two opposite contacts do): that is no closure,
    and the answer is 0. It does not depend on the unit of moments or the reference, but on `unit_edges`.

    Args:
        contacts: the grasps.
        space: conventions; `WrenchSpace()` where None. FRoGGeR has four edges of unit norm.

    Returns:
        (*batch,), exactly 0 on the boundary of closure, negative beyond it, -inf where no weights of any sign that sum
        up to 1 cancel; NaN for data that are not admissible or, where the edges span the space, a program that could
        not be solved. Differentiable where finite and not 0; elsewhere gradients are zero.

    Raises:
        ValueError: options or shapes that do not fit.
    """
    edges, found = edges_of(contacts, space), over_grasps(least_weight, contacts, space)
    return _told(found, varying(edges, found))


@metric
def force_closure(contacts: Contacts, space: WrenchSpace | None = None) -> ForceClosure:
    """Tests for force closure with friction pyramids, and proves the answer.

    A grasp has force closure where its edge wrenches span the space and cancel with positive weights (Murray, Li and
    Sastry, "A mathematical introduction to robotic manipulation", 1994, section 5.4). The pyramids are inscribed: a
    grasp that only just closes with Coulomb's cones may need more edges.

    Args:
        contacts: the grasps.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        The answers and their certificates.

    Raises:
        ValueError: options or shapes that do not fit.

    Status:
        A bad grasp costs no other one anything.
    """
    edges, found = edges_of(contacts, space), over_grasps(least_weight, contacts, space)
    gauge = varying(edges, found)
    least = 1 - gauge.value
    # Edges that do not span the space close nothing, whether or not the program could be solved.
    known = found.valid & (found.solved | ~found.spans)
    closed = known & found.spans & (least > CLOSED[least.dtype.name])
    weights = jnp.where(edges.counted & closed[..., None], gauge.z + (least / found.number)[..., None], 0)
    weights = safe_divide(weights, weights.sum(-1, keepdims=True)).reshape(edges.wrenches.shape[:-1])
    forces = jnp.einsum("...ce,...cea->...ca", weights, edges.forces)
    moments = None
    if contacts.torsional_arms is not None:
        moments = forces[..., 3] * jnp.where(edges.present, contacts.torsional_arms, 0)
        moments = jnp.where(closed[..., None], moments, jnp.nan)
    # A twist along which every edge does negative work; where they do not span the space, one along which they do none.
    twist = jnp.where(found.spans[..., None], gauge.y, found.idle)
    twist = safe_divide(twist, jnp.max(jnp.abs(twist), -1, keepdims=True))
    turned = jnp.concatenate([twist[..., :3], twist[..., 3:] / edges.length[..., None]], -1)
    status = jnp.where(known, int(Status.SOLVED), int(Status.MAX_ITERATIONS))
    return ForceClosure(
        closed=closed,
        internal_forces=jnp.where(closed[..., None, None], forces[..., :3], jnp.nan),
        separating_twist=jnp.where((known & ~closed)[..., None], turned, jnp.nan),
        min_weight=_told(found, gauge),
        status=jnp.where(found.valid, status, int(Status.INVALID_INPUT)),
        internal_moments=moments,
    )


def _told(found: LeastWeight, gauge: Gauge) -> jax.Array:
    """The least weight; 0 where it is not told from 0, or where edges that do not span the space have none below 0."""
    least = jnp.where(found.solved, 1 - gauge.value, jnp.nan)
    zero = (jnp.abs(least) <= CLOSED[least.dtype.name]) | (~found.spans & ~(least < 0))
    return jnp.where(found.valid, jnp.where(zero, 0, least) / found.number, jnp.nan)
