"""Columns with the names of our own files, and of DexGraspBench's, as grasps and back.

`grasp_qpos`, `pregrasp_qpos`, `squeeze_qpos` and whatever else ends in `_qpos` are stages (N, 7 + n); `obj_pose` (N, 7)
and `obj_scale` (N,) are the object's, `joint_names` (n,) the order of the joints; all else travels along.
"""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxgrasp.files.grasp_set import GRASP, STANDING, GraspSet, HandPoses
from jaxgrasp.storage import FileError, printable

STAGE = "_qpos"
_POSE = 7
# Names of joints and objects, and paths to them.
_LONGEST = 1_024
_OWN = ("obj_pose", "obj_scale", "object_name", "joint_names", "source")


def grasps_of_columns(path: Path, table: Mapping[str, Any], object_name: str = "") -> GraspSet:
    """Makes grasps of columns.

    Args:
        path: The file that they are of, for messages.
        table: Arrays by name, stages (N, 7 + n).
        object_name: What the object is called where no column says it.

    Raises:
        FileError: A column cannot be used.
    """
    grasp = table.get(GRASP + STAGE)
    if not isinstance(grasp, np.ndarray) or not grasp.ndim or not len(grasp):
        known = ", ".join(map(str, table)) or "none"
        raise FileError(path, None, f"fields {known}", f"{GRASP}{STAGE} (N, 7 + joints)")
    count = len(grasp)
    names = joint_names(path, table.get("joint_names"))
    width = grasp.shape[1] if grasp.ndim == 2 else 0
    stages = {GRASP: _stage(path, GRASP + STAGE, grasp, count, width, names)}
    for name, value in table.items():
        # Others of this ending need not be configurations.
        if name in ("pregrasp_qpos", "squeeze_qpos") or (
            name.endswith(STAGE) and np.shape(value) == grasp.shape and name != GRASP + STAGE
        ):
            stages[name.removesuffix(STAGE)] = _stage(path, name, value, count, width, names)
    used = {stage + STAGE for stage in stages}
    return GraspSet(
        stages=stages,
        joint_names=names,
        object_pose=poses(path, "obj_pose", table.get("obj_pose"), count),
        object_scale=per_grasp(path, "obj_scale", table.get("obj_scale", 1.0), count),
        object_name=texts(path, "object_name", table.get("object_name", object_name), count),
        source=sources(path, count),
        columns=travelling({name: x for name, x in table.items() if name not in used and name not in _OWN}, count),
    )


def columns_of_grasps(grasps: GraspSet) -> dict[str, np.ndarray]:
    """The columns that `grasps_of_columns` makes the same grasps of."""
    table = {name + STAGE: stage.qpos for name, stage in grasps.stages.items()}
    table |= {"obj_pose": grasps.object_pose, "obj_scale": grasps.object_scale}
    if (grasps.object_name != "").any():
        table["object_name"] = grasps.object_name
    table |= {name: column for name, column in grasps.columns.items() if name not in table}
    if grasps.joint_names is not None:
        table["joint_names"] = np.array(grasps.joint_names, dtype=str)
    return table


def joint_names(path: Path, value: Any) -> tuple[str, ...] | None:
    """Names of joints, each once; None where a file has none.

    Raises:
        FileError: They are no names, or one comes twice.
    """
    if value is None:
        return None
    array = text_array(path, "joint_names", value if len(np.shape(value)) else None)
    if array.ndim != 1:
        raise FileError(path, "joint_names", f"shape {array.shape}", "one name for each joint")
    names = tuple(array.tolist())
    for name, count in Counter(names).items():
        if count > 1:
            raise FileError(path, "joint_names", f"{name!r} twice", "each joint once")
    return names


def numbers(path: Path, field: str, value: object) -> np.ndarray:
    """An array of float64.

    Raises:
        FileError: It has anything but numbers.
    """
    if value is None:
        raise FileError(path, field, "nothing of this name", "numbers")
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
    else:
        try:
            array = np.array(value)
        except (ValueError, OverflowError) as error:
            raise FileError(path, field, "lists of different lengths", "numbers") from error
    if array.dtype.kind not in "fiu":
        raise FileError(path, field, f"{array.dtype} {array.shape}", "numbers")
    return array.astype(np.float64)


def poses(path: Path, field: str, value: object, count: int) -> np.ndarray:
    """Poses (N, 7) of one or of N; what a file does not have stands in the world's frame.

    Raises:
        FileError: They have another shape.
    """
    if value is None:
        return np.tile(STANDING, (count, 1))
    array = numbers(path, field, value)
    if array.shape not in ((_POSE,), (count, _POSE)):
        raise FileError(path, field, f"shape {array.shape}", f"({count}, 7): position and quaternion, w first")
    return np.array(np.broadcast_to(array, (count, _POSE)))


def per_grasp(path: Path, field: str, value: object, count: int) -> np.ndarray:
    """One number for each of N grasps, given once or N times.

    Raises:
        FileError: There are not as many.
    """
    array = numbers(path, field, value)
    if array.shape not in ((), (1,), (count,)):
        raise FileError(path, field, f"shape {array.shape}", f"({count},)")
    return np.array(np.broadcast_to(array, (count,)))


def texts(path: Path, field: str, value: object, count: int) -> np.ndarray:
    """One text for each of N grasps, given once or N times.

    Raises:
        FileError: There are not as many, or they are no text.
    """
    array = text_array(path, field, value)
    if array.shape not in ((), (1,), (count,)):
        raise FileError(path, field, f"shape {array.shape}", f"text ({count},)")
    return np.array(np.broadcast_to(array, (count,)))


def text_array(path: Path, field: str, value: Any) -> np.ndarray:
    """An array of text; every entry of it takes as much memory as the longest one.

    Raises:
        FileError: It is no text, or has long ones in it.
    """
    if isinstance(value, list | tuple) and all(isinstance(text, str) for text in value):
        _check_length(path, field, max(map(len, value), default=0))
    array: Any = np.asarray(value) if isinstance(value, str | np.ndarray | list | tuple) else np.empty(())
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    if array.dtype.kind != "U":
        raise FileError(path, field, f"{array.dtype} {array.shape}", "text")
    _check_length(path, field, array.dtype.itemsize // 4)
    return array


def _check_length(path: Path, field: str, length: int) -> None:
    if length > _LONGEST:
        raise FileError(path, field, f"text of {length:,} characters", f"at most {_LONGEST:,}")


def sources(path: Path, count: int) -> np.ndarray:
    """FILE:ROW of each of N grasps."""
    name = printable(path)
    return np.array([f"{name}:{row}" for row in range(count)])


def travelling(table: Mapping[str, object], count: int) -> dict[str, np.ndarray]:
    """Numbers, truth values and text that have something to say of each of N grasps; long text stays behind."""
    found = {}
    for name, value in table.items():
        if not isinstance(value, np.ndarray) or not value.ndim or len(value) != count:
            continue
        if value.dtype.kind == "S":
            value = np.char.decode(value, "utf-8", "replace")
        if value.dtype.kind in "biuf" or (value.dtype.kind == "U" and value.dtype.itemsize <= 4 * _LONGEST):
            found[name] = value.astype(value.dtype.newbyteorder("="), copy=False)
    return found


def _stage(path: Path, field: str, value: object, count: int, width: int, names: tuple[str, ...] | None) -> HandPoses:
    array = numbers(path, field, value)
    wanted = width if names is None else _POSE + len(names)
    if array.shape != (count, wanted) or wanted < _POSE:
        of = "joints" if names is None else f"{len(names)}"
        listed = f", then {', '.join(names)}" if names else ", then the joints"
        got = f"{np.asarray(value).dtype} {array.shape}"
        raise FileError(path, field, got, f"({count}, 7 + {of}): the pose of the base{listed}")
    return HandPoses(array[:, :_POSE], array[:, _POSE:])
