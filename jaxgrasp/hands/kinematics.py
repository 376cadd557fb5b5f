"""Where everything is in a configuration: forward kinematics over lanes, one level of the tree of bodies at a time.

MJX has forward kinematics, too. For 1,024 configurations of the Shadow Hand they took 46 ms and 15 s of compilation,
these 9 ms and 3 s, on a busy machine with two cores.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxgrasp.arrays import fold, safe_norm
from jaxgrasp.lanes.fence import fenced, fences

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "BALL", "SLIDE", "HINGE")
)


class Poses(NamedTuple):
    """World frame; lanes trail."""

    rotations: jax.Array
    """(3, 3, bodies, *lanes), columns are the bodies' axes."""
    positions: jax.Array
    """(3, bodies, *lanes), m."""
    anchors: jax.Array
    """(3, joints, *lanes), a point on each joint's axis, m."""
    axes: jax.Array
    """(3, joints, *lanes)."""


@dataclass(frozen=True)
class _Level:
    """Bodies that are equally far from the world's.

    parents: their parents' places in the level before.
    offsets, turns: (3, m) and (3, 3, m), of each body in its parent.
    free: (m,), where the position of a free body begins in qpos, else -1.
    joints: (slots, m), hinges and slides, in order; -1 for none.
    """

    bodies: np.ndarray
    parents: np.ndarray
    offsets: np.ndarray
    turns: np.ndarray
    free: np.ndarray
    joints: np.ndarray


class Kinematics:
    """The tree of bodies of a model."""

    def __init__(self, model: mujoco.MjModel):
        """Sorts the bodies into levels.

        Raises:
            ValueError: A joint is a ball; it is named.
        """
        for joint in np.flatnonzero(model.jnt_type == BALL):
            raise ValueError(
                f"scene: joint {model.joint(joint).name!r} is a ball; wanted hinges, slides and free joints"
            )
        self._model = model
        self._levels = _levels(model)
        order = np.concatenate([[0], *[level.bodies for level in self._levels]])
        self._place = np.argsort(order)

    def poses(self, qpos: jax.Array) -> Poses:
        """Poses in configurations (nq, *lanes)."""
        with fences(jax.default_backend() == "cpu"):
            lanes, dtype = qpos.shape[1:], qpos.dtype
            eye = _constant(np.eye(3)[..., None], lanes, dtype)
            rotation, position = eye, jnp.zeros((3, 1, *lanes), dtype)
            rotations, positions = [rotation], [position]
            anchors, axes = {}, {}
            for level in self._levels:
                rotation, position, found = self._step(level, rotation, position, qpos)
                rotations.append(rotation)
                positions.append(position)
                for (slot, body), joint in np.ndenumerate(level.joints):
                    if joint >= 0:
                        anchors[int(joint)], axes[int(joint)] = (x[:, body] for x in found[slot])
        none = jnp.zeros((3, *lanes), dtype)
        stack = lambda parts: jnp.stack([parts.get(j, none) for j in range(self._model.njnt)], 1)
        together = lambda parts, axis: jnp.take(jnp.concatenate(parts, axis), self._place, axis)
        return Poses(together(rotations, 2), together(positions, 1), stack(anchors), stack(axes))

    def _step(self, level: _Level, rotation: jax.Array, position: jax.Array, qpos: jax.Array) -> tuple:
        """One level from the one before; also anchor and axis (3, m, *lanes) of every slot of joints."""
        model, lanes, dtype = self._model, qpos.shape[1:], qpos.dtype
        # Padding with a zero: bodies without a joint in a slot turn by nothing.
        padded = jnp.concatenate([qpos, jnp.zeros_like(qpos[:1])])
        addresses = np.append(model.jnt_qposadr, model.nq)
        rest = np.append(model.qpos0, 0.0)[addresses]

        @fenced
        def descend(rotation: jax.Array, position: jax.Array) -> tuple[jax.Array, jax.Array]:
            above = rotation[:, :, level.parents]
            moved = position[:, level.parents] + _turn(above, _constant(level.offsets, lanes, dtype))
            turned = _product(above, _constant(level.turns, lanes, dtype))
            free = np.flatnonzero(level.free >= 0)
            if len(free):
                start = level.free[free]
                moved = moved.at[:, free].set(jnp.stack([qpos[start + i] for i in range(3)]))
                turned = turned.at[:, :, free].set(_from_quaternion(jnp.stack([qpos[start + 3 + i] for i in range(4)])))
            return turned, moved

        @fenced
        def move(rotation: jax.Array, position: jax.Array, change: jax.Array) -> tuple[jax.Array, ...]:
            axis = _turn(rotation, own_axis)
            anchor = position + _turn(rotation, own_anchor)
            turned = _product(rotation, _about(own_axis, jnp.where(hinge, change, 0)))
            moved = jnp.where(hinge, anchor - _turn(turned, own_anchor), position + axis * jnp.where(slide, change, 0))
            return turned, moved, anchor, axis

        rotation, position = descend(rotation, position)
        found = []
        for joints in level.joints:
            there = joints >= 0
            kind = np.where(there, model.jnt_type[joints], -1)
            own_axis = _constant(np.where(there, model.jnt_axis[joints].T, 0), lanes, dtype)
            own_anchor = _constant(np.where(there, model.jnt_pos[joints].T, 0), lanes, dtype)
            hinge, slide = (jnp.asarray(kind == k).reshape(-1, *[1] * len(lanes)) for k in (HINGE, SLIDE))
            number = np.where(there, joints, model.njnt)
            change = padded[addresses[number]] - _constant(rest[number], lanes, dtype)
            rotation, position, anchor, axis = move(rotation, position, change)
            found.append((anchor, axis))
        return rotation, position, found


def _levels(model: mujoco.MjModel) -> tuple[_Level, ...]:
    depth = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    levels, before = [], np.array([0])
    for at in range(1, depth.max(initial=0) + 1):
        bodies = np.flatnonzero(depth == at)
        own = [np.flatnonzero(model.jnt_bodyid == body) for body in bodies]
        free = [j[0] if len(j) and model.jnt_type[j[0]] == FREE else -1 for j in own]
        moving = [j[model.jnt_type[j] != FREE] for j in own]
        joints = np.full((max(map(len, moving)), len(bodies)), -1)
        for column, numbers in enumerate(moving):
            joints[: len(numbers), column] = numbers
        levels.append(
            _Level(
                bodies=bodies,
                parents=np.searchsorted(before, model.body_parentid[bodies]),
                offsets=model.body_pos[bodies].T,
                turns=matrices(model.body_quat[bodies]),
                free=np.array([model.jnt_qposadr[j] if j >= 0 else -1 for j in free]),
                joints=joints,
            )
        )
        before = bodies
    return tuple(levels)


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotations (3, 3, m) of unit quaternions (m, 4)."""
    out = np.zeros((len(quaternions), 9))
    for row, quaternion in zip(out, quaternions, strict=True):
        mujoco.mju_quat2Mat(row, quaternion)
    return out.reshape(-1, 3, 3).transpose(1, 2, 0)


def place(rotations: jax.Array, positions: jax.Array, offsets: np.ndarray, turns: np.ndarray) -> tuple:
    """Rotations (3, 3, m, *lanes) and positions (3, m, *lanes) of what is fixed to bodies, given in these' frames."""
    lanes, dtype = positions.shape[2:], positions.dtype
    moved = positions + _turn(rotations, _constant(offsets, lanes, dtype))
    return _product(rotations, _constant(turns, lanes, dtype)), moved


def _constant(values: np.ndarray, lanes: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
    return jnp.broadcast_to(
        jnp.asarray(values, dtype).reshape(*values.shape, *[1] * len(lanes)), (*values.shape, *lanes)
    )


def _turn(rotation: jax.Array, vector: jax.Array) -> jax.Array:
    return fold(jnp.add, [rotation[:, j] * vector[j] for j in range(3)])


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return fold(jnp.add, [a[:, j, None] * b[None, j] for j in range(3)])


def _about(axis: jax.Array, angle: jax.Array) -> jax.Array:
    """The rotation by an angle (m, *lanes) about a unit axis (3, m, *lanes); a zero axis turns by nothing."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y, z = axis
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    eye = jnp.eye(3, dtype=angle.dtype).reshape(3, 3, *[1] * angle.ndim)
    return cosine * eye + sine * cross + (1 - cosine) * (axis[:, None] * axis[None])


def _from_quaternion(quaternion: jax.Array) -> jax.Array:
    """(3, 3, m, *lanes) from (4, m, *lanes), normalised."""
    w, x, y, z = quaternion / safe_norm(quaternion, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])
