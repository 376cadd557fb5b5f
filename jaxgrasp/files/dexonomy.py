"""Dexonomy, of today and of before: a pickled dict of one grasp.

`grasp_qpos` (1, 7 + n), `squeeze_qpos` (1, 7 + n) and `pregrasp_qpos` (K, 7 + n), a way that begins most open; the
pre-grasp is its first row, and the whole of it travels along as `pregrasp_path`. Joints are in the order of the MJCF.
Contacts (`obj_cpn_w` (n, 6) and others) travel along. Older files have a scene inside.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from jaxgrasp.files.columns import STAGE, grasps_of_columns, poses
from jaxgrasp.files.content import Content
from jaxgrasp.files.dexgraspbench import one_row
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GRASP, GraspSet
from jaxgrasp.files.scene_cfg import object_called, object_of, placed, uniform
from jaxgrasp.storage import FileError

NAME = "dexonomy"
_OWN = {"tmpl_name", "hand_name", "obj_cpn_w", "hand_template_name", "evolution_num", "obj_worldframe_contacts"}


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind == "objects" and GRASP + STAGE in content.table and not _OWN.isdisjoint(content.table)


def read(content: Content, given: Given) -> GraspSet:
    """Reads the grasp of a file.

    Raises:
        FileError: A field cannot be used.
    """
    path, table = content.path, content.table
    stages = {}
    for name in (GRASP, "pregrasp", "squeeze"):
        field = name + STAGE
        if name != GRASP and field not in table:
            continue
        rows: Any = table.get(field)
        rows = rows[None] if isinstance(rows, np.ndarray) and rows.ndim == 1 else rows
        if not isinstance(rows, np.ndarray) or rows.ndim != 2 or not len(rows):
            raise FileError(path, field, f"shape {np.shape(rows)}", "(K, 7 + joints)")
        stages[field] = rows
    if len(stages[GRASP + STAGE]) != 1:
        raise FileError(path, GRASP + STAGE, f"{len(stages[GRASP + STAGE])} grasps", "one grasp a file")
    columns = {field: rows[:1] for field, rows in stages.items()}
    if len(stages.get("pregrasp_qpos", "1")) > 1:
        columns["pregrasp_path"] = stages["pregrasp_qpos"][None]
    columns |= {f: one_row(x) for f, x in table.items() if f not in stages and not f.startswith("obj_pose")}
    thing, note = _of_object(content)
    return replace(grasps_of_columns(path, columns | thing), notes=(note,) if note else ())


def _of_object(content: Content) -> tuple[dict[str, object], str]:
    """Pose, scale and name of the object, by the file's own fields before those of the scene, and what was assumed."""
    path, table = content.path, content.table
    named, own = table.get("scene_path"), "obj_pose" in table and "obj_scale" in table
    thing = None
    if "scene_cfg" in table:
        thing = object_of(path, table["scene_cfg"])
    elif isinstance(named, str):
        thing = object_called(named) if own else placed(path, named)
    elif not own:
        raise FileError(path, "obj_pose or obj_scale", "neither them nor a scene", "where the object stands")
    found: dict[str, object] = {"obj_pose": thing.pose, "obj_scale": thing.scale} if thing else {}
    if "obj_pose" in table:
        found["obj_pose"] = poses(path, "obj_pose", table["obj_pose"], 1)
    if "obj_scale" in table:
        found["obj_scale"] = uniform(path, "obj_scale", table["obj_scale"])
    return found | {"object_name": thing.name if thing else path.stem}, thing.note if thing else ""
