"""The worst that a disturbance set does to each row: S_1 (17) and S_2 (18), through support functions.

While the disturbance w acts, the grasp answers with the blocking forces -G* w. So facet row k of contact i loses at
most h_D(-(C G*)_ik) and the bound on its normal force at most h_D((E G*)_i): S_1 = -h_D(-(C G*)), S_2 = h_D(E G*),
whatever kind of set D is.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold, literal, safe_divide
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.compliance import Compliance, pseudo_inverse, pseudo_inverse_adjoint
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import contact_facets, pyramid_facets
from jaxgrasp.contact.row_space import Basis
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.sets import furthest, support
from jaxgrasp.disturbance.terms import Term
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.lanes.differentiable import OfPyramids, Plain
from jaxgrasp.lanes.fence import each, fenced, in_turn
from jaxgrasp.robustness.actuators import actuator_reach
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.interface.arguments import GraspData


def worst_case(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    compliance: Array | Compliance | None = None,
    cone_edges: int = 8,
    actuation: Actuation | None = None,
) -> tuple[Float[Array, "*batch contacts edges"], Float[Array, "*batch contacts"]]:
    """S_1 (17) and S_2 (18): what the worst unit disturbance takes from every row of C f <= -d and -E f <= f_max.

    The rows of (19) are then C f_0 - S_1 lambda <= -d, which the paper prints with + for -, and
    -E f_0 + S_2 lambda <= f_max. Without friction a contact's rows of C are cos(pi / n_e) f_n <= -d.

    Args:
        contacts: the grasps.
        disturbances: the set D, object frame.
        compliance: Q, see `largest_disturbance`.
        cone_edges: n_e.
        actuation: what the hand can do: G* leaves joint directions that no actuator reaches without torque.

    Returns:
        S_1 <= 0 (*batch, n_c, n_e), 2 n_e of soft contacts, N, and S_2 >= 0 (*batch, n_c), N; zero for absent contacts,
        NaN where the data are not admissible.

    Raises:
        ValueError: shapes or options that do not fit.
    """
    pyramid_facets(cone_edges)
    data = GraspData.from_arguments(contacts, disturbances, compliance=compliance, actuation=actuation)
    return over_grasps(_WorstCase(cone_edges), data)


class _WorstCase(OfPyramids, Plain):
    def evaluate(self, grasps: Grasps) -> tuple[jax.Array, jax.Array]:
        losses = worst_rows(grasps, self.cone_edges)
        where_valid = lambda x: jnp.where(grasps.valid, x, jnp.nan)
        return where_valid(jnp.moveaxis(-losses.cone, 0, 1)), where_valid(losses.bound)


class RowLosses(NamedTuple):
    """The amount that the worst unit disturbance takes from every row.

    cone: (n_e, n, *lanes), -S_1, N; 2 n_e of soft contacts.
    bound: (n, *lanes), S_2, N.
    actuators: (2, n_u, *lanes), of u <= u_max and -u <= -u_min; None without actuators.
    basis: of the rows of G, and of N'J'.
    """

    cone: jax.Array
    bound: jax.Array
    actuators: jax.Array | None
    basis: Basis


def worst_rows(grasps: Grasps, cone_edges: int) -> RowLosses:
    """Find what the worst unit disturbance takes from every row."""
    inverse, basis = pseudo_inverse(grasps.rows, grasps.inverse_root)
    actuators = None
    if grasps.vertex_inverse_roots is None:
        if grasps.actuated is None:
            reach = fenced(support)(grasps.terms, _directions(inverse, grasps.friction, grasps.units, cone_edges))
        else:
            # Programs of hands are large as they are: contact by contact.
            def of_contact(_: None, contact: tuple) -> tuple[None, jax.Array]:
                inverse, friction = contact
                rows = _directions(inverse[:, :, None], friction[None], grasps.units, cone_edges)
                return None, support(grasps.terms, rows[:, :, 0])

            contacts = jnp.moveaxis(inverse, 2, 0), grasps.friction
            reach = jnp.moveaxis(in_turn(of_contact, None, contacts)[1], 0, 1)
            actuators = fenced(support)(grasps.terms, actuator_reach(grasps.actuated, inverse[:, :6], grasps.units))
    else:

        def worse(reach: tuple, vertex: tuple) -> tuple[tuple, None]:
            inverse_root, wrench = vertex
            inverse = pseudo_inverse(grasps.rows, inverse_root)[0]
            rows = [_directions(inverse, grasps.friction, grasps.units, cone_edges)]
            if grasps.actuated is not None:
                rows.append(actuator_reach(grasps.actuated, inverse[:, :6], grasps.units))
            pulls = [fold(jnp.add, row * wrench[:, None, None]) for row in rows]
            return tuple(jnp.maximum(r, p) for r, p in zip(reach, pulls, strict=True)), None

        lanes = grasps.length.shape
        shapes = [(cone_edges * (grasps.columns.shape[1] - 2) + 1, *grasps.present.shape)]
        if grasps.actuated is not None:
            shapes.append((2, grasps.actuated.transmission.shape[1], *lanes))
        none = tuple(jnp.zeros(shape, grasps.present.dtype) for shape in shapes)
        (reach, *rest), _ = lax.scan(worse, none, (grasps.vertex_inverse_roots, wrenches_of(grasps.terms)))
        actuators = rest[0] if rest else None
    reach = jnp.where(grasps.present > 0, reach, 0)
    return RowLosses(reach[:-1], reach[-1], actuators, basis)


def _directions(inverse: jax.Array, friction: jax.Array, units: jax.Array, cone_edges: int) -> jax.Array:
    """The wrenches -(C G*) of all facet rows, then E G*: (6, rows, n, *lanes) from G* (k, 6 or more, n, *lanes)."""

    @fenced
    def spread(inverse: jax.Array, friction: jax.Array, units: jax.Array) -> jax.Array:
        c, s, k, *pole = literal(-contact_facets(cone_edges, len(inverse)).T, inverse.dtype)[..., None, None]

        def component(each_wrench: tuple) -> jax.Array:
            inverse, unit = each_wrench
            cone = c * inverse[0] + s * inverse[1] + (k * friction) * inverse[2]
            if pole:
                cone = cone + pole[0] * inverse[3]
            return jnp.concatenate([cone, inverse[2:3]]) * unit

        return each(component, (jnp.moveaxis(inverse[:, :6], 1, 0), units))

    return spread(inverse, friction, units)


def reach_adjoint(
    grasps: Grasps, cone: jax.Array, bound: jax.Array, cone_edges: int, with_terms: bool
) -> tuple[jax.Array, jax.Array, jax.Array | None, tuple[Term, ...] | None]:
    """The transpose of the derivative of -S_1 and S_2.

    By Danskin's theorem d h_D(a) = w'da at the worst wrench w for a, and a row of C G* or E G* is a'G*: so the
    cotangent of G* is the sum over the rows of a w', weighted by their cotangents.

    Args:
        grasps: the grasps.
        cone: (n_e, n, *lanes), cotangents of -S_1; 2 n_e of soft contacts.
        bound: (n, *lanes), of S_2.
        cone_edges: n_e.
        with_terms: whether the cotangents of the disturbance set are wanted.

    Returns:
        Cotangents of the columns of G, friction, the roots of compliance (None for Q = I) and of the terms (None where
        not wanted).
    """
    weights = jnp.where(grasps.present > 0, jnp.concatenate([cone, bound[None]]), 0)
    if grasps.vertex_inverse_roots is not None or with_terms:
        # Rare, with nothing to save: JAX differentiates the rows themselves.
        data = (grasps.columns, grasps.friction, grasps.inverse_root, grasps.vertex_inverse_roots, grasps.terms)

        def reach(columns: jax.Array, friction: jax.Array, root: Any, vertex_roots: Any, terms: Any) -> tuple:
            changed = replace(grasps, columns=columns, friction=friction, terms=terms)
            changed = replace(changed, inverse_root=root, vertex_inverse_roots=vertex_roots)
            return worst_rows(changed, cone_edges)[:2]

        columns, friction, root, vertex_roots, terms = jax.vjp(reach, *data)[1]((weights[:-1], weights[-1]))
        return columns, friction, root if vertex_roots is None else vertex_roots, terms

    inverse, _ = pseudo_inverse(grasps.columns, grasps.inverse_root)
    worst = fenced(furthest)(grasps.terms, _directions(inverse, grasps.friction, grasps.units, cone_edges))

    @fenced
    def gather(worst: jax.Array, weights: jax.Array, friction: jax.Array, units: jax.Array) -> tuple:
        facets = contact_facets(cone_edges, len(inverse))
        c, s, k, *pole = literal(facets.T, weights.dtype)[..., None, None]

        def component(each_wrench: tuple) -> tuple:
            worst, unit = each_wrench
            pulled = worst * weights * unit
            cone = pulled[:-1]
            along_normal = fold(jnp.add, cone * k)
            normal = pulled[-1] - friction * along_normal
            torsion = [-fold(jnp.add, cone * p) for p in pole]
            return jnp.stack([-fold(jnp.add, cone * c), -fold(jnp.add, cone * s), normal, *torsion]), along_normal

        return each(component, (worst, units))

    # (6, k, n, *lanes), of the blocks of G*, and what comes with friction.
    pulled, along_normal = gather(worst, weights, grasps.friction, grasps.units)
    friction = -fold(jnp.add, along_normal * inverse[2])
    columns, root = pseudo_inverse_adjoint(grasps.columns, grasps.inverse_root, pulled)
    return columns, friction, root, None


def reach_outside(grasps: Grasps, basis: Basis) -> jax.Array:
    """Measure how far the disturbance set reaches outside the range of G, as a share of its size, (*lanes).

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
