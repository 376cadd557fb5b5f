"""The configurations before and after a grasp: fingers that have let go, and where servos pull them."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float
from jaxgrasp.hands.closing import close_fingers
from jaxgrasp.hands.grasps import HandGrasps
from jaxgrasp.hands.hand_object import HandObject


def opened(hand: HandObject, qpos: ArrayLike, clearance: float = 0.01) -> Float[Array, "*batch nq"]:
    """The pre-grasp: each finger unbent until its nearest link is so far from the object, as far as its joints let it.

    Args:
        hand: The hand and the object.
        qpos: (*batch, nq), grasps.
        clearance: m.
    """
    return close_fingers(hand, qpos, depth=-clearance)


def squeezed(hand: HandObject, qpos: ArrayLike, grasps: HandGrasps, efforts: ArrayLike) -> Float[Array, "*batch nq"]:
    """The squeeze: where joints would go under the actuators' efforts if nothing were in the way, q + K^+ (B u + c).

    Joints without stiffness, those of motors for example, stay.

    Args:
        hand: The hand and the object.
        qpos: (*batch, nq), the grasps' configurations.
        grasps: Of these.
        efforts: u (*batch, n_u), `Solution.actuator_efforts` for example, N or N m.

    Returns:
        (*batch, nq), not limited to the joints' ranges: a finger at the end of its range presses by being sent beyond.
    """
    qpos = as_float("qpos", qpos, (hand.nq,))
    if grasps.actuation is None:
        return qpos
    own = hand.actuator_efforts(grasps, efforts)
    transmission = grasps.actuation.transmission[..., : own.shape[-1]]
    torques = jnp.einsum("...vu,...u->...v", transmission, own) + grasps.spring_torques
    free = jnp.einsum("...vw,...w->...v", jnp.linalg.pinv(grasps.joint_stiffness, rtol=1e-9), torques)
    places = hand.model.jnt_qposadr[hand.joints]
    following = hand.couplings.velocities(qpos[..., places])
    return qpos.at[..., places].add(jnp.einsum("...vw,...w->...v", following, free))
