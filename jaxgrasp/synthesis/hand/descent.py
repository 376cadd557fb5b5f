"""Hands on their way down the energy: pose on SE(3) and joint angles, many at once, by Adam.

A step is taken in the tangent space of the configurations, three translations, three rotations and the joints, and
retracted: the position by addition, the quaternion by the exponential map, joints by addition and then into their
limits, which are so kept all the way. Early the margin is counted with a reserve, which gives hopeless grasps a slope,
and for links that are not there yet; both fade.
"""

import functools
from dataclasses import dataclass
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float

from jaxgrasp.arrays import safe_norm
from jaxgrasp.compiling import compiled
from jaxgrasp.hands.surroundings import Surroundings
from jaxgrasp.synthesis.hand.energy import Task, Terms, terms_of

# Steps of one call of the compiled program: between calls the progress is told.
CHUNK = 10
# The reserve at the start, in units of the largest force, and the share of the steps after which it is gone.
_RESERVE, _WITH_RESERVE = 0.1, 0.6
# l at the start and at the end, m, and the share of the steps after which it falls no more.
_TOUCH_LENGTHS, _FALLING = (0.02, 0.004), 0.8
# Adam's step at the start and at the end, rad; in metres for translations it is by the length below less.
_FIRST_STEP, _LAST_STEP, _LENGTH = 0.05, 0.001, 0.03
_ADAM = optax.scale_by_adam(b1=0.9, b2=0.99)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class State:
    """Hands on their way; starts lead."""

    qpos: Float[Array, "starts nq"]
    """Where they are."""
    momentum: Any
    """Adam's."""

    @classmethod
    def from_starts(cls, around: Surroundings, qpos: Float[Array, "starts nq"]) -> "State":
        """Hands that have not moved yet."""
        # Adam's own count of steps becomes one a lane, so that all of it can be spread over devices.
        momentum = jax.vmap(_ADAM.init)(jnp.zeros((len(qpos), 6 + len(around.joints)), qpos.dtype))
        return cls(qpos=qpos, momentum=momentum)


@functools.partial(compiled, static_argnums=(3, 4, 5))
def advance(
    state: State, task: Task, first: Array, around: Surroundings, torque_limits: bool, mesh: Mesh
) -> tuple[State, Terms]:
    """`CHUNK` steps of all hands, spread over the devices.

    Args:
        state: The hands.
        task: What is wanted.
        first: The number of the first of these steps.
        around: Hand and object.
        torque_limits: Whether the margin is what the actuators can produce.
        mesh: The devices, one axis "starts".

    Returns:
        The hands, and the terms (chunk, starts) before every step.
    """

    def on_one_device(state: State, task: Task, first: Array) -> tuple[State, Terms]:
        return lax.scan(
            lambda s, number: _step(s, task, number, around, torque_limits), state, first + jnp.arange(CHUNK)
        )

    spread = jax.shard_map(
        on_one_device,
        mesh=mesh,
        in_specs=(P("starts"), P(), P()),
        out_specs=(P("starts"), P(None, "starts")),
        check_vma=False,
    )
    return spread(state, task, first)


def _step(state: State, task: Task, number: Array, around: Surroundings, torque_limits: bool) -> tuple[State, Terms]:
    done = number.astype(state.qpos.dtype) / task.steps
    most, least = _TOUCH_LENGTHS
    reserve = _RESERVE * around.hand.max_force * jnp.maximum(1 - done / _WITH_RESERVE, 0)
    touch_length = most * (least / most) ** jnp.minimum(done / _FALLING, 1)

    def total(move: Array) -> tuple[Array, Terms]:
        moved = retracted(around, state.qpos, move)
        found = terms_of(around, moved, task, reserve, touch_length, torque_limits)
        return found.energy(task.weights).sum(), found

    units = np.ones(6 + len(around.joints))
    units[:3] = _LENGTH
    units = jnp.asarray(units, state.qpos.dtype)
    slope, found = jax.grad(total, has_aux=True)(jnp.zeros((len(state.qpos), len(units)), state.qpos.dtype))
    slope = jnp.where(jnp.isfinite(slope), slope, 0) * units
    # Optax raises floats to integer powers, which users of strict promotion have forbidden.
    with jax.numpy_dtype_promotion("standard"):
        direction, momentum = jax.vmap(_ADAM.update)(slope, state.momentum)
    # Optax's updates are any tree; Adam's have the form of the slope.
    direction = cast(Array, direction)
    length = _LAST_STEP + _FIRST_STEP * 0.5 * (1 + jnp.cos(jnp.pi * done))
    return State(qpos=retracted(around, state.qpos, -length * units * direction), momentum=momentum), found


def retracted(
    around: Surroundings, qpos: Float[Array, "n nq"], move: Float[Array, "n tangents"]
) -> Float[Array, "n nq"]:
    """Configurations moved along tangents: m of translation, rad of rotation in the moved body's frame, and joints."""
    hand, at = around.hand, around.pose
    joints = hand.joints[around.joints]
    places = hand.model.jnt_qposadr[joints]
    low, high = np.where(hand.model.jnt_limited[joints, None], hand.model.jnt_range[joints], (-np.inf, np.inf)).T
    low, high = jnp.asarray(low, qpos.dtype), jnp.asarray(high, qpos.dtype)
    half = 0.5 * move[:, 3:6]
    angle = safe_norm(half)[:, None]
    # sin(x)/x by its series where x^2 is all that counts.
    small = angle < 1e-2
    ratio = jnp.where(small, 1 - angle**2 / 6, jnp.sin(angle) / jnp.where(small, 1, angle))
    w, v = qpos[:, at + 3 : at + 4], qpos[:, at + 4 : at + 7]
    c, u = jnp.cos(angle), ratio * half
    turned = jnp.concatenate([w * c - jnp.sum(v * u, -1, keepdims=True), w * u + c * v + jnp.cross(v, u)], -1)
    qpos = qpos.at[:, at : at + 3].add(move[:, :3])
    qpos = qpos.at[:, at + 3 : at + 7].set(turned / safe_norm(turned)[:, None])
    return qpos.at[:, places].set(jnp.clip(qpos[:, places] + move[:, 6:], low, high))
