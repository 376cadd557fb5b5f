"""Whether given forces hold a grasp that is not quite the one they were found for."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgrasp.arrays import literal
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.robustness import weighted_pseudo_inverse, worst_case

# What a row may be missed by, in units of the contact's largest force: forces of (22) leave rows nothing at all.
_ACCEPTED_MISS = {"float64": 1e-7, "float32": 1e-4}


def slack_of(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    required_wrench: Float[Array, "*batch 6"] | None,
    compliance: jax.Array | None,
    cone_margin: jax.Array,
    cone_edges: int,
    pushes: Float[Array, "*batch contacts 3"],
    margin: Float[Array, "*batch"],
) -> Float[Array, "*batch"]:
    """The least slack of any row, N, with forces f_0 and their answers to what they leave and to the disturbances.

    What f_0 does not supply of the required wrench, blocking forces (15) do: f = f_0 + G* (b - G f_0). The rows are
    C f - S_1 lambda <= -d and -E f + S_2 lambda <= f_max. Wrenches outside the range of G are not looked at.

    Args:
        contacts: the grasps as they are.
        disturbances: the set D.
        required_wrench: b; None is zero.
        compliance: Q, as in `largest_disturbance`.
        cone_margin: d, (*batch,), (*batch, n_c) or (*batch, n_c, n_e), N.
        cone_edges: n_e.
        pushes: f_0 in the object frame, N.
        margin: lambda.
    """
    inverse = weighted_pseudo_inverse(contacts, compliance)
    cone_loss, bound_loss = worst_case(contacts, disturbances, compliance, cone_edges)
    active = contacts.active[..., None]
    pushes = jnp.where(active, pushes, 0)
    moments = jnp.cross(jnp.where(active, contacts.positions, 0), pushes)
    left = -jnp.concatenate([pushes.sum(-2), moments.sum(-2)], -1)
    if required_wrench is not None:
        left = left + required_wrench
    answers = (inverse * left[..., None, :]).sum(-1).reshape(contacts.positions.shape)
    forces = (contacts.frames * pushes[..., None]).sum(-2) + answers

    c, s, k = literal(pyramid_facets(cone_edges).T, forces.dtype)
    tangential = c * forces[..., :1] + s * forces[..., 1:2]
    friction, normal = contacts.friction[..., None], forces[..., 2:]
    # Without friction a contact bears its normal force alone, and its rows of C are cos(pi / n_e) f_n.
    rows = jnp.where(friction > 0, tangential + k * friction * normal, k * normal)
    slipping = jnp.where(friction > 0, jnp.inf, -jnp.abs(forces[..., :2]).sum(-1, keepdims=True))[..., 0]
    reserve = cone_margin.reshape(*cone_margin.shape, *[1] * (rows.ndim - cone_margin.ndim))
    cone = cone_loss * margin[..., None, None] - reserve - rows
    bound = contacts.max_force + forces[..., 2] - bound_loss * margin[..., None]
    allowed = _ACCEPTED_MISS[forces.dtype.name] * contacts.max_force
    least = jnp.minimum(jnp.minimum(cone.min(-1), bound), slipping) + allowed
    return jnp.where(contacts.active, least, jnp.inf).min(-1)
