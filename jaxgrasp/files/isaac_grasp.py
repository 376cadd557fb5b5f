"""isaac_grasp 1.0: YAML with the pose of the gripper's frame in the object's, and joints by name.

`gripper_frame_link` (or `gripper_frame`) names the link whose pose the file has; where a hand is given and has a link
of this name, its file says where that stands, and otherwise the link is taken to stand in the world of the hand's
file. `confidence` travels along; 0 means that the grasp failed. `object_file` and `object_scale` may stand in a grasp,
too, where those of a file differ.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxgrasp.files.columns import numbers, per_grasp, sources, text_array
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import array, checked_joints, part, stacked
from jaxgrasp.files.frames import standing
from jaxgrasp.files.given import WORLD, Given
from jaxgrasp.files.grasp_set import GRASP, GraspSet, HandPoses
from jaxgrasp.storage import FileError, printable

NAME = "isaac_grasp"
JOINTS = {GRASP: "cspace_position", "pregrasp": "pregrasp_cspace_position"}
"""Fields of the joints, by stage."""
_NUMBER = (int, float)


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind in ("yaml", "json") and content.table.get("format") == NAME


def read(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of a file.

    Raises:
        FileError: A field cannot be used, or grasps have other joints than the first one.
    """
    path, table = content.path, content.table
    version = str(table.get("format_version", "1.0"))
    if version.split(".")[0] != "1":
        raise FileError(path, "format_version", printable(version), "1.0")
    grasps = part(path, table, "grasps")
    if not grasps:
        raise FileError(path, "grasps", "no grasps", "at least one")
    rows = [part(path, grasps, name, dict, "grasps.") for name in grasps]
    poses = np.concatenate([_pose(path, row, name) for name, row in zip(grasps, rows, strict=True)])
    base = given.base(path, poses, _link(table, given))
    names, stages, notes = _joints(path, rows, base)
    columns = {
        name: numbers(path, name, [row[name] for row in rows])
        for name in rows[0]
        if name != "object_scale"
        and all(isinstance(row.get(name), _NUMBER) and not isinstance(row.get(name), bool) for row in rows)
    }
    count = len(rows)
    name = table.get("object_file") or _frame(table, "object_frame") or path.stem
    scales = [row.get("object_scale", table.get("object_scale", 1.0)) for row in rows]
    return GraspSet(
        stages=stages,
        joint_names=names,
        object_pose=standing(count),
        object_scale=per_grasp(path, "object_scale", scales, count),
        object_name=text_array(path, "object_file", [printable(row.get("object_file", name)) for row in rows]),
        source=sources(path, count),
        columns={str(name): column for name, column in columns.items()},
        notes=notes,
    )


def _joints(
    path: Path, rows: list[dict[str, Any]], base: np.ndarray
) -> tuple[tuple[str, ...], dict[str, HandPoses], tuple[str, ...]]:
    """Names of the joints, the stages, and what was assumed where grasps have no joints, or those before it alone."""
    fields = {stage: field for stage, field in JOINTS.items() if any(field in row for row in rows)}
    if not fields:
        return (), {GRASP: HandPoses(base, np.zeros((len(rows), 0)))}, ()
    given = fields.get(GRASP, JOINTS["pregrasp"])
    first = list(part(path, rows[0], given, dict, "grasps.0."))
    names, stages = checked_joints(path, given, first), {}
    for stage, field in fields.items():
        if field == given or all(field in row for row in rows):
            values = [part(path, row, field, dict, f"grasps.{k}.") for k, row in enumerate(rows)]
            stages[stage] = HandPoses(base, stacked(path, field, values, first))
    if GRASP in stages:
        return names, stages, ()
    note = f"{path}: cspace_position: there is none; fingers are taken to stand as in {given}"
    return names, {GRASP: stages["pregrasp"], **stages}, (printable(note),)


def _pose(path: Path, row: Mapping[str, Any], name: object) -> np.ndarray:
    where = f"grasps.{printable(name)}."
    turn = part(path, row, "orientation", dict, where)
    w = part(path, turn, "w", _NUMBER, f"{where}orientation.")
    xyz = array(path, turn, "xyz", (3,), f"{where}orientation.")
    return np.concatenate([array(path, row, "position", (3,), where), [w], xyz])[None]


def _frame(table: Mapping[str, Any], name: str) -> str | None:
    found = table.get(f"{name}_link") or table.get(name)
    # As a path in a stage of USD: its last part is the link.
    return str(found).rpartition("/")[2] if found else None


def _link(table: Mapping[str, Any], given: Given) -> str | None:
    link = _frame(table, "gripper_frame")
    return link if link is not None and given.has_link(link) else WORLD
