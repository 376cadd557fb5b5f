"""MultiGripperGrasp: JSON of one gripper and object with `pose` (N, 7), w first, and `dofs` (N, n) or `final_dofs`.

The pose is that of the gripper's first link in the object's frame. The joints have no names and are in the order of
PhysX, level by level of the gripper's tree: names come from the hand, where one is given, and are `dof_0` ... without.
"""

import numpy as np

from jaxgrasp.files.columns import numbers, sources, text_array, texts
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import array, single_stage
from jaxgrasp.files.frames import standing
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.storage import FileError, printable

NAME = "multigrippergrasp"


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind == "json" and "pose" in content.table and not {"dofs", "final_dofs"}.isdisjoint(content.table)


def read(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of a file.

    Raises:
        FileError: A field cannot be used.
    """
    path, table = content.path, content.table
    poses = array(path, table, "pose", (None, 7))
    count = len(poses)
    if not count:
        raise FileError(path, "pose", "no grasps", "at least one")
    field = "dofs" if "dofs" in table else "final_dofs"
    joints = array(path, table, field, (count, None))
    name = table.get("object_ID", table.get("object_id", path.stem))
    columns = {}
    for column, value in table.items():
        if column not in ("pose", field) and isinstance(value, list) and len(value) == count:
            columns[str(column)] = _column(content, column, value)
    return GraspSet(
        stages=single_stage(given.base(path, poses), joints),
        joint_names=given.names_by_level(path, field, joints.shape[1]),
        object_pose=standing(count),
        object_scale=np.ones(count),
        object_name=texts(path, "object_ID", printable(name), count),
        source=sources(path, count),
        columns=columns,
    )


def _column(content: Content, name: object, value: list) -> np.ndarray:
    if all(isinstance(each, str) for each in value):
        return text_array(content.path, str(name), value)
    if all(isinstance(each, bool) for each in value):
        return np.array(value)
    # What is not known of a grasp is null.
    return numbers(content.path, str(name), [np.nan if each is None else each for each in value])
