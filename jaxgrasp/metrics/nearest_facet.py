"""Ferrari and Canny's metric with a proof, for whole batches."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxgrasp.contact import Contacts
from jaxgrasp.metrics.columns import over_grasps
from jaxgrasp.metrics.interior import SMALLEST_BALL
from jaxgrasp.metrics.largest_ball import Norm, check_norm
from jaxgrasp.metrics.least_weight import CLOSED, least_weight
from jaxgrasp.metrics.polar_search import TOLERANCE, Search
from jaxgrasp.metrics.wrench_space import WrenchSpace, checked, edges_of
from jaxgrasp.records import record
from jaxgrasp.solvers.status import Status

# Grasps of a search; a search has some hundred boxes for each.
_BLOCK = 4096


@record
class NearestFacet:
    """The largest ball in grasp wrench spaces, and the facet that it touches."""

    radius: Float[Array, "*batch"]
    """The distance of the facet, so an upper bound of the ball's radius, see `ferrari_canny`."""
    lower_bound: Float[Array, "*batch"]
    """No facet is nearer than this: where SOLVED at most a share of 5e-8 (float32: 1e-4) below the radius."""
    normal: Float[Array, "*batch 6"]
    """The facet's outward normal of length 1, force and moment / length, object frame: the wrench that is hardest to
    exert. Zero without force closure."""
    status: Int[Array, "*batch"]
    """SOLVED, INVALID_INPUT, or MAX_ITERATIONS where the two bounds did not meet."""


def ferrari_canny(contacts: Contacts, norm: Norm = "L1", space: WrenchSpace | None = None) -> Float[Array, "*batch"]:
    """The radius of the largest ball about the origin in the grasp wrench space.

    Ferrari and Canny, "Planning optimal grasps" (ICRA 1992): the smallest wrench that the fingers cannot exert while
    their normal forces sum up to at most 1 (L1: the hull of all edge wrenches and the origin) or are each at most 1
    (Linf: the Minkowski sum of each finger's hull). The unit of moments and their reference are those of `space`.

    Args:
        contacts: the grasps.
        norm: "L1" or "Linf".
        space: conventions; `WrenchSpace()` where None.

    Returns:
        (*batch,), per unit of normal force, to 5e-8 of itself (float32: 1e-4), see `nearest_facet` for the proof;
        exactly 0 without force closure, or with less of it than a ball of 1e-7 (float32: 1e-3) of the longest wrench;
        NaN for data that are not admissible. Not differentiable, and not under `jax.jit`: `ferrari_canny_bound` is.

    Raises:
        ValueError: options or shapes that do not fit, or contacts that are being traced.
    """
    return nearest_facet(contacts, norm, space).radius


def nearest_facet(contacts: Contacts, norm: Norm = "L1", space: WrenchSpace | None = None) -> NearestFacet:
    """The facet of the grasp wrench space that is nearest to the origin, by branch and bound.

    Args:
        contacts: the grasps.
        norm: see `ferrari_canny`.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        The facets and the proof that none is nearer.

    Raises:
        ValueError: options or shapes that do not fit, or contacts that are being traced.

    Status:
        A bad grasp costs no other one anything.
    """
    norm, space = check_norm(norm), checked(contacts, space)
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((contacts, space))):
        raise ValueError(
            "contacts: got contacts that are being traced by jax.jit, vmap or grad, wanted arrays, since a search has "
            "as many programs as it needs; ferrari_canny_bound can be traced"
        )
    edges, found = jax.tree.map(np.asarray, (edges_of(contacts, space), over_grasps(least_weight, contacts, space)))
    batch, (n_c, n_e) = edges.valid.shape, edges.wrenches.shape[-3:-1]
    dtype = edges.wrenches.dtype
    groups = (1, n_c * n_e) if norm == "L1" else (n_c, n_e)
    known = edges.valid & (found.solved | ~found.spans)
    closed = known & found.spans & (1 - found.gauge > CLOSED[dtype.name])
    weights = found.excess + ((1 - found.gauge) / found.number)[..., None]
    some = np.flatnonzero(closed)
    take = lambda x, *event: x.reshape(math.prod(batch), *event)[some]
    wrenches, counted = take(edges.flat, n_c * n_e, 6), take(edges.counted, n_c * n_e)
    parts = [
        _search(wrenches[rows], counted[rows], take(weights, n_c * n_e)[rows], groups)
        for rows in (slice(start, start + _BLOCK) for start in range(0, len(some), _BLOCK))
    ]
    radius = np.where(edges.valid, np.where(known, 0, np.nan), np.nan).astype(dtype).ravel()
    lower, normal = radius.copy(), np.where(np.isnan(radius)[:, None], np.nan, np.zeros((len(radius), 6), dtype))
    if parts:
        radius[some], lower[some], normal[some] = (np.concatenate(x) for x in zip(*parts, strict=True))
    proved = (lower * (1 + TOLERANCE[dtype.name]) >= radius).reshape(batch)
    status = np.where(edges.valid, np.where(proved, Status.SOLVED, Status.MAX_ITERATIONS), Status.INVALID_INPUT)
    return NearestFacet(
        radius=jnp.asarray(radius.reshape(batch)),
        lower_bound=jnp.asarray(lower.reshape(batch)),
        normal=jnp.asarray(normal.reshape(*batch, 6)),
        status=jnp.asarray(status.astype(np.int32)),
    )


def _search(
    wrenches: np.ndarray, counted: np.ndarray, weights: np.ndarray, groups: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radii, their lower bounds and normals of grasps with force closure: wrenches (grasps, edges, 6).

    With the weights a_k > 0 that sum up to 1 and with which the wrenches cancel, every n of the polar has
    sum a_k (1 - w_k'n) = 1, no term of which is negative. So |w_k'n| is at most 1 / a_k, which bounds the polar.
    """
    dtype = wrenches.dtype
    longest = np.linalg.norm(wrenches, axis=-1).max(-1)
    points = wrenches.astype(np.float64) / longest[:, None, None]
    values, axes = np.linalg.eigh(np.swapaxes(points, -1, -2) @ points)
    points = points @ axes
    # A tenth more, for the rounding of the weights.
    most = np.where(counted, 1.1 / np.where(counted, weights, 1), 0)
    reach = np.einsum("nkj,nk->nj", np.abs(points), most) / values
    farthest = 1 / SMALLEST_BALL[dtype.name]
    search = Search(
        points=points.reshape(-1, *groups, 6).astype(dtype), counts=np.ascontiguousarray(counted.reshape(-1, *groups))
    )
    search.run(np.minimum(reach, farthest).astype(dtype))
    held = np.sqrt(search.best) < farthest
    radius, lower = (np.where(held, longest / np.sqrt(x), 0) for x in (search.best, search.bound))
    normal = np.einsum("nij,nj->ni", axes, search.farthest)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return radius, lower, np.where(held[:, None], normal, 0).astype(dtype)
