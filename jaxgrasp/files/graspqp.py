"""GraspQP: `<object>.dexgrasp.pt`, a file of `torch.save` with `values` (N,) and `parameters` by name.

`root_pose` (N, 7) says how the hand's first link stands in the object's frame, w first; every other parameter is a
joint (N,). Velocities of the fingers by joint, with which they squeeze, travel along as columns (N, n) in the order of
the joints. The scale of the object is not in the file.
"""

import numpy as np

from jaxgrasp.files.columns import sources, travelling
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import array, checked_joints, part, single_stage
from jaxgrasp.files.frames import standing
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.storage import FileError

NAME = "graspqp"
_ENDING = ".dexgrasp.pt"


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    inner = content.table.get("parameters")
    return content.kind in ("torch", "objects") and isinstance(inner, dict) and "root_pose" in inner


def read(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of an object.

    Raises:
        FileError: A field cannot be used.
    """
    path, table = content.path, content.table
    parameters = part(path, table, "parameters")
    poses = array(path, parameters, "root_pose", (None, 7), "parameters.")
    count = len(poses)
    if not count:
        raise FileError(path, "parameters.root_pose", "no grasps", "at least one")
    names = checked_joints(path, "parameters", [name for name in parameters if name != "root_pose"])
    joints = np.stack([array(path, parameters, name, (count,), "parameters.") for name in names], -1)
    columns: dict[str, object] = {}
    for field, value in table.items():
        if isinstance(value, dict) and field != "parameters" and set(value) == set(names):
            value = np.stack([array(path, value, name, (count,), f"{field}.") for name in names], -1)
        columns[str(field)] = value
    name = path.name.removesuffix(_ENDING) if path.name.endswith(_ENDING) else path.stem
    return GraspSet(
        stages=single_stage(given.base(path, poses), joints),
        joint_names=names,
        object_pose=standing(count),
        object_scale=np.full(count, np.nan),
        object_name=np.full(count, name),
        source=sources(path, count),
        columns=travelling(columns, count),
    )
