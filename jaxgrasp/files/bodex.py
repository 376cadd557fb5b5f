"""BODex: `robot_pose` (1, N, 3, 7 + n), pre-grasp, grasp and squeeze of each seed, in the order of `joint_names`.

The pose is that of the first link of its own URDF. DexGraspBench's MJCF files of the same hands have the link elsewhere
in their worlds: where a hand is given its file says where, otherwise the table below, which is that of the three hands
that come with BODex. Object and scale are in a scene that `scene_path` names, or in older files beside the poses.
"""

import numpy as np

from jaxgrasp.files.columns import joint_names, numbers, per_grasp, sources, text_array, travelling
from jaxgrasp.files.columns import poses as poses_of
from jaxgrasp.files.content import Content
from jaxgrasp.files.frames import compose, invert, unit
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet, HandPoses
from jaxgrasp.files.scene_cfg import Placed, placed
from jaxgrasp.storage import FileError

NAME = "bodex"
_STAGES = ("pregrasp", "grasp", "squeeze")
_HALF = np.sqrt(0.5)
# Where the first link stands in the world of DexGraspBench's file of the hand.
_ROOTS = {
    "shadow": (0.0, 0.0, 0.034, 1.0, 0.0, 0.0, 0.0),
    "allegro": (0.0, 0.0, 0.0, 0.0, _HALF, 0.0, _HALF),
    "leap": (0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0),
}


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind == "objects" and "robot_pose" in content.table


def read(content: Content, given: Given) -> GraspSet:
    """Reads the seeds of all scenes in a file.

    Raises:
        FileError: A field cannot be used, or nobody says where the hand's first link stands.
    """
    path, table = content.path, content.table
    poses = numbers(path, "robot_pose", table.get("robot_pose"))
    names = joint_names(path, table.get("joint_names"))
    if names is None:
        raise FileError(path, "joint_names", "nothing", "the joints in the order of robot_pose")
    if poses.ndim != 4 or poses.shape[2] < 3 or poses.shape[3] != 7 + len(names) or not poses.size:
        wanted = f"(1, N, 3, {7 + len(names)}): a free base and {', '.join(names)}"
        raise FileError(path, "robot_pose", f"shape {poses.shape}", f"{wanted} (files with an arm are not read)")
    scenes, seeds = poses.shape[:2]
    poses = poses.reshape(scenes * seeds, *poses.shape[2:])
    stages = {}
    for number, stage in enumerate(_STAGES):
        base = _base(content, given, poses[:, number, :7])
        stages[stage] = HandPoses(base, poses[:, number, 7:])
    things = _objects(content, scenes)
    others = {name: _by_seed(value, scenes, seeds) for name, value in table.items() if name != "robot_pose"}
    return GraspSet(
        stages=stages,
        joint_names=names,
        object_pose=np.repeat([each.pose for each in things], seeds, 0),
        object_scale=np.repeat([each.scale for each in things], seeds),
        object_name=np.repeat([each.name for each in things], seeds),
        source=sources(path, len(poses)),
        columns=travelling(others, len(poses)),
        notes=tuple(each.note for each in things if each.note),
    )


def _base(content: Content, given: Given, poses: np.ndarray) -> np.ndarray:
    if given.hand is not None:
        return given.base(content.path, poses)
    hand = str(content.table.get("manip_name", "")).lower()
    root = next((root for name, root in _ROOTS.items() if name in hand), None)
    if root is None:
        got = f"poses of the first link of {hand or 'a hand without a name'}"
        raise FileError(content.path, "robot_pose", got, "the hand, whose file says where that stands: --hand")
    return compose(unit(poses), invert(np.array(root)))


def _objects(content: Content, scenes: int) -> list[Placed]:
    """The object of each scene: where older files say it themselves that is so, otherwise as its scene says."""
    path, table = content.path, content.table
    if not ("obj_pose" in table and "obj_scale" in table):
        return [placed(path, name) for name in _scenes(content, scenes)]
    pose = poses_of(path, "obj_pose", table["obj_pose"], scenes)
    scale = per_grasp(path, "obj_scale", table["obj_scale"], scenes)
    names = _scenes(content, scenes) if "scene_path" in table else [path.parent.name] * scenes
    return [Placed(names[k], pose[k], float(scale[k])) for k in range(scenes)]


def _scenes(content: Content, count: int) -> list[str]:
    given = content.table.get("scene_path")
    names = [given] if isinstance(given, str) else list(given) if isinstance(given, list | tuple | np.ndarray) else []
    names = names * count if len(names) == 1 else names
    if len(names) != count or not all(isinstance(name, str) for name in names):
        raise FileError(content.path, "scene_path", f"{len(names)} of {count} scenes", "the path of each")
    return text_array(content.path, "scene_path", list(map(str, names))).tolist()


def _by_seed(value: object, scenes: int, seeds: int) -> object:
    """A field of each seed of each scene, with one axis for both; others as they are."""
    if isinstance(value, np.ndarray) and value.shape[:2] == (scenes, seeds):
        return value.reshape(scenes * seeds, *value.shape[2:])
    return value
