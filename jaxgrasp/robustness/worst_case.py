"""The worst that a disturbance set does to each row: S_1 (17) and S_2 (18), through support functions.

While the disturbance w acts, the grasp answers with the blocking forces -G* w. So facet row k of contact i loses at
most h_D(-(C G*)_ik) and the bound on its normal force at most h_D((E G*)_i): S_1 = -h_D(-(C G*)), S_2 = h_D(E G*),
whatever kind of set D is.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold, literal, safe_divide
from jaxgrasp.contact.compliance import Compliance, pseudo_inverse, pseudo_inverse_adjoint
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.contact.row_space import Basis
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.sets import furthest, support
from jaxgrasp.disturbance.terms import Term
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.lanes.differentiable import OfPyramids, Plain
from jaxgrasp.lanes.fence import each, fenced
from jaxgrasp.robustness.actuators import effort_reach
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.interface.arguments import GraspData


def worst_case(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    compliance: Array | Compliance | None = None,
    cone_edges: int = 8,
) -> tuple[Float[Array, "*batch contacts edges"], Float[Array, "*batch contacts"]]:
    """S_1 (17) and S_2 (18): what the worst unit disturbance takes from every row of C f <= -d and -E f <= f_max.

    Args:
        contacts: the grasps.
        disturbances: the set D, object frame.
        compliance: Q, see `largest_disturbance`.
        cone_edges: n_e.

    Returns:
        S_1 <= 0 (*batch, n_c, n_e), N, and S_2 >= 0 (*batch, n_c), N; zero for absent contacts, NaN where the data are
        not admissible.

    Raises:
        ValueError: shapes or options that do not fit.
    """
    pyramid_facets(cone_edges)
    data = GraspData.from_arguments(contacts, disturbances, compliance=compliance)
    return over_grasps(_WorstCase(cone_edges), data)


class _WorstCase(OfPyramids, Plain):
    def evaluate(self, grasps: Grasps) -> tuple[jax.Array, jax.Array]:
        cone, bound, *_ = worst_rows(grasps, self.cone_edges)
        hide = lambda x: jnp.where(grasps.valid, x, jnp.nan)
        return hide(jnp.moveaxis(-cone, 0, 1)), hide(bound)


def worst_rows(grasps: Grasps, cone_edges: int) -> tuple[jax.Array, jax.Array, jax.Array | None, Basis]:
    """-S_1 (n_e, n, *lanes), S_2 (n, *lanes), the same of efforts (2, n_u, *lanes), and a basis of the rows.

    None for efforts without actuators; the basis is that of the rows of G, and of N'J'.
    """
    inverse, basis = pseudo_inverse(grasps.rows, grasps.half)
    efforts = None
    if grasps.vertex_halves is None:
        reach = fenced(support)(grasps.terms, _directions(inverse, grasps.friction, grasps.units, cone_edges))
        if grasps.actuated is not None:
            efforts = fenced(support)(grasps.terms, effort_reach(grasps.actuated, inverse[:, :6], grasps.units))
    else:

        def worse(reach: tuple, vertex: tuple) -> tuple[tuple, None]:
            half, wrench = vertex
            inverse = pseudo_inverse(grasps.rows, half)[0]
            rows = [_directions(inverse, grasps.friction, grasps.units, cone_edges)]
            if grasps.actuated is not None:
                rows.append(effort_reach(grasps.actuated, inverse[:, :6], grasps.units))
            pulls = [fold(jnp.add, row * wrench[:, None, None]) for row in rows]
            return tuple(jnp.maximum(r, p) for r, p in zip(reach, pulls, strict=True)), None

        lanes = grasps.length.shape
        shapes = [(cone_edges + 1, *grasps.present.shape)]
        if grasps.actuated is not None:
            shapes.append((2, grasps.actuated.transmission.shape[1], *lanes))
        none = tuple(jnp.zeros(shape, grasps.present.dtype) for shape in shapes)
        (reach, *rest), _ = lax.scan(worse, none, (grasps.vertex_halves, wrenches_of(grasps.terms)))
        efforts = rest[0] if rest else None
    reach = jnp.where(grasps.present > 0, reach, 0)
    return reach[:-1], reach[-1], efforts, basis


def _directions(inverse: jax.Array, friction: jax.Array, units: jax.Array, cone_edges: int) -> jax.Array:
    """Wrenches -(C G*) of all facet rows, then E G*: (6, n_e + 1, n, *lanes) from G* (3, 6 or more, n, *lanes)."""

    @fenced
    def spread(inverse: jax.Array, friction: jax.Array, units: jax.Array) -> jax.Array:
        c, s, k = literal(-pyramid_facets(cone_edges).T, inverse.dtype)[..., None, None]

        def component(each_wrench: tuple) -> jax.Array:
            inverse, unit = each_wrench
            cone = c * inverse[0] + s * inverse[1] + (k * friction) * inverse[2]
            return jnp.concatenate([cone, inverse[2:]]) * unit

        return each(component, (jnp.moveaxis(inverse[:, :6], 1, 0), units))

    return spread(inverse, friction, units)


def reach_adjoint(
    grasps: Grasps, cone: jax.Array, bound: jax.Array, cone_edges: int, with_terms: bool
) -> tuple[jax.Array, jax.Array, jax.Array | None, tuple[Term, ...] | None]:
    """The transpose of the derivative of -S_1 and S_2.

    Of a row a'G* that the worst wrench w of the set turns into h_D, da'w is left: the gradient with respect to G* is
    a sum of w a' over the rows.

    Args:
        grasps: the grasps.
        cone: (n_e, n, *lanes), cotangents of -S_1.
        bound: (n, *lanes), of S_2.
        cone_edges: n_e.
        with_terms: whether those of the disturbance set are wanted.

    Returns:
        Cotangents of the columns of G, friction, the roots of compliance (None for Q = I) and of the terms (None where
        not wanted).
    """
    weights = jnp.where(grasps.present > 0, jnp.concatenate([cone, bound[None]]), 0)
    if grasps.vertex_halves is not None or with_terms:
        # Rare, and nothing to save: by JAX's own hand.
        data = (grasps.columns, grasps.friction, grasps.half, grasps.vertex_halves, grasps.terms)

        def reach(columns: jax.Array, friction: jax.Array, half: Any, vertex_halves: Any, terms: Any) -> tuple:
            changed = replace(
                grasps, columns=columns, friction=friction, half=half, vertex_halves=vertex_halves, terms=terms
            )
            return worst_rows(changed, cone_edges)[:2]

        columns, friction, half, vertex_halves, terms = jax.vjp(reach, *data)[1]((weights[:-1], weights[-1]))
        return columns, friction, half if vertex_halves is None else vertex_halves, terms

    inverse, _ = pseudo_inverse(grasps.columns, grasps.half)
    worst = fenced(furthest)(grasps.terms, _directions(inverse, grasps.friction, grasps.units, cone_edges))

    @fenced
    def gather(worst: jax.Array, weights: jax.Array, friction: jax.Array, units: jax.Array) -> tuple:
        c, s, k = literal(pyramid_facets(cone_edges).T, weights.dtype)[..., None, None]

        def component(each_wrench: tuple) -> tuple:
            worst, unit = each_wrench
            pulled = worst * weights * unit
            cone = pulled[:-1]
            along_normal = fold(jnp.add, cone * k)
            normal = pulled[-1] - friction * along_normal
            return jnp.stack([-fold(jnp.add, cone * c), -fold(jnp.add, cone * s), normal]), along_normal

        return each(component, (worst, units))

    # (6, 3, n, *lanes), of the blocks of G*, and what comes with friction.
    pulled, along_normal = gather(worst, weights, grasps.friction, grasps.units)
    friction = -fold(jnp.add, along_normal * inverse[2])
    columns, half = pseudo_inverse_adjoint(grasps.columns, grasps.half, pulled)
    return columns, friction, half, None


def reach_outside(grasps: Grasps, basis: Basis) -> jax.Array:
    """How far the disturbance set reaches outside the range of G, as a share of its size, (*lanes).

    Args:
        grasps: the grasps and the set.
        basis: of the rows of G.
    """
    lanes, length = grasps.length.shape, grasps.length

    def measure() -> jax.Array:
        size = sum(fold(jnp.maximum, extent * grasps.units) for extent in grasps.extents)
        dropped = jnp.where(basis.kept[:, None] > 0, 0, basis.operations[:, :6])
        outside = jnp.moveaxis(dropped, 0, 1) * grasps.units[:, None]
        # The set itself: what smoothing adds would be outside, too, even for directions that are zero.
        terms = tuple(replace(term, width=None) for term in grasps.terms)
        reach = support(terms, jnp.concatenate([outside, -outside], 1))
        return safe_divide(fold(jnp.maximum, reach), jnp.broadcast_to(size, lanes))

    return lax.cond(jnp.all(basis.kept > 0), lambda: jnp.zeros(lanes, length.dtype), measure)
