"""Members of a disturbance set that stand for all of it: corners of a box, the worst for rows, axes that span it."""

import itertools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxgrasp.arrays import literal
from jaxgrasp.compiling import compiled
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.contact.grasp_map import grasp_map
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.sets import furthest, support
from jaxgrasp.disturbance.terms import Ball, Box, Ellipsoid, Term
from jaxgrasp.disturbance.vertices import Vertices
from jaxgrasp.lanes.direct import power_of_two

_ROWS_AT_ONCE = 1 << 18


def polytope_of(disturbances: DisturbanceSet) -> DisturbanceSet | None:
    """The same set by vertices where it has few of them, as a box has its 64 corners; None for other sets.

    Corners come in the order of itertools.product((-1, 1), repeat=6), along the axes of the box.

    Raises:
        ValueError: a smoothed set.
    """
    if any(term.width is not None for term in disturbances.terms):
        raise ValueError("disturbances: got a smoothed set, wanted one that is not, since the chain has no smooth form")
    term, *others = disturbances.terms
    if others or not isinstance(term, Vertices | Box):
        return None
    if isinstance(term, Vertices):
        return disturbances
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=6)))
    corners = term.half_extents[..., None, :] * literal(signs, term.half_extents.dtype)
    if term.axes is not None:
        halves = corners.reshape(*corners.shape[:-1], 2, 3)
        turned = jnp.einsum("...ij,...dhj->...dhi", term.axes, halves)
        corners = turned.reshape(*turned.shape[:-2], 6)
    # A box that is none stays none: a negative extent would be the same corners.
    usable = (term.half_extents >= 0).all(-1)[..., None, None]
    return DisturbanceSet(terms=(Vertices(wrenches=jnp.where(usable, corners, jnp.nan)),))


@partial(compiled, static_argnums=(3,), pace=lambda *_: "soon")
def worst_of_rows(
    contacts: Contacts, disturbances: DisturbanceSet, inverse: jax.Array, cone_edges: int
) -> DisturbanceSet:
    """The members of a set that load the rows of (16) most, by vertices: its margin is that of the set itself.

    Args:
        contacts: the grasps.
        disturbances: the set D.
        inverse: G* (*batch, 3 n_c, 6).
        cone_edges: n_e.

    Returns:
        (*batch, n_c (n_e + 1) + 12) vertices: after those of the rows the ones that reach outside the range of G most.
    """
    inverse = jax.lax.stop_gradient(inverse)
    blocks = inverse.reshape(*inverse.shape[:-2], contacts.n_c, 3, 6)
    rows = literal(pyramid_facets(cone_edges), inverse.dtype)
    # Without friction the rows say that a finger does not pull, see `admit`.
    friction = jax.lax.stop_gradient(jnp.where(contacts.friction == 0, 1, contacts.friction))
    friction = jnp.broadcast_to(friction, blocks.shape[:-2])
    ends = jnp.ones_like(friction)[..., None]
    normals = jnp.concatenate([rows[:, 2] * friction[..., None], -ends], -1)
    tangents = jnp.concatenate([rows[:, :2], jnp.zeros_like(rows[:1, :2])])
    tangents = jnp.broadcast_to(tangents, (*normals.shape, 2))
    facets = jnp.concatenate([tangents, normals[..., None]], -1)
    loads = -jnp.einsum("...nkc,...nce->...nke", facets, blocks, precision="highest")
    loads = loads.reshape(*loads.shape[:-3], -1, 6)
    reached = jnp.einsum("...er,...rw->...ew", jax.lax.stop_gradient(grasp_map(contacts)), inverse, precision="highest")
    outside = jnp.eye(6, dtype=inverse.dtype) - reached
    directions = jnp.concatenate([loads, outside, -outside], -2)
    batch = jnp.broadcast_shapes(directions.shape[:-2], disturbances.batch_shape)
    directions = jnp.broadcast_to(directions, (*batch, *directions.shape[-2:]))
    lead = len(batch)
    to_last = lambda x: jnp.moveaxis(x, tuple(range(lead)), tuple(range(-lead, 0))) if lead else x
    terms = jax.tree.map(to_last, disturbances.spread_over(batch)).terms
    members = furthest(terms, jnp.moveaxis(to_last(directions), 1, 0))
    members = jnp.moveaxis(members, 0, 1)
    members = jnp.moveaxis(members, tuple(range(-lead, 0)), tuple(range(lead))) if lead else members
    usable = jnp.array(True)
    for term in disturbances.terms:
        usable &= (term.extent() >= 0).all(-1)
    return DisturbanceSet(terms=(Vertices(wrenches=jnp.where(usable[..., None, None], members, jnp.nan)),))


class SetOfLanes(NamedTuple):
    """The disturbance sets of lanes, on the host.

    terms: leaves (lanes, ...), or without the leading axis where all lanes share them.
    shared: parallel to the terms, a bool for each leaf.
    """

    terms: tuple[Term, ...]
    shared: tuple[Term, ...]

    def reach(self, directions: np.ndarray, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """h_D (T,) and the members that attain it (T, 6), for directions (T, 6), each for its own lane (T,)."""
        parts = [
            self._reach(directions[start : start + _ROWS_AT_ONCE], lanes[start : start + _ROWS_AT_ONCE])
            for start in range(0, len(directions), _ROWS_AT_ONCE)
        ]
        reach, members = zip(*parts, strict=True) if parts else ((np.zeros(0),), (np.zeros((0, 6)),))
        return np.concatenate(reach), np.concatenate(members)

    def _reach(self, directions: np.ndarray, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(directions)
        size = power_of_two(count, 256)
        padded, lane = np.zeros((size, 6)), np.zeros(size, int)
        padded[:count], lane[:count] = directions, lanes
        last = lambda x, shared: np.asarray(x)[..., None] if shared else np.moveaxis(np.asarray(x)[lane], 0, -1)
        terms = jax.tree.map(last, self.terms, self.shared)
        dtype = jax.tree.leaves(terms)[0].dtype
        reach, members = _reach(terms, padded.T.astype(dtype))
        return np.asarray(reach, float)[:count], np.asarray(members, float).T[:count]

    def axes(self, lane: int) -> tuple[np.ndarray, bool]:
        """Axes (6, d) that span the set of a lane, and whether they and their opposites are members of it.

        The ellipsoid {A u: |u| <= 1} of all terms' generators A is inside a sum of boxes, balls and ellipsoids. NaN
        where the set is not admissible.
        """
        own = lambda x, shared: np.asarray(x, float) if shared else np.asarray(x, float)[lane]
        terms = jax.tree.map(own, self.terms, self.shared)
        generators = np.concatenate([_generators(term) for term in terms], 1)
        if not np.isfinite(generators).all():
            return np.full((6, 1), np.nan), True
        # Forces and moments have units of their own: each is measured by its largest generator.
        size = np.repeat([np.abs(generators[:3]).max(), np.abs(generators[3:]).max()], 3)
        size[size == 0] = 1
        U, s, _ = np.linalg.svd(generators / size[:, None], full_matrices=False)
        kept = s > 1e-9 * s[0] if s[0] > 0 else np.zeros(len(s), bool)
        return size[:, None] * U[:, kept] * s[kept], not any(isinstance(term, Vertices) for term in terms)


def _generators(term: Term) -> np.ndarray:
    """(6, m), NaN where the term is not admissible."""
    if isinstance(term, Vertices):
        return np.asarray(term.wrenches).T
    if isinstance(term, Ellipsoid):
        return np.asarray(term.shape_matrix)
    if isinstance(term, Ball):
        radii = np.repeat([float(term.force), float(term.torque)], 3)
        return np.diag(np.where(radii >= 0, radii, np.nan))
    assert isinstance(term, Box)
    half = np.asarray(term.half_extents)
    axes = np.eye(3) if term.axes is None else np.asarray(term.axes)
    return np.kron(np.eye(2), axes) * np.where(half >= 0, half, np.nan)


def _reach_of(terms: tuple[Term, ...], directions: jax.Array) -> tuple[jax.Array, jax.Array]:
    return support(terms, directions), furthest(terms, directions)


_reach = compiled(_reach_of, pace=lambda *_: "soon")


def check_known(tree: object) -> None:
    """Refuse arrays that are not known yet, since refinement looks at numbers.

    Raises:
        ValueError: the call is traced.
    """
    if any(isinstance(x, Tracer) for x in (jnp.zeros(()), *jax.tree.leaves(tree))):
        raise ValueError(
            "disturbances: got a ball, an ellipsoid or a sum inside jit, vmap or grad, where its directions cannot be "
            "refined; call outside of them, or give DisturbanceSet.vertices or a box"
        )
