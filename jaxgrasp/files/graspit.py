"""GraspIt! worlds: XML with one object and one robot, where they stand in mm, and values of the robot's drives.

`fullTransform` is `(w x y z)[x y z]`, of the robot's first link and of the object, in the world. `dofValues` has a
value for each drive, after which some robots have a number more for the drive's state: with a hand, whose file says how
many joints there are, these are told apart. The object's file is in mm as a rule, and its scale is not said.
"""

import re
from pathlib import Path

import numpy as np

from jaxgrasp.files.columns import sources
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import single_stage
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.storage import FileError, printable

NAME = "graspit"
_MILLIMETRE = 1e-3
_REAL = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_BLANK = r"[\s,]+"
_TRANSFORM = re.compile(
    rf"\(\s*({_REAL}){_BLANK}({_REAL}){_BLANK}({_REAL}){_BLANK}({_REAL})\s*\)\s*"
    rf"\[\s*({_REAL}){_BLANK}({_REAL}){_BLANK}({_REAL})\s*\]"
)
_LONGEST = 10_000


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    data = content.data
    return content.kind == "xml" and isinstance(data, list) and bool(data) and data[-1][0] == "world"


def read(content: Content, given: Given) -> GraspSet:
    """Reads the grasp of a world.

    Raises:
        FileError: There is not one object and one robot, or a field cannot be used.
    """
    path, data = content.path, content.data if isinstance(content.data, list) else []
    texts: dict[str, list[str]] = {}
    for name, text in data:
        texts.setdefault(name, []).append(text)

    def one(name: str) -> str:
        found = texts.get(f"world/{name}", [])
        if len(found) != 1:
            raise FileError(path, name, f"{len(found)} of them", "one (worlds of one object and one robot)")
        return found[0]

    joints = _joints(path, one("robot/dofValues"))
    names = given.names_in_order()
    if names is not None:
        joints = _without_states(path, joints, names)
    base = _pose(path, "robot/transform/fullTransform", one("robot/transform/fullTransform"))
    return GraspSet(
        stages=single_stage(given.base(path, base), joints),
        joint_names=names or tuple(f"dof_{k}" for k in range(joints.shape[1])),
        object_pose=_pose(path, "graspableBody/transform/fullTransform", one("graspableBody/transform/fullTransform")),
        object_scale=np.array([np.nan]),
        object_name=np.array([printable(one("graspableBody/filename"))]),
        source=sources(path, 1),
        columns={"robot": np.array([printable(one("robot/filename"))])},
    )


def _pose(path: Path, field: str, text: str) -> np.ndarray:
    match = _TRANSFORM.fullmatch(text.strip()) if len(text) < _LONGEST else None
    if match is None:
        raise FileError(path, field, f"{text[:80]!r}", "(w x y z)[x y z], mm")
    w, x, y, z, *position = map(float, match.groups())
    return np.array([[*(_MILLIMETRE * value for value in position), w, x, y, z]])


def _joints(path: Path, text: str) -> np.ndarray:
    try:
        values = [float(word) for word in text[:_LONGEST].split()]
    except ValueError as error:
        raise FileError(path, "robot/dofValues", f"{text[:80]!r}", "numbers") from error
    if not values:
        raise FileError(path, "robot/dofValues", "nothing", "a value of each drive")
    return np.array([values])


def _without_states(path: Path, values: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    count = values.shape[1]
    if count == len(names):
        return values
    if count == 2 * len(names):
        return values[:, ::2]
    wanted = f"{len(names)}, or twice as many with states: {', '.join(names)}"
    raise FileError(path, "robot/dofValues", f"{count} values", wanted)
