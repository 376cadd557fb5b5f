"""DexGraspBench: a pickled dict of one grasp in an `.npy` file, its evaluation, or many of them stacked.

`grasp_qpos`, `pregrasp_qpos`, `squeeze_qpos` and others of this ending are the base's position and quaternion and the
joints in the order of the hand's MJCF; `obj_pose` is the object's pose, all in the world. The squeeze is extrapolated
there: twice the grasp less the pre-grasp.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxgrasp.files.columns import STAGE, columns_of_grasps, grasps_of_columns
from jaxgrasp.files.content import Content
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GRASP, GraspSet
from jaxgrasp.files.pickling import write_pickled
from jaxgrasp.files.scene_cfg import placed
from jaxgrasp.storage import FileError, made_folder

NAME = "dexgraspbench"
_GRASP = GRASP + STAGE
# What one grasp has as an array of its own, while its other arrays are about it.
_SCALAR = (bool, int, float, str, np.generic)


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind == "objects" and _GRASP in content.table


def read(content: Content, given: Given) -> GraspSet:
    """Reads one grasp, or stacked ones.

    Raises:
        FileError: A field cannot be used.
    """
    grasp: Any = content.table.get(_GRASP)
    if not isinstance(grasp, np.ndarray) or grasp.ndim not in (1, 2):
        got = f"shape {grasp.shape}" if isinstance(grasp, np.ndarray) else type(grasp).__name__
        raise FileError(content.path, _GRASP, got, "an array (7 + joints,) or (N, 7 + joints)")
    table = dict(content.table)
    name = table.pop("obj_path", "")
    if grasp.ndim == 1:
        table = {field: one_row(value) for field, value in table.items()}
    note = ""
    if "obj_pose" not in table:
        # Newer files name a scene in its place.
        scene = content.table.get("scene_path")
        if not isinstance(scene, str):
            raise FileError(content.path, "obj_pose", "neither it nor a scene_path", "where the object stands")
        thing = placed(content.path, scene)
        note, name = thing.note, name or thing.name
        table = {"obj_scale": thing.scale} | table | {"obj_pose": thing.pose}
    table["object_name"] = name if isinstance(name, str) else np.asarray(name)
    table.setdefault("obj_scale", np.nan)
    return replace(grasps_of_columns(content.path, table), notes=(note,) if note else ())


def one_row(value: object) -> object:
    """What is said of one grasp, as an array with one row; what is neither number nor text stays as it is."""
    if isinstance(value, np.ndarray):
        return value[None]
    return np.array([value]) if isinstance(value, _SCALAR) else value


def write(grasps: GraspSet, folder: Path, progress: Callable[[int], None]) -> list[str]:
    """Writes one file a grasp into a folder: `0.npy`, `1.npy` ..., with as many digits as the last one needs.

    Args:
        grasps: The grasps.
        folder: It is made where it is not there.
        progress: Called after each file with how many are written.

    Returns:
        What this format cannot say.

    Raises:
        OSError: A file cannot be written.
    """
    table = columns_of_grasps(grasps)
    names = table.pop("joint_names", None)
    paths = table.pop("object_name", np.full(len(grasps), ""))
    # Whoever reads by name can; others take the order for that of the hand's file.
    same = {} if names is None else {"joint_names": names.tolist()}
    digits = len(str(max(0, len(grasps) - 1)))
    with made_folder(folder):
        for row in range(len(grasps)):
            one = {name: _as_stored(name, column[row]) for name, column in table.items()}
            one |= same | {"obj_path": str(paths[row])}
            write_pickled(folder / f"{row:0{digits}}.npy", one, more_follow=row + 1 < len(grasps))
            progress(row + 1)
    return [] if names is None else ["that joints are in another order than in the hand's file (--hand turns them)"]


def _as_stored(name: str, value: np.ndarray | np.generic) -> object:
    if name.endswith(STAGE):
        return np.asarray(value, np.float32)
    if isinstance(value, np.ndarray):
        return np.array(value)
    return str(value) if isinstance(value, np.str_) else value
