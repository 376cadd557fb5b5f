"""A hand and an object in MuJoCo body by body, in one configuration or along a trial."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgrasp.hands import HandObject
from jaxgrasp.hands.bodies import bodies_below
from jaxgrasp.viewer.solids import touching_geoms, triangles_of


@dataclass(frozen=True, kw_only=True)
class Bodies:
    """The bodies that can touch, and where they are; in the object's first frame, about its centre of mass, m."""

    names: tuple[str, ...]
    """What the bodies are called."""
    of_object: Bool[np.ndarray, " bodies"]
    """Which of them are the object's; the others are the hand's."""
    triangles: tuple[Float[np.ndarray, "triangles 3 3"], ...]
    """The surface of each in its own frame, m, corners counterclockwise from outside."""
    positions: Float[np.ndarray, "frames bodies 3"]
    """Where each body's frame is."""
    rotations: Float[np.ndarray, "frames bodies 3 3"]
    """How it is turned: columns are its axes."""
    turn: Float[np.ndarray, "3 3"]
    """From the world's frame to the object's first one."""

    @property
    def surfaces(self) -> list[Float[np.ndarray, "triangles 3 3"]]:
        """The surface of each in the first configuration."""
        placed = zip(self.triangles, self.rotations[0], self.positions[0], strict=True)
        return [triangles @ rotation.T + position for triangles, rotation, position in placed]


@dataclass(frozen=True, kw_only=True)
class Film:
    """A trial of one grasp."""

    bodies: Bodies
    """Hand and object along the trial."""
    time: Float[np.ndarray, " frames"]
    """s."""
    load: Float[np.ndarray, "frames 3"]
    """The force on the object, N, in the object's first frame."""
    outcome: str
    """What became of the grasp: held, lost, ..."""


def bodies_along(hand: HandObject, qpos: Float[np.ndarray, "frames nq"]) -> Bodies:
    """Hand and object in one configuration or more.

    Args:
        hand: The hand and the object.
        qpos: The configurations, in their order.
    """
    model, data = hand.model, mujoco.MjData(hand.model)
    of_object = bodies_below(model, hand.object_body)
    numbers, surfaces = _surfaces(model, np.concatenate([hand.bodies, of_object]))
    positions, rotations = np.zeros((len(qpos), len(numbers), 3)), np.zeros((len(qpos), len(numbers), 3, 3))
    turn, middle = np.eye(3), np.zeros(3)
    for frame, each in enumerate(qpos):
        data.qpos[:] = each
        mujoco.mj_kinematics(model, data)
        if frame == 0:
            mujoco.mj_comPos(model, data)
            turn = data.xmat[hand.object_body].reshape(3, 3).T
            middle = data.subtree_com[hand.object_body].copy()
        positions[frame] = (data.xpos[numbers] - middle) @ turn.T
        rotations[frame] = turn @ data.xmat[numbers].reshape(-1, 3, 3)
    return Bodies(
        names=tuple(model.body(body).name or f"body {body}" for body in numbers.tolist()),
        of_object=np.isin(numbers, of_object),
        triangles=tuple(surfaces),
        positions=positions,
        rotations=rotations,
        turn=turn,
    )


def _surfaces(model: mujoco.MjModel, bodies: Int[np.ndarray, " bodies"]) -> tuple[np.ndarray, list[np.ndarray]]:
    """The numbers of the bodies with something that can touch, and their surfaces, each in its body's frame."""
    parts: dict[int, list[np.ndarray]] = {}
    turn = np.zeros(9)
    for geom in touching_geoms(model, bodies):
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        triangles = triangles_of(model, geom) @ turn.reshape(3, 3).T + model.geom_pos[geom]
        if len(triangles):
            parts.setdefault(int(model.geom_bodyid[geom]), []).append(triangles)
    return np.array(list(parts), int), [np.concatenate(part) for part in parts.values()]
