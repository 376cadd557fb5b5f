"""What it takes to accelerate a hand's joints and to hold its links against gravity."""

import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float
from jaxgrasp.hands.hand_object import HandObject
from jaxgrasp.hands.kinematics import HINGE, matrices, place
from jaxgrasp.hands.mechanics import point_velocities


def joint_dynamics(
    hand: HandObject, qpos: ArrayLike
) -> tuple[Float[Array, "*batch joints joints"], Float[Array, "*batch joints"]]:
    """Inertia of the hand's joints, and the joint torques that bear the weight of its links.

    With them tau = M q'' + g + J'f, but for what grows with the square of the joints' speed. It needs MuJoCo's model
    alone, so it works under jit, vmap and grad.

    Args:
        hand: The hand, whose joints are `HandObject.joints`, in this order.
        qpos: (*batch, nq).

    Returns:
        M (*batch, n_v, n_v), kg m^2 (kg for slides), armature included; and g (*batch, n_v), N m or N.

    Raises:
        ValueError: qpos has another length.
    """
    qpos = as_float("qpos", qpos, (hand.nq,))
    batch, model = qpos.shape[:-1], hand.model
    poses = hand.kinematics.poses(qpos.reshape(-1, hand.nq).T)
    bodies = np.flatnonzero(hand.moved_bodies.any(-1))
    moved = hand.moved_bodies[bodies]
    frames, centres = place(
        poses.rotations[:, :, bodies],
        poses.positions[:, bodies],
        model.body_ipos[bodies].T,
        matrices(model.body_iquat[bodies]),
    )
    axes, anchors = poses.axes[:, hand.joints].T, poses.anchors[:, hand.joints].T
    linear = point_velocities(axes, anchors, model.jnt_type[hand.joints] == HINGE, centres.T, moved, jnp)
    turns = jnp.asarray(moved & (model.jnt_type[hand.joints] == HINGE))
    axes = jnp.where(turns[..., None], poses.axes[:, hand.joints].T[:, None], 0)
    angular = jnp.einsum("jibn,nbvj->nbvi", frames, axes)
    masses, inertias = (jnp.asarray(x[bodies], qpos.dtype) for x in (model.body_mass, model.body_inertia))
    inertia = jnp.einsum("nbvi,nbwi,b->nvw", linear, linear, masses)
    inertia += jnp.einsum("nbvi,nbwi,bi->nvw", angular, angular, inertias)
    inertia += jnp.diag(jnp.asarray(model.dof_armature[hand.dofs], qpos.dtype))
    weight = -jnp.einsum("nbvi,b,i->nv", linear, masses, jnp.asarray(model.opt.gravity, qpos.dtype))
    return inertia.reshape(*batch, *inertia.shape[1:]), weight.reshape(*batch, *weight.shape[1:])


def object_inertia(model: mujoco.MjModel, body: int) -> Float[np.ndarray, "3 3"]:
    """The inertia of one body about its centre of mass, kg m^2, in the body's frame."""
    turn = matrices(model.body_iquat[body : body + 1])[..., 0]
    return turn @ np.diag(model.body_inertia[body]) @ turn.T
