"""Candidates for hands: random configurations, and fingers closed until they touch, many at once."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float
from jaxgrasp.compiling import compiled
from jaxgrasp.hands.hand_object import HandObject
from jaxgrasp.hands.kinematics import FREE

# Joints move by at most this much a step, rad or m.
_LONGEST_STEP = 0.15
# Damping of a finger's step: joints that hardly change the distance move hardly at all, (m/rad)^2.
_DAMPING = 1e-5
_JITTER = 0.015


@dataclass(frozen=True)
class _Finger:
    """Joints (places in `HandObject.joints`) that move one fingertip and no other, and the slots of what they move."""

    joints: np.ndarray
    slots: np.ndarray


def close_fingers(hand: HandObject, qpos: ArrayLike, steps: int = 40, depth: float = 1e-4) -> Float[Array, "*batch nq"]:
    """Bends each finger until its nearest link touches the object; the object and joints of several fingers stay.

    A finger goes down the gradient of its distance by damped Newton steps, so it also backs out of the object. One
    that cannot reach ends where its joints do, or where no small motion brings it nearer. Fingers do not see each
    other.

    Args:
        hand: The hand and the object.
        qpos: (*batch, nq), where to begin.
        steps: How many steps.
        depth: How deep to press, m: contacts that just do not touch would count as none.

    Returns:
        (*batch, nq).

    Raises:
        ValueError: qpos has another length.
    """
    qpos = as_float("qpos", qpos, (hand.nq,))
    closed = _compiled(hand, steps)(qpos.reshape(-1, hand.nq).astype(jnp.result_type(float)), depth)
    return closed.reshape(qpos.shape)


def sample_configurations(
    hand: HandObject, count: int, seed: int = 0, progress: Callable[[int], None] | None = None, tile: int = 1024
) -> Float[np.ndarray, "count nq"]:
    """Random configurations whose fingers are closed around the object.

    A free object is turned at random and moved by up to 1.5 cm from where the scene has it; a hand of which each finger
    has joints of its own begins with these between their reference and a random place in their range.

    Args:
        hand: The hand and the object.
        count: How many.
        seed: Of the random numbers; the same one gives the same configurations.
        progress: Called with the number of configurations done.
        tile: Configurations at a time.
    """
    model, random = hand.model, np.random.default_rng(seed)
    qpos = np.tile(model.qpos0, (count, 1))
    own = np.concatenate([finger.joints for finger in _fingers(hand)])
    joints = hand.joints[own]
    low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], (-np.pi, np.pi)).T
    start = model.qpos0[model.jnt_qposadr[joints]]
    target = random.uniform(low, high, (count, len(joints)))
    qpos[:, model.jnt_qposadr[joints]] = start + random.uniform(0.0, 0.6, (count, 1)) * (target - start)
    for joint in np.flatnonzero((model.jnt_bodyid == hand.object_body) & (model.jnt_type == FREE)):
        at = model.jnt_qposadr[joint]
        qpos[:, at : at + 3] += random.uniform(-_JITTER, _JITTER, (count, 3))
        turns = random.normal(size=(count, 4))
        qpos[:, at + 3 : at + 7] = turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    closed = []
    for first in range(0, count, tile):
        # The last tile is filled up, so that one compilation serves all.
        rows = np.arange(first, first + min(tile, count)) % count
        closed.append(np.asarray(close_fingers(hand, qpos[rows]))[: count - first])
        if progress is not None:
            progress(min(first + tile, count))
    return np.concatenate(closed) if closed else qpos


def _compiled(hand: HandObject, steps: int) -> Callable[..., jax.Array]:
    """One compilation for a hand and a number of steps."""
    known = hand.__dict__.setdefault("_closing", {})
    if steps not in known:
        known[steps] = compiled(partial(_close, hand, _fingers(hand), steps))
    return known[steps]


def _close(hand: HandObject, fingers: list[_Finger], steps: int, qpos: jax.Array, depth: jax.Array) -> jax.Array:
    model = hand.model
    addresses = model.jnt_qposadr[hand.joints]
    low, high = np.where(model.jnt_limited[hand.joints, None], model.jnt_range[hand.joints], (-np.inf, np.inf)).T
    low, high = jnp.asarray(low, qpos.dtype), jnp.asarray(high, qpos.dtype)

    def step(_: jax.Array, qpos: jax.Array) -> jax.Array:
        points, velocities = hand.approach(qpos)
        change = jnp.zeros_like(qpos[:, addresses])
        for finger in fingers:
            distances = points.distance[:, finger.slots]
            nearest = distances.argmin(-1)
            distance = jnp.take_along_axis(distances, nearest[:, None], 1)
            place = jnp.asarray(finger.slots)[nearest][:, None, None]
            slope = jnp.take_along_axis(velocities, place, 1)[:, 0, finger.joints]
            move = -(distance + depth) * slope / (jnp.sum(slope * slope, -1, keepdims=True) + _DAMPING)
            change = change.at[:, finger.joints].set(jnp.clip(move, -_LONGEST_STEP, _LONGEST_STEP))
        joints = jnp.clip(qpos[:, addresses] + jnp.where(jnp.isfinite(change), change, 0), low, high)
        return qpos.at[:, addresses].set(joints)

    return lax.fori_loop(0, steps, step, qpos)


def _fingers(hand: HandObject) -> list[_Finger]:
    """Joints with one outermost jointed body below them belong to the finger that ends there."""
    model = hand.model
    bodies = model.jnt_bodyid[hand.joints]
    moved = hand.moved_bodies
    # The jointed bodies that each joint moves, and of these the ones that move no other.
    outermost = [
        b for b in np.unique(bodies) if not any(moved[o, bodies == b].any() for o in np.unique(bodies) if o != b)
    ]
    tips = moved[outermost]
    own = tips.sum(0) == 1
    fingers = []
    for row in tips:
        joints = np.flatnonzero(row & own)
        slots = np.flatnonzero(moved[hand.slot_links][:, joints].any(-1)) if len(joints) else []
        if len(slots):
            fingers.append(_Finger(joints, np.asarray(slots)))
    if not fingers:
        raise ValueError(
            "hand: no finger has joints of its own and a geom that can touch; wanted a hand that can close"
        )
    return fingers
