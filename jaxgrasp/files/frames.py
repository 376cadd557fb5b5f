"""Frames: the one place where poses of other conventions become positions with quaternions, w first.

A pose (..., 7) says how a frame stands in another one; `compose(a, b)` is b, which is told in a's frame, told in the
frame that a is told in. Rotations R turn coordinates of the inner frame into those of the outer one.
"""

import numpy as np
from jaxtyping import Float

from jaxgrasp.files.grasp_set import STANDING


def compose(outer: Float[np.ndarray, "*batch 7"], inner: Float[np.ndarray, "*batch 7"]) -> np.ndarray:
    """The inner pose in the frame that the outer one is told in; leading axes broadcast."""
    outer, inner = np.broadcast_arrays(outer, inner)
    position = outer[..., :3] + rotate(outer[..., 3:], inner[..., :3])
    return np.concatenate([position, multiply(outer[..., 3:], inner[..., 3:])], -1)


def invert(pose: Float[np.ndarray, "*batch 7"]) -> np.ndarray:
    """The pose of the frame that a pose is told in, in the pose's own frame."""
    back = pose[..., 3:] * (1.0, -1.0, -1.0, -1.0)
    return np.concatenate([-rotate(back, pose[..., :3]), back], -1)


def multiply(one: Float[np.ndarray, "*batch 4"], other: Float[np.ndarray, "*batch 4"]) -> np.ndarray:
    """The product of quaternions, the turn of the other one first."""
    w, v = one[..., :1], one[..., 1:]
    u, z = other[..., :1], other[..., 1:]
    scalar = w * u - (v * z).sum(-1, keepdims=True)
    return np.concatenate([scalar, w * z + u * v + np.cross(v, z)], -1)


def rotate(quaternion: Float[np.ndarray, "*batch 4"], vector: Float[np.ndarray, "*batch 3"]) -> np.ndarray:
    """The vector turned by a unit quaternion."""
    w, v = quaternion[..., :1], quaternion[..., 1:]
    across = 2.0 * np.cross(v, vector)
    return vector + w * across + np.cross(v, across)


def unit(pose: Float[np.ndarray, "*batch 7"]) -> np.ndarray:
    """The pose with its quaternion at length one; that of a zero quaternion, or of a huge one, is not a number."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        length = np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
        turn = np.where(np.isfinite(length), pose[..., 3:] / length, np.nan)
    return np.concatenate([pose[..., :3], turn], -1)


def of_matrices(rotation: Float[np.ndarray, "*batch 3 3"], position: Float[np.ndarray, "*batch 3"]) -> np.ndarray:
    """Poses of rotation matrices, whose columns are the inner frame's axes, and positions."""
    r = rotation
    # Each row is the quaternion times four times one of its entries; the largest row divides by the least rounding.
    a, b, c = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    x, y, z = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    p, q, s = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    rows = np.stack(
        [
            np.stack([1 + a + b + c, x, y, z], -1),
            np.stack([x, 1 + a - b - c, p, q], -1),
            np.stack([y, p, 1 - a + b - c, s], -1),
            np.stack([z, q, s, 1 - a - b + c], -1),
        ],
        -2,
    )
    best = np.argmax(np.nan_to_num(np.diagonal(rows, axis1=-2, axis2=-1), nan=-1.0), -1)
    chosen = np.take_along_axis(rows, best[..., None, None], -2)[..., 0, :]
    chosen = np.where(chosen[..., :1] < 0, -chosen, chosen)
    return unit(np.concatenate([position, chosen], -1))


def of_transforms(transforms: Float[np.ndarray, "*batch 4 4"]) -> np.ndarray:
    """Poses of homogeneous matrices."""
    return of_matrices(transforms[..., :3, :3], transforms[..., :3, 3])


def euler_xyz(angles: Float[np.ndarray, "*batch 3"]) -> np.ndarray:
    """Quaternions of turns about the fixed axes x, y and z, in this order, rad."""
    turn = np.zeros((*angles.shape[:-1], 4))
    turn[..., 0] = 1.0
    for axis in range(3):
        step = np.zeros_like(turn)
        step[..., 0], step[..., 1 + axis] = np.cos(angles[..., axis] / 2), np.sin(angles[..., axis] / 2)
        turn = multiply(step, turn)
    return turn


def standing(count: int) -> np.ndarray:
    """Poses (N, 7) of what stands in its parent's frame."""
    return np.tile(STANDING, (count, 1))
