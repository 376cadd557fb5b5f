"""Starting `jaxgrasp` as its users do, in a folder with candidates, grasps of a hand, and what else commands read."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

# As the script that pip installs does.
PROGRAM = [sys.executable, "-c", "import sys\nfrom jaxgrasp.cli import program\nsys.exit(program())"]
GRASPS, OF_HAND, ERRORS, HIVE = "grasps.npz", "hands.npz", "errors.json", "hive"
# A run that was interrupted, and its copy for the command that goes on with it.
BEGUN, RESUMED = "begun", "resumed"
_INPUTS = (GRASPS, OF_HAND, ERRORS, HIVE, BEGUN)
# Of the four fingers around a ball of 5 cm.
_BENT, _SQUEEZED, _BALL = (0.0, -0.165, 1.124), (0.0, 0.1, 0.1), (0.0, 0.0, 0.085)
ON_HAND = ["--hand", "four_fingers", "--object", "sphere", "--grasps", OF_HAND]


def write_grasps(folder: Path, count: int, **columns: Any) -> None:
    from jaxgrasp.candidates import sample_grasps

    grasps = sample_grasps(count)
    np.savez(
        folder / GRASPS,
        positions=grasps.positions,
        outward_normals=grasps.normals,
        friction=grasps.friction,
        max_force=grasps.max_force,
        **columns,
    )


def write_hand_grasps(folder: Path, count: int) -> None:
    """Writes grasps that squeeze a ball, each one a little differently."""
    joints = np.tile(_BENT, 4) + np.random.default_rng(0).normal(scale=0.003, size=(count, 12))
    base = np.tile([0.0, 0, 0, 1, 0, 0, 0], (count, 1))
    np.savez(
        folder / OF_HAND,
        grasp_qpos=np.concatenate([base, joints], -1),
        squeeze_qpos=np.concatenate([base, joints + np.tile(_SQUEEZED, 4)], -1),
        obj_pose=np.tile([*_BALL, 1.0, 0, 0, 0], (count, 1)),
        obj_scale=np.full(count, 0.05),
        object_name=np.full(count, "ball"),
    )


def write_runs(folder: Path, part_size: int) -> None:
    """Writes distributions, a dataset of one file, and a run of it that lacks most of its parts."""
    (folder / ERRORS).write_text('{"friction": {"std": 0.1, "correlation": 1.0}, "position": 0.002}\n')
    (folder / HIVE / "object=ball").mkdir(parents=True)
    shutil.copy(folder / GRASPS, folder / HIVE / "object=ball" / GRASPS)
    command = [*PROGRAM, "rank", HIVE, "--run", BEGUN, "--part-size", str(part_size)]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    for path in (folder / BEGUN).rglob("*"):
        if path.is_file() and path.name != "manifest.json" and "-000000" not in path.name:
            path.unlink()


def made(folder: Path) -> list[Path]:
    """List the folders and files that commands have written."""
    return [path for path in folder.rglob("*") if path.relative_to(folder).parts[0] not in _INPUTS]


def prepare(folder: Path, arguments: list[str]) -> None:
    """Removes what commands have written, and copies the run that this one goes on with."""
    for path in folder.iterdir():
        if path.name in _INPUTS:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    if RESUMED in arguments:
        shutil.copytree(folder / BEGUN, folder / RESUMED)


def unsolved(candidates: Any, *_: Any, progress: Callable[[int], None] = lambda _: None, **__: Any) -> Any:
    """A ranking of candidates in the order that they have, in place of one that takes a compilation."""
    from jaxgrasp.ranking import Ranking

    progress(len(candidates))
    count, none = len(candidates), np.zeros((0, candidates.num_contacts, 3))
    return Ranking(
        candidates=candidates,
        margin=np.ones(count),
        upper_bound=np.ones(count),
        status=np.zeros(count, int),
        order=np.arange(count),
        share=0.75,
        forces=none,
        object_forces=none,
        effort=np.zeros(0),
        tightening_status=np.zeros(0, int),
        controls=np.zeros((0, 0)),
    )


def leave_out_computation() -> None:
    """Makes this process rank nothing, in one table and part by part."""
    import jaxgrasp.cli.uncertain
    import jaxgrasp.ranking
    import jaxgrasp.ranking.streams.run
    import jaxgrasp.ranking.streams.scored

    jaxgrasp.ranking.rank = unsolved
    jaxgrasp.ranking.uncertain_scores = _certain
    jaxgrasp.ranking.streams.run.scored = _unscored
    jaxgrasp.ranking.streams.scored.tighten = _untightened


def _certain(candidates: Any, uncertain: Any, *_: Any, **__: Any) -> Any:
    import jax
    import jax.numpy as jnp

    from jaxgrasp.uncertainty.draws import draw

    # Here distributions prove to be those of such candidates, or not.
    given = uncertain.uncertainty
    draws = lambda seed: draw(given, candidates.num_contacts, given.sample_count() or 10, seed, jnp.dtype(float))
    jax.eval_shape(draws, jnp.uint32(0))
    return {name: np.ones(len(candidates)) for name in uncertain.names}


def _unscored(candidates: Any, travelling: Any, setting: Any, **_: Any) -> Any:
    from jaxgrasp.ranking.streams.scored import Scored

    count = len(candidates)
    return Scored(
        candidates=candidates,
        travelling=travelling,
        margin=np.ones(count),
        upper_bound=np.ones(count),
        status=np.zeros(count, int),
        metrics={name: np.ones(count) for name in setting.columns},
    )


def _untightened(candidates: Any, margin: np.ndarray, *_: Any, metrics: Any, **__: Any) -> Any:
    count, none = len(margin), np.zeros((len(margin), candidates.num_contacts, 3))
    found = replace(unsolved(candidates), forces=none, object_forces=none, effort=np.zeros(count))
    return replace(found, tightening_status=np.zeros(count, int), controls=np.zeros((count, 0)), metrics=metrics)
