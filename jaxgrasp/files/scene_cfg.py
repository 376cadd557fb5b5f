"""The scene that BODex, Dexonomy and DexGraspBench's newer files name: which object, how large, and where.

A dict with `scene` ({name: {type, file_path, scale (3,), pose (7,)}}) and `task` ({obj_name}), in a pickle of its own
or inside the file of grasps.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from jaxgrasp.files.columns import numbers, text_array
from jaxgrasp.files.content import read_content
from jaxgrasp.files.fields import array, part
from jaxgrasp.files.grasp_set import STANDING
from jaxgrasp.storage import FileError, printable

# `scale006_pose000`: hundredths of the object's unit.
_SCALE = re.compile(r"(?:^|[/_])scale(\d{3})(?=[/_.]|$)")


@dataclass(frozen=True)
class Placed:
    """An object in a scene."""

    name: str
    """What the scene calls it."""
    pose: np.ndarray
    """(7,) in the world."""
    scale: float
    """Of its file's lengths; NaN where it is not said."""
    note: str = ""
    """What was assumed."""


def object_of(path: Path, scene: object, where: str = "scene_cfg") -> Placed:
    """The object that a scene's task is about.

    Raises:
        FileError: The scene does not say it.
    """
    things = part(path, scene, "scene", dict, f"{where}.")
    task = scene.get("task") if isinstance(scene, dict) else None
    name = task.get("obj_name") if isinstance(task, dict) else None
    rigid = [key for key, value in things.items() if isinstance(value, dict) and value.get("type") == "rigid_object"]
    if not isinstance(name, str):
        if len(rigid) != 1:
            raise FileError(path, f"{where}.task.obj_name", "no name", f"one of {', '.join(map(str, rigid))}")
        name = rigid[0]
    inside = f"{where}.scene.{name}."
    thing = part(path, things, name, dict, f"{where}.scene.")
    scale = uniform(path, f"{inside}scale", thing.get("scale", np.nan))
    return Placed(
        str(text_array(path, f"{where}.task.obj_name", name)), array(path, thing, "pose", (7,), inside), scale
    )


def uniform(path: Path, field: str, value: object) -> float:
    """One factor of lengths, also where it is given for each axis.

    Raises:
        FileError: The axes differ.
    """
    found = np.unique(numbers(path, field, value))
    if len(found) != 1:
        raise FileError(path, field, f"other factors along other axes ({value})", "one factor for all lengths")
    return float(found[0])


def object_at(path: Path, name: str) -> Placed | None:
    """The object of a scene that a file of grasps names by a path; None where it does not lie beside the grasps.

    It is looked for below the folders around the grasps alone, since the file may name any file at all.

    Raises:
        FileError: It is there, and cannot be used.
    """
    inner = PurePosixPath(name.replace("\\", "/"))
    if inner.is_absolute() or ".." in inner.parts or inner.suffix != ".npy":
        return None
    for folder in (Path.cwd(), *path.absolute().parents):
        there = folder / inner
        if there.is_file():
            return object_of(there, read_content(there).data, "scene")
    return None


def placed(path: Path, name: str) -> Placed:
    """The object of a scene that a file of grasps names by a path.

    Where the scene does not lie beside the grasps the object is taken to stand in the world's frame, with a note.

    Raises:
        FileError: It is there, and cannot be used.
    """
    found = object_at(path, name)
    if found is not None:
        return found
    told = object_called(name)
    note = f"{path}: scene_path: there is no {name} beside it; the object is taken to stand in the world's frame"
    return replace(told, note=printable(note))


def object_called(name: str) -> Placed:
    """What the path of a scene says by itself: the scale, and a pose in which the object stands in the world."""
    match = _SCALE.search(name)
    return Placed(name, np.array(STANDING), int(match.group(1)) / 100 if match else np.nan)
