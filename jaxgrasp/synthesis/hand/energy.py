"""What the grasp of a hand lacks, as an energy: links off the surface, things inside each other, a small margin.

The margin is that of (21) for contacts where the links that shall touch are nearest to the object. It is differentiable
there whether they touch or not; but a link that is a distance d away may press with exp(-(d/l)^2) of the largest
force only. So links that can do something for the margin are drawn to the object by it, and with l falling the margin
comes to be that of the contacts there are.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.hands.surroundings import Surroundings
from jaxgrasp.robustness import largest_disturbance

# m.
_CENTIMETRE = 0.01
# Parts of the hand that are nearer to each other than this count as inside each other, m.
_CLEARANCE = 0.001
# Of the largest force, which links far away keep: forces must be positive.
_LEAST_FORCE = 1e-3


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Weights:
    """How much each term of the energy counts."""

    distance: Float[Array, ""] | float = 1.0
    """For each centimetre between the object and a link that shall touch it."""
    penetration: Float[Array, ""] | float = 3.0
    """For each centimetre that a geom of the hand is inside the object."""
    self_penetration: Float[Array, ""] | float = 3.0
    """For each centimetre that parts of the hand are inside each other."""
    margin: Float[Array, ""] | float = 3.0
    """For a margin as large as the largest force of a contact."""


class Terms(NamedTuple):
    """Of the energy, each (n,), before they are weighted."""

    distance: Array
    penetration: Array
    self_penetration: Array
    margin: Array

    def energy(self, weights: Weights) -> Float[Array, " n"]:
        """What is to become small."""
        return (
            weights.distance * self.distance
            + weights.penetration * self.penetration
            + weights.self_penetration * self.self_penetration
            - weights.margin * self.margin
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Task:
    """What is wanted of every grasp."""

    disturbances: DisturbanceSet
    """The set D, without batch axes."""
    gravity: Float[Array, "3"]
    """Under which the object's weight must be borne, m/s^2, world frame."""
    weights: Weights
    """Of the terms."""
    steps: Float[Array, ""]
    """Of the descent, in all."""


def terms_of(
    around: Surroundings,
    qpos: Float[Array, "n nq"],
    task: Task,
    reserve: Float[Array, ""],
    touch_length: Float[Array, ""],
    torque_limits: bool,
) -> Terms:
    """The terms of the energy in configurations.

    Args:
        around: The hand and the object.
        qpos: Configurations.
        task: What they shall withstand.
        reserve: d of every facet row, N.
        touch_length: l, m.
        torque_limits: Whether the margin is what the actuators can produce.
    """
    near, hand = around.near(qpos), around.hand
    inward = lambda vectors: jnp.einsum("nji,n...j->n...i", near.object_rotation, vectors)
    share = jnp.exp(-((near.distance / touch_length) ** 2))
    contacts = Contacts.from_normals(
        inward(near.position - near.object_position[:, None]),
        inward(near.normal),
        friction=near.friction,
        max_force=hand.max_force * (_LEAST_FORCE + (1 - _LEAST_FORCE) * share),
    )
    weight = -hand.object_mass * inward(jnp.broadcast_to(task.gravity, (len(qpos), 3)))
    margin = largest_disturbance(
        contacts,
        task.disturbances,
        jnp.concatenate([weight, jnp.zeros_like(weight)], -1),
        cone_margin=reserve,
        actuation=around.actuation(qpos, near, contacts) if torque_limits else None,
    ).margin
    return Terms(
        distance=jnp.abs(near.distance).sum(-1) / _CENTIMETRE,
        penetration=near.depths.sum(-1) / _CENTIMETRE,
        self_penetration=jnp.maximum(_CLEARANCE - near.self_distances, 0).sum(-1) / _CENTIMETRE,
        margin=jnp.where(jnp.isfinite(margin), margin, 0) / hand.max_force,
    )
