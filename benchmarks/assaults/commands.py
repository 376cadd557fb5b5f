"""Starting `jaxgrasp` as its users do, in a folder with candidates and nothing else."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# As the script that pip installs does.
PROGRAM = [sys.executable, "-c", "import sys\nfrom jaxgrasp.cli import program\nsys.exit(program())"]
GRASPS = "grasps.npz"


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


def made(folder: Path) -> list[Path]:
    """What commands have written."""
    return [path for path in folder.iterdir() if path.name != GRASPS]


def empty(folder: Path) -> None:
    """Removes what commands have written."""
    for path in made(folder):
        path.unlink()


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
