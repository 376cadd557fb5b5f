"""A hand-vectorised C++ solver of the same programs, where its source lies beside the repository: the floor."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.suite.problems import EDGES, FRICTION, MAX_FORCE, Grasps, Programs

SOURCE = Path(__file__).resolve().parents[2].parent / "shared" / "prototypes"
ITERATIONS = 10
THREADS = 2


def build() -> ctypes.CDLL | str:
    """The library, or why there is none."""
    script = SOURCE / "build_floor.sh"
    if not script.is_file():
        return "its source is not beside the repository"
    if shutil.which("g++") is None:
        return "there is no g++"
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "libfloor.so"
        made = subprocess.run(
            ["sh", script, library], env={**os.environ, "PYTHON": sys.executable}, capture_output=True
        )
        if made.returncode != 0:
            return "it does not build"
        return ctypes.CDLL(str(library))


class Floor:
    """One program a SIMD lane, a fixed number of iterations, no bounds and no status; four contacts of eight edges."""

    def __init__(self, library: ctypes.CDLL, grasps: Grasps, batch: Programs, dtype: str) -> None:
        # Its facet normals stand where our edges do: turn the tangents by half an edge, and the pyramids are the same.
        c, s = np.cos(np.pi / EDGES), np.sin(np.pi / EDGES)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        arrays = (grasps.columns() @ turn, batch.S_1, batch.S_2, np.zeros((len(batch), 6)))
        self._inputs = [np.ascontiguousarray(x, dtype) for x in arrays]
        self.margin = np.zeros(len(batch), dtype)
        self._forces = np.zeros((len(batch), 4, 3), dtype)
        solve = getattr(library, "floor_bf_" + {"float32": "f32", "float64": "f64"}[dtype])
        solve.argtypes = (
            [ctypes.c_void_p] * 6 + [ctypes.c_int64, ctypes.c_int] + [ctypes.c_double] * 3 + [ctypes.c_int] * 2
        )
        solve.restype = None
        self._solve = solve

    def run(self) -> None:
        pointers = [x.ctypes.data for x in (*self._inputs, self.margin, self._forces)]
        self._solve(*pointers, len(self.margin), ITERATIONS, MAX_FORCE, FRICTION, 0.0, 0, THREADS)
