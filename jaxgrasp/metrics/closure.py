"""Force closure: the min-weight of the edges, and what proves that there is closure or none."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgrasp import linalg
from jaxgrasp.arrays import safe_divide
from jaxgrasp.contact import Contacts
from jaxgrasp.contact.row_space import RANK_TOLERANCE
from jaxgrasp.metrics.wrench_space import Edges, WrenchSpace, edges_of, hidden, metric
from jaxgrasp.records import record
from jaxgrasp.solvers import QPSolution, solve_qp
from jaxgrasp.solvers.status import Status

# The solver's own accuracy, of weights that sum up to one times their number.
_LEAST_WEIGHT = {"float64": 1e-7, "float32": 1e-4}


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
    and the answer is 0. It does not depend on the unit of moments or the reference, but on `unit_edges`. What is solved
    is the dual, with seven unknowns.

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
    edges = edges_of(contacts, space)
    return _above_rounding(edges, _weight(edges, _dual(edges)), _spans(_decomposed(edges)[0]))


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
    edges = edges_of(contacts, space)
    dual = _dual(edges)
    least = _weight(edges, dual)
    dtype = edges.wrenches.dtype
    singular, directions = _decomposed(edges)
    spans = _spans(singular)
    positive = least * _count(edges) > _LEAST_WEIGHT[dtype.name]
    # Edges that do not span the space close nothing, whether or not the program could be solved.
    known = edges.valid & ((dual.status != Status.MAX_ITERATIONS) | ~spans)
    closed = known & spans & positive
    # The multipliers are what the weights exceed the least one by.
    weights = jnp.where(edges.counted & closed[..., None], dual.z + least[..., None], 0)
    weights = safe_divide(weights, weights.sum(-1, keepdims=True)).reshape(edges.wrenches.shape[:-1])
    forces = jnp.einsum("...ce,...cea->...ca", weights, edges.forces)
    moments = None
    if contacts.torsional_arms is not None:
        moments = forces[..., 3] * jnp.where(edges.present, contacts.torsional_arms, 0)
        moments = jnp.where(closed[..., None], moments, jnp.nan)
    # A twist along which every edge does negative work; where they do not span the space, one along which they do none.
    twist = jnp.where(~spans[..., None], directions[..., -1], dual.x[..., :6])
    twist = safe_divide(twist, jnp.max(jnp.abs(twist), -1, keepdims=True))
    turned = jnp.concatenate([twist[..., :3], twist[..., 3:] / edges.length[..., None]], -1)
    status = jnp.where(known, int(Status.SOLVED), int(Status.MAX_ITERATIONS))
    return ForceClosure(
        closed=closed,
        internal_forces=jnp.where(closed[..., None, None], forces[..., :3], jnp.nan),
        separating_twist=jnp.where((known & ~closed)[..., None], turned, jnp.nan),
        min_weight=_above_rounding(edges, least, spans),
        status=jnp.where(edges.valid, status, int(Status.INVALID_INPUT)),
        internal_moments=moments,
    )


def _dual(edges: Edges) -> QPSolution:
    """Min nu over (y, nu) with w_k'y <= nu, nu - y'mean w = 1: nu is the number of edges times the min-weight."""
    counted, W = edges.counted, edges.flat
    rows = jnp.concatenate([W, -counted[..., None].astype(W.dtype)], -1)
    mean = W.sum(-2) / _count(edges)[..., None]
    # Without any contact the row is zero, and the program infeasible.
    equality = jnp.concatenate([-mean, counted.any(-1)[..., None].astype(W.dtype)], -1)
    cost = jnp.zeros(7, W.dtype).at[6].set(1)
    sides = jnp.where(counted, 0, 1).astype(W.dtype)
    return solve_qp(None, cost, equality[..., None, :], jnp.ones(1, W.dtype), rows, sides)


def _weight(edges: Edges, dual: QPSolution) -> jax.Array:
    none = (dual.status == Status.UNBOUNDED) | (dual.status == Status.INFEASIBLE)
    solved = dual.status == Status.SOLVED
    value = jnp.where(solved, dual.objective, 0) / _count(edges)
    return hidden(edges, jnp.where(none, -jnp.inf, jnp.where(solved, value, jnp.nan)))


def _decomposed(edges: Edges) -> tuple[jax.Array, jax.Array]:
    """The six singular values of the wrenches, and the directions of wrenches that belong to them."""
    # Derivatives do not go through them: whether edges span the space does not change by little.
    return linalg.right_singular(edges.flat)


def _spans(singular: jax.Array) -> jax.Array:
    """Whether the wrenches span the space."""
    return singular[..., 5] > RANK_TOLERANCE[singular.dtype.name] * singular[..., 0]


def _above_rounding(edges: Edges, least: jax.Array, spans: jax.Array) -> jax.Array:
    """The least weight, and 0 where it is not told from 0, or where edges that span no space have none below 0."""
    tolerance = _LEAST_WEIGHT[least.dtype.name] / _count(edges)
    flat = ~spans & ((least > 0) | (edges.valid & jnp.isnan(least)))
    return jnp.where((jnp.abs(least) <= tolerance) | flat, 0, least)


def _count(edges: Edges) -> jax.Array:
    """How many edges there are, at least 1."""
    return jnp.maximum(edges.counted.sum(-1, dtype=edges.wrenches.dtype), 1)
