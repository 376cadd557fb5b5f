"""Which object each grasp is of, and in which scale: grasps that share a scene, and their configurations in it."""

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.files.grasp_set import GRASP, GraspSet
from jaxgrasp.hands import Scene
from jaxgrasp.storage import FileError

# Folders and files of these names hold the parts of the object that the folder above is named after.
_PARTS = ("pieces", "mesh", "meshes")
_MESHES = (".obj", ".stl", ".msh", ".xml", ".mjcf", ".urdf")


class Group(NamedTuple):
    """Grasps of one object in one scale."""

    object: str
    """As `Scene.build` takes it."""
    name: str
    """What it is called."""
    scale: float
    rows: Int[np.ndarray, " group"]
    """Which grasps of the set."""


def name_of_object(object: str | PathLike) -> str:
    """What an object is called: its folder or file, and where that is named `pieces` or `mesh`, the folder above."""
    path = Path(object)
    name = path.stem if path.suffix.lower() in _MESHES else path.name
    return Path(path.absolute()).parent.name if name in _PARTS else name


def grouped(grasps: GraspSet, objects: str | PathLike | Sequence[str | PathLike]) -> Iterator[Group]:
    """Grasps that share a scene, in the order in which scenes come up.

    Args:
        grasps: The grasps; their scales are known.
        objects: One that all grasps are of, or several, of which each grasp is of the one that bears the name of its
            object, of its file, or of the folder of its file.

    Raises:
        FileError: A grasp is of none of the objects.
        ValueError: Two objects have the same name.
    """
    given = [objects] if isinstance(objects, str | PathLike) else list(objects)
    names = [name_of_object(each) for each in given]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"object: got two that are called {name!r}; wanted different names")
    chosen = np.zeros(len(grasps), int)
    if len(given) > 1:
        chosen = np.array([_chosen(grasps, row, names) for row in range(len(grasps))])
    rows: dict[tuple[int, float], list[int]] = {}
    for row, key in enumerate(zip(chosen.tolist(), grasps.object_scale.tolist(), strict=True)):
        rows.setdefault(key, []).append(row)
    for (number, scale), own in rows.items():
        yield Group(str(given[number]), names[number], scale, np.array(own))


def configurations(scene: Scene, grasps: GraspSet, stage: str = GRASP) -> Float[np.ndarray, "batch nq"]:
    """Configurations of a scene: a stage of grasps, and where their object is.

    Args:
        scene: Of the grasps' hand, and of their object in their scale.
        grasps: The grasps.
        stage: Which of their stages.

    Raises:
        FileError: The hand has other joints.
    """
    own = grasps.for_hand(scene.joint_names)
    try:
        return scene.qpos(base=own.stages[stage].base, joints=own.joints_by_name(stage), object=own.object_pose)
    except ValueError as error:
        file = grasps.source[0].rpartition(":")[0]
        raise FileError(file, stage, " ".join(str(error).split()), "configurations of the hand") from error


def _chosen(grasps: GraspSet, row: int, names: Sequence[str]) -> int:
    file = Path(grasps.source[row].rpartition(":")[0])
    own = str(grasps.object_name[row])
    for name in (own, name_of_object(own) if own else "", file.stem, file.absolute().parent.name):
        if name in names:
            return names.index(name)
    raise FileError(file, "object_name", repr(own) if own else "none", f"one of {', '.join(names)}")
