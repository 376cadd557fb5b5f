"""DexGraspNet 2.0: `.npz` of a scene and object with `point`, `translation` (N, 3), `rotation` (N, 3, 3) and joints.

Each joint is an array (N,) of its name. The pose is that of the hand's first link in the scene; where the object stands
in it the file does not say, and the object's frame is taken to be the scene's.
"""

import numpy as np

from jaxgrasp.files.columns import sources, travelling
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import array, checked_joints, single_stage
from jaxgrasp.files.frames import of_matrices, standing
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.storage import FileError

NAME = "dexgraspnet2"


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind == "arrays" and {"translation", "rotation"} <= content.table.keys()


def read(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of a file.

    Raises:
        FileError: A field cannot be used.
    """
    path, table = content.path, content.table
    rotation = array(path, table, "rotation", (None, 3, 3))
    count = len(rotation)
    if not count:
        raise FileError(path, "rotation", "no grasps", "at least one")
    position = array(path, table, "translation", (count, 3))
    names = checked_joints(path, "joints", [name for name, x in table.items() if _is_joint(x, count)])
    joints = np.stack([array(path, table, name, (count,)) for name in names], -1)
    others = {name: x for name, x in table.items() if name not in (*names, "rotation", "translation")}
    return GraspSet(
        stages=single_stage(given.base(path, of_matrices(rotation, position)), joints),
        joint_names=names,
        object_pose=standing(count),
        object_scale=np.ones(count),
        object_name=np.full(count, path.stem),
        source=sources(path, count),
        columns=travelling(others, count),
    )


def _is_joint(value: object, count: int) -> bool:
    return isinstance(value, np.ndarray) and value.shape == (count,) and value.dtype.kind == "f"
