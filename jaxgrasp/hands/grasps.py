"""What a hand in a configuration does to an object: contacts, and which forces its actuators can give them."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgrasp import linalg
from jaxgrasp.contact import Actuation, Contacts
from jaxgrasp.records import record


@record
class HandGrasps:
    """Grasps of a `HandObject` in a batch of configurations.

    Without the actuation, `actuation`, `spring_torques`, `spring_efforts` and `joint_stiffness` are None.
    """

    contacts: Contacts
    """In the object's frame about its centre of mass, those of the nearest links first; active where they touch."""
    distances: Float[Array, "*batch contacts"]
    """Of the surfaces at each contact, m, negative where they penetrate; inf in slots without a point."""
    links: Int[Array, "*batch contacts"]
    """The body of the hand that each contact is on, its number in the model."""
    touching: Int[Array, "*batch"]
    """How many links touch (how many points, where all points are contacts), also those beyond `max_contacts`."""
    left_out: Int[Array, "*batch"]
    """How many of these `max_contacts` leaves out."""
    penetration: Float[Array, "*batch"]
    """The deepest penetration of hand and object, m, at least 0."""
    required_wrench: Float[Array, "*batch 6"]
    """The object's weight less its gravity compensation, to be borne, N and N m, object frame; NaN where the
    configuration is not admissible."""
    actuation: Actuation | None
    """What the hand can do; joints are its own, without those that a coupling makes follow others. Efforts are those of
    the actuators, then those that joints bear by themselves: dry friction, stops, springs on which nothing else acts.
    The springs' torques are part of all of them; `HandObject.actuator_efforts` takes these out. None where nothing acts
    on the hand."""
    spring_torques: Float[Array, "*batch joints"] | None
    """c, N m or N."""
    spring_efforts: Float[Array, "*batch efforts"] | None
    """What these are in the efforts of `actuation`, by which its limits are moved."""
    actuator_lengths: Float[Array, "*batch actuators"]
    """rad or m, from which position servos pull."""
    joint_stiffness: Float[Array, "*batch joints joints"] | None
    """K, N m/rad or N/m: position servos by their gains, and springs."""
    object_position: Float[Array, "*batch 3"]
    """The object's centre of mass, m, world frame."""
    object_rotation: Float[Array, "*batch 3 3"]
    """The object's frame: columns are its axes in the world frame."""

    def in_world_frame(self, forces: Float[Array, "*batch contacts 3"]) -> tuple[Array, Array]:
        """Contact points, m, and forces (*batch, n_c, 3), N, given in contact frames, both in the world frame."""
        turned = jnp.einsum("...ij,...cjk,...ck->...ci", self.object_rotation, self.contacts.frames, forces)
        points = jnp.einsum("...ij,...cj->...ci", self.object_rotation, self.contacts.positions)
        return points + self.object_position[..., None, :], turned


def contact_compliance(
    contacts: Contacts, jacobian: Array, joint_stiffness: Array, tip_stiffness: Array
) -> Float[Array, "*batch rows rows"]:
    """J K^+ J' + K_tip^-1 of contacts, see `HandObject.compliance`."""
    tall = jacobian.reshape(*jacobian.shape[:-3], -1, jacobian.shape[-1])
    tips = jnp.broadcast_to(1 / tip_stiffness, jacobian.shape[:-2]) if tip_stiffness.ndim == 0 else 1 / tip_stiffness
    tips = jnp.repeat(tips, jacobian.shape[-2], -1)
    arms = contacts.torsional_arms
    if arms is not None:
        # Where a contact bears no moment any number will do.
        turning = jnp.where(arms > 0, 1 / jnp.where(arms > 0, arms, 1) ** 2, 1)
        weights = jnp.concatenate([jnp.ones((*arms.shape, 3), arms.dtype), turning[..., None]], -1)
        tips = tips * weights.reshape(*arms.shape[:-1], -1)
    tips = jnp.broadcast_to(tips, tall.shape[:-1])
    reached = tall @ linalg.pinv(joint_stiffness, 1e-9) @ jnp.swapaxes(tall, -1, -2)
    return reached + tips[..., None] * jnp.eye(tall.shape[-2], dtype=tall.dtype)
