"""Get a Grip: `<object>_<0_scale>.npy`, a pickled dict of arrays for an Allegro hand.

`trans` (B, 3) and `rot` (B, 3, 3) say how the hand's first link stands in the frame of the object's file;
`joint_angles` (B, 16) are those of the index, middle and ring finger and the thumb, from the palm outwards:
`joint_0.0` ... `joint_15.0` of the Allegro hand's URDF. Fields that end in `_start` are where its optimiser began.
"""

import re

import numpy as np

from jaxgrasp.files.columns import sources, travelling
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import array
from jaxgrasp.files.frames import of_matrices, standing
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GRASP, GraspSet, HandPoses
from jaxgrasp.storage import FileError

NAME = "get_a_grip"
_JOINTS = tuple(f"joint_{k}.0" for k in range(16))
_FIELDS = ("trans", "rot", "joint_angles")
# `core-mug-10f6e_0_1000`: 0.1000 after the object's code.
_SCALE = re.compile(r"(.+)_(\d+)_(\d+)")


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind == "objects" and all(name in content.table for name in _FIELDS)


def read(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of an object.

    Raises:
        FileError: A field cannot be used.
    """
    path, table = content.path, content.table
    count = len(array(path, table, "trans", (None, 3)))
    if not count:
        raise FileError(path, "trans", "no grasps", "at least one")
    stages = {}
    for stage, ending in ((GRASP, ""), ("start", "_start")):
        if not ending or all(name + ending in table for name in _FIELDS):
            position = array(path, table, "trans" + ending, (count, 3))
            poses = of_matrices(array(path, table, "rot" + ending, (count, 3, 3)), position)
            joints = array(path, table, "joint_angles" + ending, (count, len(_JOINTS)))
            stages[stage] = HandPoses(given.base(path, poses), joints)
    match = _SCALE.fullmatch(path.stem)
    used = {name + ending for name in _FIELDS for ending in ("", "_start")}
    return GraspSet(
        stages=stages,
        joint_names=_JOINTS,
        object_pose=standing(count),
        object_scale=np.full(count, float(f"{match.group(2)}.{match.group(3)}") if match else np.nan),
        object_name=np.full(count, match.group(1) if match else path.stem),
        source=sources(path, count),
        columns=travelling({name: x for name, x in table.items() if name not in used}, count),
    )
