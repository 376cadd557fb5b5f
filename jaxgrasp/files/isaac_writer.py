"""Writing isaac_grasp: one YAML file for each object and scale, with every digit of every number."""

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from jaxgrasp.files.frames import compose, invert, standing, unit
from jaxgrasp.files.grasp_set import GRASP, GraspSet
from jaxgrasp.files.isaac_grasp import JOINTS, NAME
from jaxgrasp.storage import atomic_write, made_folder, printable

ENDINGS = (".yaml", ".yml")
_HEAD = (f"format: {NAME}", "format_version: 1.0", "object_frame_link: object", "gripper_frame_link: world")
_CONFIDENCE = ("confidence", "succ_flag", "held")


def write(grasps: GraspSet, path: Path, progress: Callable[[int], None]) -> list[str]:
    """Writes grasps, whose poses become those of the hand file's world in the object's frame.

    Args:
        grasps: The grasps; joints without names are called `dof_0`, `dof_1`, ...
        path: A file of one of `ENDINGS`, or a folder, in which each object and scale has a file.
        progress: Called after each file with how many grasps are written.

    Returns:
        What this format cannot say.

    Raises:
        OSError: A file cannot be written.
    """
    lost = _lost(grasps)
    if grasps.joint_names is None:
        grasps = replace(grasps, joint_names=tuple(f"dof_{k}" for k in range(grasps.stages[GRASP].joints.shape[1])))
    rows: dict[tuple[str, float], list[int]] = {}
    for row, which in enumerate(zip(grasps.object_name.tolist(), grasps.object_scale.tolist(), strict=True)):
        rows.setdefault(which, []).append(row)
    if path.suffix in ENDINGS:
        _write_file(grasps, path, single=len(rows) == 1)
        progress(len(grasps))
        return [*lost, "that files have one object and scale (each grasp has its own)"] if len(rows) > 1 else lost
    done = 0
    with made_folder(path):
        for own, name in zip(rows.values(), _names(list(rows)), strict=True):
            _write_file(grasps.take(np.array(own)), path / name, single=True)
            done += len(own)
            progress(done)
    return lost


def _names(objects: list[tuple[str, float]]) -> list[str]:
    """A file name for each object and scale, no two alike."""
    scales = Counter(name for name, _ in objects)
    taken: Counter[str] = Counter()
    found = []
    for name, scale in objects:
        stem = re.sub(r"[^\w.-]", "_", PurePosixPath(name.replace("\\", "/")).stem)[:100].lstrip(".") or "object"
        base = f"{stem}_scale{scale:g}" if scales[name] > 1 else stem
        number = taken[base]
        taken[base] += 1
        found.append(f"{base}~{number}.yaml" if number else f"{base}.yaml")
    return found


def _write_file(grasps: GraspSet, path: Path, single: bool) -> None:
    base = grasps.stages[GRASP].base
    # As it was where the object stands in the world: a turn by nothing would still round.
    there = (grasps.object_pose == standing(1)).all(-1, keepdims=True)
    in_object = np.where(there, base, compose(invert(unit(grasps.object_pose)), unit(base)))
    with atomic_write(path) as stream:
        stream.write("\n".join([*_HEAD, *(_object(grasps, 0) if single else []), "grasps:\n"]).encode())
        for row in range(len(grasps)):
            own = [] if single else [f"    {line}" for line in _object(grasps, row)]
            stream.write(_entry(grasps, in_object[row], row, own).encode())


def _object(grasps: GraspSet, row: int) -> list[str]:
    name = str(grasps.object_name[row])
    lines = [f"object_file: {_quoted(name)}"] if name else []
    return [*lines, f"object_scale: {float(grasps.object_scale[row])!r}"]


def _entry(grasps: GraspSet, pose: np.ndarray, row: int, own: list[str]) -> str:
    names = grasps.joint_names or ()
    confidence = float(_confidence(grasps)[row])
    x, y, z, w, *turn = (_real(value) for value in pose)
    lines = [f"  grasp_{row}:", f"    confidence: {_real(confidence)}", f"    position: [{x}, {y}, {z}]"]
    lines[1:1] = own
    lines += [f"    orientation: {{w: {w}, xyz: [{', '.join(turn)}]}}"]
    for stage, field in JOINTS.items():
        if stage in grasps.stages:
            values = zip(names, grasps.stages[stage].joints[row], strict=True)
            lines += [f"    {field}:", *(f"      {_quoted(name)}: {_real(value)}" for name, value in values)]
    return "\n".join(lines) + "\n"


def _confidence(grasps: GraspSet) -> np.ndarray:
    """Of the file that the grasps came from; else whether they held where that is known."""
    for name in _CONFIDENCE:
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
    lost = [] if grasps.joint_names is not None else ["which joints these are (--hand has their names)"]
    lost += [f"the stage {name}" for name in grasps.stages if name not in JOINTS]
    if "pregrasp" in grasps.stages and (grasps.stages["pregrasp"].base != grasps.stages[GRASP].base).any():
        lost.append("where the base stands before the grasp")
    if (grasps.object_pose != standing(1)).any():
        lost.append("where the object stands in the world")
    lost += [f"the column {name}" for name in grasps.columns if name not in _CONFIDENCE]
    return lost
