"""The worst that a disturbance set does to each row: S_1 (17) and S_2 (18), through support functions.

While the disturbance w acts, the grasp answers with the blocking forces -G* w. So facet row k of contact i loses at
most h_D(-(C G*)_ik) and the bound on its normal force at most h_D((E G*)_i): S_1 = -h_D(-(C G*)), S_2 = h_D(E G*),
whatever kind of set D is.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold, literal
from jaxgrasp.contact.compliance import RANK_TOLERANCE, Basis, Compliance, pseudo_inverse
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.sets import support
from jaxgrasp.fence import each, fenced
from jaxgrasp.robustness.grasps import Grasps, over_grasps


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

    return over_grasps((_worst_kernel,), contacts, disturbances, cone_edges, compliance=compliance)


def _worst_kernel(grasps: Grasps, cone_edges: int) -> tuple[jax.Array, jax.Array]:
    cone, bound, _ = worst_rows(grasps, cone_edges)
    hide = lambda x: jnp.where(grasps.valid, x, jnp.nan)  # noqa: E731
    return hide(jnp.moveaxis(-cone, 0, 1)), hide(bound)


def worst_rows(grasps: Grasps, cone_edges: int) -> tuple[jax.Array, jax.Array, Basis]:
    """-S_1 (n_e, n, *lanes), S_2 (n, *lanes) and the basis of G's rows; lanes trail."""

    @fenced
    def directions(inverse: jax.Array, friction: jax.Array, units: jax.Array) -> jax.Array:
        """Wrenches -(C G*) of all facet rows, then E G*: (6, n_e + 1, n, *lanes) from G* (3, 6, n, *lanes)."""
        c, s, k = literal(pyramid_facets(cone_edges).T, inverse.dtype)[..., None, None]

        def component(each_wrench: tuple) -> jax.Array:
            inverse, unit = each_wrench
            cone = -(c * inverse[0] + s * inverse[1] + (k * friction) * inverse[2])
            return jnp.concatenate([cone, inverse[2:]]) * unit

        return each(component, (jnp.moveaxis(inverse, 1, 0), units))

    inverse, basis = pseudo_inverse(grasps.columns, grasps.half)
    if grasps.vertex_halves is None:
        reach = fenced(support)(grasps.terms, directions(inverse, grasps.friction, grasps.units))
    else:

        def worse(reach: jax.Array, vertex: tuple) -> tuple[jax.Array, None]:
            half, wrench = vertex
            rows = directions(pseudo_inverse(grasps.columns, half)[0], grasps.friction, grasps.units)
            return jnp.maximum(reach, fold(jnp.add, rows * wrench[:, None, None])), None

        reach = jnp.zeros((cone_edges + 1, *grasps.present.shape), grasps.present.dtype)
        reach, _ = lax.scan(worse, reach, (grasps.vertex_halves, grasps.terms[0].wrenches))
    reach = jnp.where(grasps.present > 0, reach, 0)
    return reach[:-1], reach[-1], basis


def reaches_outside(grasps: Grasps, basis: Basis) -> jax.Array:
    """Whether the disturbance set has wrenches outside the range of G, (*lanes).

    Args:
        grasps: the grasps and the set.
        basis: of the rows of G.
    """
    lanes, length = grasps.length.shape, grasps.length
    tolerance = 10 * RANK_TOLERANCE[length.dtype.name]

    def measure() -> jax.Array:
        size = sum(fold(jnp.maximum, extent * grasps.units) for extent in grasps.extents)
        outside = jnp.moveaxis(jnp.where(basis.kept[:, None] > 0, 0, basis.operations), 0, 1) * grasps.units[:, None]
        reach = support(grasps.terms, jnp.concatenate([outside, -outside], 1))
        return fold(jnp.maximum, reach) > tolerance * size

    return lax.cond(jnp.all(basis.kept > 0), lambda: jnp.zeros(lanes, bool), measure)
