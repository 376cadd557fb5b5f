"""Starting `jaxgrasp` as its users do, in a folder with candidates and nothing else."""

from __future__ import annotations

import sys
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
