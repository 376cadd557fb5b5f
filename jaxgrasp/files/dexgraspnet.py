"""DexGraspNet: `<object>.npy`, a pickled list of dicts with `qpos` by joint and `scale`.

`WRJTx`, `WRJTy`, `WRJTz` are the position, m, and `WRJRx`, `WRJRy`, `WRJRz` turns about the fixed axes x, y, z, rad, of
the hand's first link in the object's frame; the first link is the palm of its own MJCF, which stands in that file's
world. The object's file is normalised; `scale` makes metres of it. Files that were not validated have energies, too.
"""

import numpy as np

from jaxgrasp.files.columns import numbers, sources
from jaxgrasp.files.content import Content
from jaxgrasp.files.fields import checked_joints, part, single_stage, stacked
from jaxgrasp.files.frames import euler_xyz, standing
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet

NAME = "dexgraspnet"
_BASE = ("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz")
_ENERGIES = ("energy", "E_fc", "E_dis", "E_pen", "E_spen", "E_joints")


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    rows = content.data
    return content.kind == "objects" and isinstance(rows, list) and bool(rows) and _is_grasp(rows[0])


def read(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of an object.

    Raises:
        FileError: A field cannot be used, or grasps have other joints than the first one.
    """
    path = content.path
    rows = content.data if isinstance(content.data, list) else []
    tables = [part(path, row, "qpos", dict, f"grasp {k}: ") for k, row in enumerate(rows)]
    for name in _BASE:
        part(path, tables[0] if tables else {}, name, (int, float, np.generic), "grasp 0: qpos.")
    names = checked_joints(path, "qpos", [name for name in tables[0] if name not in _BASE])
    values = stacked(path, "qpos", tables, [*_BASE, *names])
    number = (int, float, np.generic)
    scales = [part(path, row, "scale", number, f"grasp {k}: ") for k, row in enumerate(rows)]
    poses = np.concatenate([values[:, :3], euler_xyz(values[:, 3:6])], -1)
    energies = [name for name in _ENERGIES if all(isinstance(row.get(name), number) for row in rows)]
    return GraspSet(
        stages=single_stage(given.base(path, poses), values[:, 6:]),
        joint_names=names,
        object_pose=standing(len(rows)),
        object_scale=numbers(path, "scale", scales),
        object_name=np.full(len(rows), path.stem),
        source=sources(path, len(rows)),
        columns={name: numbers(path, name, [row[name] for row in rows]) for name in energies},
    )


def _is_grasp(row: object) -> bool:
    return isinstance(row, dict) and isinstance(row.get("qpos"), dict) and "WRJTx" in row["qpos"]
