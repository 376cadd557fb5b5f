"""Blocking forces: how the fingers answer while a disturbance acts, (14)-(15), and the G* that they come from."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
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
        (*batch, n_d, n_c, 3), N, contact frames; 0 for absent contacts, NaN where the data are not admissible. Of soft
        contacts (*batch, n_d, n_c, 4), the fourth the moment about the normal, N m.

    Raises:
        ValueError: shapes that do not fit.
    """
    data = GraspData.from_arguments(contacts, DisturbanceSet.vertices(wrenches), compliance=compliance)
    found = over_grasps(_BlockingForces(), data)
    units = _units(contacts)
    return found if units is None else found * units[..., None, :, :]


def weighted_pseudo_inverse(
    contacts: Contacts, compliance: ArrayLike | Compliance | None = None
) -> Float[Array, "*batch rows 6"]:
    """The weighted pseudo-inverse G* = Q^-1 G' (G Q^-1 G')^+ of the grasp map (15).

    G* W are the contact forces that supply the wrench W with the least f' Q f; contacts without friction have normal
    forces alone, so their tangents have no columns in G and Q here and rows of 0 in G*. On a rank-deficient grasp that
    holds for wrenches in the range of G, G G* G = G; what G* makes of others is not their nearest part there. Soft
    contacts have four rows each, the fourth for the moment about the normal, N m.

    Args:
        contacts: the grasps.
        compliance: Q of (14), contact frames: None for the identity, (*batch, n_c, 3, 3) blocks by contact or
            (*batch, 3 n_c, 3 n_c) full, symmetric positive definite; n_d of them with `Compliance.per_direction`. For
            soft contacts 4 in place of 3, see `largest_disturbance`.

    Returns:
        (*batch, 3 n_c, 6), contact by contact in contact frames, from N and N m in the object frame to N; (*batch, n_d,
        3 n_c, 6) for one Q a direction. Rows of absent forces are 0; NaN where the data are not admissible.

    Raises:
        ValueError: shapes that do not fit.

    Derivatives:
        Of any order with respect to positions, frames and compliance, while the rank of G stays.
    """
    still = np.zeros((1, 6))
    if isinstance(compliance, Compliance):
        # Blocks have an axis more than full matrices, which are larger than 3 by 3 but for single contacts.
        shape = compliance.per_vertex.shape
        still = np.zeros((shape[-4 if len(shape) > 3 and shape[-1] == contacts.components else -3], 6))
    data = GraspData.from_arguments(contacts, DisturbanceSet.vertices(still), compliance=compliance)
    found = over_grasps(_PseudoInverse(), data)
    units = _units(contacts)
    if units is not None:
        units = units[..., None, :, :] if isinstance(compliance, Compliance) else units
        found = found * units[..., None]
    return found.reshape(*found.shape[:-3], -1, 6)


def _units(contacts: Contacts) -> jax.Array | None:
    """What turns the components of soft contacts from newtons to N and N m, (*batch, n_c, 4); None for hard ones."""
    if contacts.torsional_arms is None:
        return None
    arms = jnp.where(contacts.active, contacts.torsional_arms, 0)[..., None]
    return jnp.concatenate([jnp.ones((*arms.shape[:-1], 3), arms.dtype), arms], -1)


@dataclass(frozen=True)
class _PseudoInverse(Plain):
    rows = 18

    def evaluate(self, grasps: Grasps) -> jax.Array:
        # (k, 6, n, *lanes) to (n, k, 6, *lanes); its columns take newtons alone.
        blocks = lambda root: jnp.moveaxis(pseudo_inverse(grasps.columns, root)[0], 2, 0) * grasps.units
        if grasps.vertex_inverse_roots is None:
            inverses = blocks(grasps.inverse_root)
            present = grasps.present[:, None, None]
        else:
            inverses = jax.lax.map(blocks, grasps.vertex_inverse_roots)
            present = grasps.present[None, :, None, None]
        return jnp.where(grasps.valid, jnp.where(present > 0, inverses, 0), jnp.nan)


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
