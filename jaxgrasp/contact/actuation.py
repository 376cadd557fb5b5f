"""What the joints and actuators of a hand transmit to its contacts."""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp import linalg
from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.compiling import own_settings
from jaxgrasp.records import record

# Singular values of B below this share of the largest count as zero.
_RANK_TOLERANCE = 1e-6


@record
class Actuation:
    """Contact Jacobians, transmission and limits of a hand's actuators: which contact forces the hand can produce.

    Statically, joint torques J'f balance the reactions to the contact forces f, and come from actuator efforts u:
    J'f = B u with u_min <= u <= u_max. Joint directions that no actuator reaches, N'B = 0, bear nothing: N'J'f = 0.
    While a disturbance acts, of all efforts with B u = J'f the smallest answer it, u = B^+ J'f. Make one with
    `from_jacobian`.
    """

    jacobian: Float[Array, "*batch contacts k joints"]
    """J, velocity of each contact point on the hand in its contact frame, per unit of joint velocity; m/rad or 1. k =
    3; for soft contacts 4, with the angular velocity about the normal, rad/rad or rad/m."""
    transmission: Float[Array, "*batch joints actuators"]
    """B, joint torque or force per unit of effort."""
    lower: Float[Array, "*batch actuators"]
    """u_min, in units of effort (N or N m); -inf where unlimited."""
    upper: Float[Array, "*batch actuators"]
    """u_max; inf where unlimited."""
    inverse: Float[Array, "*batch actuators joints"]
    """B^+."""
    unreached: Float[Array, "*batch directions joints"] | None
    """N', rows that span what B does not reach (there may be more rows than directions); None where B reaches all."""

    @classmethod
    @own_settings()
    def from_jacobian(
        cls, jacobian: ArrayLike, transmission: ArrayLike, lower: ArrayLike, upper: ArrayLike
    ) -> "Actuation":
        """Actuation from Jacobians and transmission.

        Args:
            jacobian: J (*batch, n_c, 3, n_v), contact frames; for soft contacts (*batch, n_c, 4, n_v).
            transmission: B (*batch, n_v, n_u). One that all grasps share, known while tracing, is best: the number of
                directions without an actuator is then known, too.
            lower: u_min (*batch, n_u); may be -inf.
            upper: u_max (*batch, n_u); may be inf.

        Raises:
            ValueError: shapes that do not fit. Limits that cross or are NaN make their grasp
                `Status.INVALID_INPUT`.
        """
        jacobian = as_float("jacobian", jacobian, ("n_c", "3 or 4", "n_v"))
        if jacobian.shape[-2] not in (3, 4):
            raise ValueError(
                f"jacobian: got shape {jacobian.shape}, wanted (*batch, n_c, 3, n_v), or 4 for soft contacts"
            )
        joints, dtype = jacobian.shape[-1], jacobian.dtype
        given = as_float("transmission", transmission, (joints, "n_u"))
        lower, upper = (
            as_float(name, limit, (given.shape[-1],)) for name, limit in (("lower", lower), ("upper", upper))
        )
        broadcast_batch(
            jacobian=jacobian.shape[:-3],
            transmission=given.shape[:-2],
            lower=lower.shape[:-1],
            upper=upper.shape[:-1],
        )
        if given.ndim == 2 and not isinstance(transmission, Tracer):
            # What is not finite makes every grasp inadmissible, here it only must not stop the decomposition.
            known = np.nan_to_num(np.asarray(transmission, np.float64), posinf=0, neginf=0)
            left, values, right = np.linalg.svd(known)
            rank = int(np.sum(values > _RANK_TOLERANCE * max(values.max(initial=0), np.finfo(float).tiny)))
            inverse = jnp.asarray((right[:rank].T / values[:rank]) @ left[:, :rank].T, dtype)
            unreached = jnp.asarray(left[:, rank:].T, dtype) if rank < joints else None
        else:
            inverse = linalg.pinv(given, _RANK_TOLERANCE)
            unreached = jnp.eye(joints, dtype=given.dtype) - given @ inverse
        return cls(
            jacobian=jacobian,
            transmission=given.astype(dtype),
            lower=lower.astype(dtype),
            upper=upper.astype(dtype),
            inverse=inverse.astype(dtype),
            unreached=None if unreached is None else unreached.astype(dtype),
        )

    @own_settings()
    def joint_torques(
        self, forces: Float[Array, "*batch contacts 3"], moments: Float[Array, "*batch contacts"] | None = None
    ) -> Float[Array, "*batch joints"]:
        """J'f: the joint torques that put the forces (*batch, n_c, 3), N, contact frames, on the object; N m or N.

        Those of soft contacts with the moments (*batch, n_c) about the normals, N m.
        """
        torques = jnp.einsum("...iav,...ia->...v", self.jacobian[..., :3, :], forces)
        if moments is None:
            return torques
        return torques + jnp.einsum("...iv,...i->...v", self.jacobian[..., 3, :], moments)

    @own_settings()
    def joint_torque_weights(
        self, lever: ArrayLike = 1e-3
    ) -> Float[Array, "*batch contact_components contact_components"]:
        """Q_0 of (22) for least joint torques: J J', for which f_0'Q_0 f_0 = |J'f_0|^2, the sum of squared torques.

        J J' couples the contacts of a finger, so Q_0 is full. Forces that no joint has to bear cost nothing by it: so
        that Q_0 is positive definite, a force counts as a torque at the lever.

        Args:
            lever: (*batch,), > 0, m; small beside the lengths of the fingers, and not below a thousandth of them (in
                float32, a hundredth).

        Returns:
            J J' + lever^2 I, (*batch, 3 n_c, 3 n_c), contact by contact in contact frames, for `effort_weights`; of
            soft contacts (*batch, 4 n_c, 4 n_c).

        Raises:
            ValueError: shapes that do not fit.
        """
        lever = as_float("lever", lever, ()).astype(self.jacobian.dtype)
        broadcast_batch(jacobian=self.jacobian.shape[:-3], lever=lever.shape)
        rows = self.jacobian.reshape(*self.jacobian.shape[:-3], -1, self.jacobian.shape[-1])
        weights = jnp.einsum("...pv,...qv->...pq", rows, rows, precision="highest")
        return weights + lever[..., None, None] ** 2 * jnp.eye(rows.shape[-2], dtype=rows.dtype)
