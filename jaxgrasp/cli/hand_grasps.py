"""Grasps of files with a hand and an object of one's own: one scene a scale."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli.problems import CommandError

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.cli.scene import GivenScene
    from jaxgrasp.hands import HandObject, Scene

_STAGE = "grasp_qpos"
_POSE = 7


def candidates_of_grasps(
    options: "GivenScene", friction: float | None, max_force: float | None
) -> "tuple[Candidates, list[HandObject]]":
    """The candidates of all files of grasps, in their order, and the scenes that they are of.

    Raises:
        CommandError: A file or the scene cannot be used.
    """
    from jaxgrasp.candidates import concatenate
    from jaxgrasp.cli.report import counting_bar
    from jaxgrasp.ranking.configurations import candidates_of

    tables = [_table(path) for path in options.grasps]
    scales = [_scales(options, table) for table in tables]
    hands: list[HandObject] = []
    parts, order = [], []
    starts = np.cumsum([0, *map(len, scales)])
    assert options.object is not None
    with counting_bar("finding contacts", int(starts[-1])) as progress:
        done = 0
        for scale in np.unique(np.concatenate(scales)):
            built = options.built(options.object, float(scale), friction)
            chosen = []
            for path, table, own, start in zip(options.grasps, tables, scales, starts, strict=False):
                rows = np.flatnonzero(own == scale)
                if len(rows):
                    chosen.append((path, table, rows, start, _configurations(path, built, table)[rows]))
            hands.append(options.hand_of(built.model, None, max_force))
            for path, table, rows, start, qpos in chosen:
                columns = {name: x[rows] for name, x in table.items() if name not in ("joint_names", "obj_scale")}
                columns |= {"scene": np.full(len(rows), len(hands) - 1), "obj_scale": np.full(len(rows), scale)}
                parts.append(
                    candidates_of(
                        hands[-1],
                        qpos,
                        source=str(path),
                        limited=options.actuators,
                        columns=columns,
                        engine=options.engine,
                        index=rows,
                    )
                )
                order.append(start + rows)
                done += len(rows)
                progress(done)
    found = concatenate(parts)
    return found.take(np.argsort(np.concatenate(order))), hands


def _table(path: Path) -> dict[str, np.ndarray]:
    from jaxgrasp.candidates import CandidateError
    from jaxgrasp.storage import read_archive

    try:
        table = read_archive(path)
    except CandidateError as error:
        raise CommandError(str(error)) from error
    count = len(table[_STAGE]) if _STAGE in table and table[_STAGE].ndim else 0
    if not count:
        raise CommandError(f"{path}: got fields {', '.join(table) or 'none'}; wanted {_STAGE} (N, 7 + joints)")
    # What is the same for all grasps, or of another length, does not travel along.
    return {name: x for name, x in table.items() if name == "joint_names" or (x.ndim and len(x) == count)}


def _scales(options: "GivenScene", table: dict[str, np.ndarray]) -> np.ndarray:
    count = len(table[_STAGE])
    if options.scale is not None:
        return np.full(count, options.scale)
    given = table.get("obj_scale")
    if given is None or given.ndim != 1 or given.dtype.kind not in "fiu":
        return np.ones(count)
    return given.astype(float)


def _configurations(path: Path, built: "Scene", table: dict[str, np.ndarray]) -> np.ndarray:
    stage, names = table[_STAGE], table.get("joint_names")
    count = len(built.joint_names) if names is None else len(names)
    if stage.ndim != 2 or stage.shape[1] != _POSE + count or stage.dtype.kind not in "fiu":
        wanted = ", ".join(built.joint_names if names is None else map(str, names))
        raise CommandError(
            f"{path}: {_STAGE}: got {stage.dtype} {stage.shape}; wanted (N, {_POSE + count}): the pose of the base, "
            f"then {wanted}"
        )
    joints = stage[:, _POSE:] if names is None else dict(zip(map(str, names), stage[:, _POSE:].T, strict=True))
    try:
        return built.qpos(base=stage[:, :_POSE], joints=joints, object=table.get("obj_pose"))
    except ValueError as error:
        raise CommandError(f"{path}: {error}") from error
