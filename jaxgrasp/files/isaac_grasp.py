"""isaac_grasp 1.0: YAML with the pose of the gripper's frame in the object's, and joints by name.

`gripper_frame_link` (or `gripper_frame`) names the link whose pose the file has; where a hand is given and has a link
of this name, its file says where that stands, and otherwise the link is taken to stand in the world of the hand's
file. `confidence` travels along; 0 means that the grasp failed.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxgrasp.files.columns import numbers, sources
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import array, checked_joints, part, stacked
from jaxgrasp.files.frames import compose, invert, standing, unit
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GRASP, GraspSet, HandPoses
from jaxgrasp.storage import FileError, atomic_write, printable

NAME = "isaac_grasp"
_JOINTS = {GRASP: "cspace_position", "pregrasp": "pregrasp_cspace_position"}
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
    version = str(table.get("format_version", "nothing"))
    if version.split(".")[0] != "1":
        raise FileError(path, "format_version", printable(version), "1.0")
    grasps = part(path, table, "grasps")
    if not grasps:
        raise FileError(path, "grasps", "no grasps", "at least one")
    rows = [part(path, grasps, name, dict, "grasps.") for name in grasps]
    poses = np.concatenate([_pose(path, row, name) for name, row in zip(grasps, rows, strict=True)])
    base = given.base(path, poses, _link(table, given))
    first = part(path, rows[0], _JOINTS[GRASP], dict, "grasps.0.")
    names = checked_joints(path, _JOINTS[GRASP], list(first))
    stages = {}
    for stage, field in _JOINTS.items():
        if stage == GRASP or all(field in row for row in rows):
            values = [part(path, row, field, dict, f"grasps.{k}.") for k, row in enumerate(rows)]
            stages[stage] = HandPoses(base, stacked(path, field, values, list(first)))
    columns = {
        name: numbers(path, name, [row[name] for row in rows])
        for name in rows[0]
        if all(isinstance(row.get(name), _NUMBER) and not isinstance(row.get(name), bool) for row in rows)
    }
    count = len(rows)
    scale = table.get("object_scale", 1.0)
    return GraspSet(
        stages=stages,
        joint_names=names,
        object_pose=standing(count),
        object_scale=np.full(count, float(scale) if isinstance(scale, _NUMBER) else np.nan),
        object_name=np.full(count, printable(table.get("object_file") or _frame(table, "object_frame") or path.stem)),
        source=sources(path, count),
        columns={str(name): column for name, column in columns.items()},
    )


def write(grasps: GraspSet, path: Path, names: tuple[str, ...] | None) -> list[str]:
    """Writes grasps of one object.

    Args:
        grasps: The grasps.
        path: The file.
        names: Names of the joints where the grasps have none.

    Returns:
        What this format cannot say.

    Raises:
        ValueError: There are grasps of several objects or scales, or joints without names.
        OSError: The file cannot be written.
    """
    names = grasps.joint_names or names
    if names is None:
        raise ValueError(f"{NAME}: got joints without names; wanted the hand, whose file has them: --hand")
    for what, values in (("objects", grasps.object_name), ("scales", grasps.object_scale)):
        if len(np.unique(values)) > 1:
            raise ValueError(f"{NAME}: got grasps of {len(np.unique(values))} {what}; wanted one in each file")
    in_object = compose(invert(unit(grasps.object_pose)), unit(grasps.stages[GRASP].base))
    # As it was, where the object stands in the world: a turn by nothing would still round.
    standing_there = (grasps.object_pose == standing(1)).all(-1, keepdims=True)
    in_object = np.where(standing_there, grasps.stages[GRASP].base, in_object)
    with atomic_write(path) as stream:
        stream.write(_head(grasps).encode())
        for row in range(len(grasps)):
            stream.write(_entry(grasps, names, in_object[row], row).encode())
    return _lost(grasps)


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
    return link if link is not None and given.has_link(link) else "world"


def _head(grasps: GraspSet) -> str:
    scale, name = grasps.object_scale[0], str(grasps.object_name[0])
    lines = [f"format: {NAME}", 'format_version: "1.0"', "object_frame_link: object", "gripper_frame_link: world"]
    lines += [f"object_file: {_quoted(name)}"] if name else []
    lines += [] if np.isnan(scale) else [f"object_scale: {float(scale)!r}"]
    return "\n".join([*lines, "grasps:"]) + "\n"


def _entry(grasps: GraspSet, names: tuple[str, ...], pose: np.ndarray, row: int) -> str:
    confidence = float(_confidence(grasps)[row])
    x, y, z, w, *turn = (_real(value) for value in pose)
    lines = [f"  grasp_{row}:", f"    confidence: {_real(confidence)}", f"    position: [{x}, {y}, {z}]"]
    lines += [f"    orientation: {{w: {w}, xyz: [{', '.join(turn)}]}}"]
    for stage, field in _JOINTS.items():
        if stage in grasps.stages:
            values = zip(names, grasps.stages[stage].joints[row], strict=True)
            lines += [f"    {field}:", *(f"      {_quoted(name)}: {_real(value)}" for name, value in values)]
    return "\n".join(lines) + "\n"


def _confidence(grasps: GraspSet) -> np.ndarray:
    """Of the file that the grasps came from; else whether they held where that is known."""
    for name in ("confidence", "succ_flag", "held"):
        column = grasps.columns.get(name)
        if column is not None and column.ndim == 1 and column.dtype.kind in "biuf":
            return column.astype(float)
    return np.ones(len(grasps))


def _real(value: float) -> str:
    """A number with all its digits, as YAML writes it."""
    text = repr(float(value))
    return {"nan": ".nan", "inf": ".inf", "-inf": "-.inf"}.get(text, text)


def _quoted(text: str) -> str:
    inside = printable(text.replace("\\", "\\\\").replace('"', '\\"'))
    return f'"{inside}"'


def _lost(grasps: GraspSet) -> list[str]:
    lost = [f"the stage {name}" for name in grasps.stages if name not in _JOINTS]
    if "pregrasp" in grasps.stages and (grasps.stages["pregrasp"].base != grasps.stages[GRASP].base).any():
        lost.append("where the base stands before the grasp")
    if (grasps.object_pose != standing(1)).any():
        lost.append("where the object stands in the world")
    lost += [f"the column {name}" for name in grasps.columns if name not in ("confidence", "succ_flag", "held")]
    return lost
