"""Files of parallel grippers: the pose of the gripper's base for each grasp, and no joints.

**ACRONYM** (HDF5): `grasps/transforms` (N, 4, 4), `object/file`, `object/scale` and qualities.
**GraspGen** (JSON): `object` {`file`, `scale`} and `grasps` {`transforms` (N, 4, 4), `object_in_gripper` (N,)}.

Both say how the base of the gripper stands in the object's frame, z towards the object and x along the jaws' way. How
far the jaws are apart they do not say: joints are left as the hand's file has them.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxgrasp.files.columns import numbers, sources, texts, travelling
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import array, part, single_stage
from jaxgrasp.files.frames import of_transforms, standing
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.files.scene_cfg import uniform
from jaxgrasp.storage import FileError, printable

ACRONYM, GRASPGEN = "acronym", "graspgen"
_TRANSFORMS = "grasps/transforms"


def recognises_acronym(content: Content) -> bool:
    """Whether the content is of ACRONYM."""
    return content.kind == "hdf5" and _TRANSFORMS in content.table


def recognises_graspgen(content: Content) -> bool:
    """Whether the content is of GraspGen."""
    grasps = content.table.get("grasps")
    return content.kind == "json" and isinstance(grasps, dict) and "transforms" in grasps


def read_acronym(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of an object.

    Raises:
        FileError: A field cannot be used.
    """
    path, table = content.path, content.table
    scale = numbers(path, "object/scale", part(path, table, "object/scale", np.ndarray))
    name = part(path, table, "object/file", np.ndarray)
    others = {field.rpartition("/")[2]: x for field, x in table.items() if field.startswith("grasps/qualities/")}
    return _read(content, given, table, _TRANSFORMS, "", str(name), uniform(path, "object/scale", scale), others)


def read_graspgen(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of an object.

    Raises:
        FileError: A field cannot be used.
    """
    path, grasps = content.path, part(content.path, content.table, "grasps")
    scale, name = np.nan, path.stem
    if "object" in content.table:
        thing = part(path, content.table, "object")
        scale = uniform(path, "object.scale", part(path, thing, "scale", (int, float, list), "object."))
        name = part(path, thing, "file", str, "object.")
    others = {
        str(field): np.array(value)
        for field, value in grasps.items()
        if field != "transforms" and isinstance(value, list) and all(isinstance(x, int | float) for x in value)
    }
    return _read(content, given, grasps, "transforms", "grasps.", name, scale, others)


def _read(
    content: Content,
    given: Given,
    table: Mapping[str, Any],
    field: str,
    where: str,
    name: str,
    scale: float,
    others: dict[str, np.ndarray],
) -> GraspSet:
    path = content.path
    transforms = array(path, table, field, (None, 4, 4), where)
    count = len(transforms)
    if not count:
        raise FileError(path, where + field, "no grasps", "at least one")
    return GraspSet(
        stages=single_stage(given.base(path, of_transforms(transforms)), np.zeros((count, 0))),
        joint_names=(),
        object_pose=standing(count),
        object_scale=np.full(count, scale),
        object_name=texts(path, "object file", printable(name), count),
        source=sources(path, count),
        columns=travelling(others, count),
    )
