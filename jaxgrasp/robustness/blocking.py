"""Blocking forces: how the fingers answer while a disturbance acts, (14)-(15)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold
from jaxgrasp.contact.compliance import Compliance, pseudo_inverse
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.lanes.differentiable import Plain
from jaxgrasp.robustness.grasps import Grasps, over_grasps
from jaxgrasp.robustness.interface.arguments import GraspData


def blocking_forces(
    contacts: Contacts, wrenches: ArrayLike, compliance: ArrayLike | Compliance | None = None
) -> Float[Array, "*batch directions contacts 3"]:
    """Blocking forces delta f_j = -G*_j W_j (15): what the fingers add while disturbance j acts.

    Of all contact forces that balance W_j they have the least delta f' Q delta f. They are for lambda = 1 and add to
    the tightening forces f_0. On a rank-deficient grasp they balance what lies in the range of G.

    Args:
        contacts: the grasps.
        wrenches: W (*batch, n_d, 6), disturbances on the object, N and N m, object frame.
        compliance: Q, as in `largest_disturbance`; one each with `Compliance.per_direction`.

    Returns:
        (*batch, n_d, n_c, 3), N, contact frames; 0 for absent contacts, NaN where the data are not admissible.

    Raises:
        ValueError: shapes that do not fit.
    """
    data = GraspData.from_arguments(contacts, DisturbanceSet.vertices(wrenches), compliance=compliance)
    return over_grasps(_BlockingForces(), data)


@dataclass(frozen=True)
class _BlockingForces(Plain):
    rows = 8

    def evaluate(self, grasps: Grasps) -> jax.Array:
        scaled = wrenches_of(grasps.terms) * grasps.units
        if grasps.vertex_inverse_roots is None:
            inverse = pseudo_inverse(grasps.columns, grasps.inverse_root)[0]
            # Spelt out: products of matrices are library calls, which a tile cannot make.
            parts = [jnp.moveaxis(inverse[:, e], 0, 1) * scaled[:, e][:, None, None] for e in range(6)]
            forces = -fold(jnp.add, parts)
        else:
            one = lambda each: -jnp.einsum("aen...,e...->na...", pseudo_inverse(grasps.columns, each[0])[0], each[1])
            forces = jax.lax.map(one, (grasps.vertex_inverse_roots, scaled))
        forces = jnp.where(grasps.present[:, None] > 0, forces, 0)
        return jnp.where(grasps.valid, forces, jnp.nan)
