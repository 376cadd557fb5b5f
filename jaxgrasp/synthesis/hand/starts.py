"""Where hands begin: the palm before a random place of the object's surface, the fingers half open."""

import numpy as np
from jaxtyping import Float

from jaxgrasp.hands.surroundings import Surroundings

# The palm's distance from the surface, as a share of what it is in the scene.
_NEAREST, _FARTHEST = 0.1, 1.3
# The palm looks by up to this past the surface's normal, rad, and by this past the place itself, m.
_TILT, _BESIDE = 0.5, 0.015
# Joints begin at most this share of the way from their reference to a random place in their range.
_BENT = 0.6


def random_starts(around: Surroundings, count: int, random: np.random.Generator) -> Float[np.ndarray, "count nq"]:
    """Random configurations of a hand in front of an object.

    Places on the surface are the nearest ones to points all around the object. There the palm's side that faces the
    object in the scene is put, turned about the normal at random and tilted.

    Args:
        around: The hand and the object.
        count: How many.
        random: Random numbers.
    """
    model, hand = around.hand.model, around.hand
    qpos = np.tile(model.qpos0, (count, 1))
    joints = hand.joints[around.joints]
    low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], (-np.pi, np.pi)).T
    rest = model.qpos0[model.jnt_qposadr[joints]]
    target = random.uniform(low, high, (count, len(joints)))
    bent = rest + _BENT * random.uniform(size=(count, 1)) * (target - rest)
    qpos[:, model.jnt_qposadr[joints]] = np.clip(bent, low, high)

    start, forward, gap = around.approach
    directions = _unit(random.normal(size=(count, 3)))
    place, normal = around.surface_points(around.reach * directions)
    # The object is turned so that its normal looks at the palm, and then by a random angle about that line.
    facing = _unit(-forward + np.tan(_TILT) * random.uniform(size=(count, 1)) * _unit(random.normal(size=(count, 3))))
    turn = _between(facing, random.uniform(0, 2 * np.pi, count)) @ np.swapaxes(_between(normal, np.zeros(count)), 1, 2)
    distance = random.uniform(_NEAREST, _FARTHEST, (count, 1)) * gap
    target = start + distance * forward + random.uniform(-_BESIDE, _BESIDE, (count, 3))
    centre = target - np.einsum("nij,nj->ni", turn, place)
    around.put_object(qpos, centre, turn)
    return qpos


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _between(direction: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) that take z to directions, after a turn by an angle about z."""
    helper = np.where(np.abs(direction[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = _unit(np.cross(helper, direction))
    frame = np.stack([x, np.cross(direction, x), direction], -1)
    cosine, sine, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    about = np.array([[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]]).transpose(2, 0, 1)
    return frame @ about
