"""Grasps of a ball by four fingers: some hold, some cannot."""

import numpy as np

from jaxgrasp.files import GraspSet, HandPoses
from jaxgrasp.hands.scenes import four_fingers

# rad: base, flex1 and flex2 of fingers whose tips touch a ball of 5 cm, and how much farther they squeeze.
BENT, SQUEEZE = (0.0, -0.165, 1.124), (0.0, 0.35, 0.0)


def ball_grasps(**columns) -> GraspSet:
    """Squeezed; not squeezed; with the ball inside a finger; no configuration; squeezed once more."""
    pose = np.tile([*_ball(), 1.0, 0.0, 0.0, 0.0], (5, 1))
    pose[2, 0] += 0.02
    joints, base = np.tile(np.tile(BENT, 4), (5, 1)), np.tile([0.0, 0, 0, 1, 0, 0, 0], (5, 1))
    squeezed = joints + np.tile(SQUEEZE, 4)
    squeezed[1] = joints[1]
    base[3, 0] = np.nan
    open_hand = joints - np.tile((0.0, 0.1, 0.0), 4)
    stages = {"pregrasp": open_hand, "grasp": joints, "squeeze": squeezed}
    return GraspSet(
        stages={name: HandPoses(base, each) for name, each in stages.items()},
        joint_names=None,
        object_pose=pose,
        object_scale=np.full(5, 0.05),
        object_name=np.full(5, "ball"),
        source=np.array([f"ball.npz:{k}" for k in range(5)]),
        columns=columns,
    )


def _ball() -> np.ndarray:
    model = four_fingers("sphere").compile()
    return model.qpos0[model.jnt_qposadr[model.body("object").jntadr[0]] :][:3]
