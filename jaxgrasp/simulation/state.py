"""What a controller knows of a hand and an object in one instant."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxgrasp.contact import grasp_map
from jaxgrasp.hands import HandGrasps, HandObject
from jaxgrasp.hands.dynamics import joint_dynamics, object_inertia

# A fingertip farther from the object than this has lost it, m.
_REACH = 5e-3


class State(NamedTuple):
    """Measured. Contacts are in the order of the fingers, forces in contact frames, wrenches in the object's frame."""

    grasp_map: Float[Array, "lanes 6 vars"]
    """Zero where a finger has lost the object or takes no part."""
    jacobian: Float[Array, "lanes vars joints"]
    reach: Bool[Array, "lanes contacts"]
    """Where the grasp map is not zero."""
    weight: Float[Array, "lanes 6"]
    """The wrench that bears the object and turns its momentum with it, N and N m: N V - M g of (2)."""
    inertia: Float[Array, "6 6"]
    """M of (2), kg and kg m^2."""
    twist: Float[Array, "lanes 6"]
    """Of the object's centre of mass, m/s and rad/s."""
    joints: Float[Array, "lanes joints"]
    """Their positions, rad."""
    joint_velocity: Float[Array, "lanes joints"]
    joint_inertia: Float[Array, "lanes joints joints"]
    joint_bias: Float[Array, "lanes joints"]
    """Joint torques that bear the hand's links and overcome the joints' damping, N m."""
    position: Float[Array, "lanes 3"]
    """Of the object's centre of mass, m, world frame."""
    rotation: Float[Array, "lanes 3 3"]
    distances: Float[Array, "lanes contacts"]
    """Of fingertips and object, m, negative where they touch."""
    sliding: Float[Array, "lanes contacts 2"]
    """Velocity of the fingertip along the object's surface at the contact, m/s."""


def by_finger(grasps: HandGrasps) -> HandGrasps:
    """Grasps (n,) with the contacts in the order of the links that they are on."""
    order = jnp.argsort(grasps.links, -1)
    pick = lambda x: jnp.take_along_axis(x, order.reshape(*order.shape, *[1] * (x.ndim - 2)), 1)
    assert grasps.actuation is not None
    return replace(
        grasps,
        contacts=jax.tree.map(pick, grasps.contacts),
        distances=pick(grasps.distances),
        links=pick(grasps.links),
        actuation=replace(grasps.actuation, jacobian=pick(grasps.actuation.jacobian)),
    )


def measure(
    hand: HandObject,
    qpos: Float[Array, "lanes nq"],
    qvel: Float[Array, "lanes nv"],
    engaged: Bool[Array, "lanes contacts"],
) -> State:
    """The state of a hand whose fingertips have one contact slot each.

    Args:
        hand: The hand; its object is one body whose centre of mass is its origin.
        qpos: Configurations.
        qvel: Velocities as MuJoCo lays them out.
        engaged: Which fingers take part in the grasp.
    """
    grasps = by_finger(hand.grasps(qpos))
    reach = engaged & (grasps.distances <= _REACH)
    maps = grasp_map(replace(grasps.contacts, active=reach))
    whole = grasp_map(replace(grasps.contacts, active=jnp.ones_like(reach)))
    assert grasps.actuation is not None
    jacobian = grasps.actuation.jacobian.reshape(len(qpos), -1, len(hand.joints))
    start = int(hand.model.body_dofadr[hand.object_body])
    linear = jnp.einsum("nji,nj->ni", grasps.object_rotation, qvel[:, start : start + 3])
    turning = qvel[:, start + 3 : start + 6]
    joint_velocity = qvel[:, hand.dofs]
    slip = jnp.einsum("nav,nv->na", jacobian, joint_velocity)
    slip -= jnp.einsum("nwa,nw->na", whole, jnp.concatenate([linear, turning], -1))
    mass, body = hand.object_mass, jnp.asarray(object_inertia(hand.model, hand.object_body), qpos.dtype)
    inertia = jnp.zeros((6, 6), qpos.dtype).at[:3, :3].set(mass * jnp.eye(3)).at[3:, 3:].set(body)
    momentum = [mass * jnp.cross(turning, linear), jnp.cross(turning, turning @ body)]
    joint_inertia, link_weight = joint_dynamics(hand, qpos)
    return State(
        grasp_map=maps,
        jacobian=jacobian,
        reach=reach,
        weight=grasps.required_wrench + jnp.concatenate(momentum, -1),
        inertia=inertia,
        twist=jnp.concatenate([linear, turning], -1),
        joints=qpos[:, hand.model.jnt_qposadr[hand.joints]],
        joint_velocity=joint_velocity,
        joint_inertia=joint_inertia,
        joint_bias=link_weight + joint_velocity * hand.model.dof_damping[hand.dofs],
        position=grasps.object_position,
        rotation=grasps.object_rotation,
        distances=grasps.distances,
        sliding=slip.reshape(*reach.shape, 3)[..., :2],
    )
