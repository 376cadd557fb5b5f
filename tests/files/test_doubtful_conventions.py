"""Files whose units or normals can hardly be meant get one warning with the likely remedy, and are ranked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from jaxgrasp.candidates import doubtful_conventions, read_candidates, sample_grasps
from jaxgrasp.cli import main

YCB = Path(__file__).resolve().parents[3] / "shared" / "data" / "ycb_allegro_grasps.npz"
GRASPS = sample_grasps(60, seed=2)
FRICTION = {"friction": 0.6, "max_force": 5.0}


def frames(normals: np.ndarray) -> np.ndarray:
    """Columns t1, t2, n."""
    t1 = np.cross(normals, [0.3, 0.5, 0.8])
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    return np.stack([t1, np.cross(normals, t1), normals], -1)


def doubts_of(tmp_path: Path, **changes) -> list[str]:
    fields = {"positions": GRASPS.positions, "outward_normals": GRASPS.normals, **FRICTION} | changes
    path = tmp_path / "grasps.npz"
    np.savez(path, **{name: value for name, value in fields.items() if value is not None})
    found = doubtful_conventions(read_candidates([path]))
    assert all(line.startswith(f"{path}: ") for line in found)
    return found


SIGNS = np.where(np.arange(60) % 2, 1, -1)[:, None, None]
FRAMES = frames(GRASPS.normals)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"outward_normals": -GRASPS.normals}, ["100% of the normals point into", "multiply outward_normals by -1"]),
        ({"outward_normals": SIGNS * GRASPS.normals}, ["50% of the normals point into"]),
        ({"outward_normals": None, "frames": frames(-GRASPS.normals)}, ["negative of column 3"]),
        ({"outward_normals": None, "frames": FRAMES.swapaxes(-1, -2)}, ["which is row 3"]),
        ({"outward_normals": None, "frames": np.roll(FRAMES, 1, -1)}, ["which is column 1"]),
        ({"positions": 1e3 * GRASPS.positions}, ["millimetres", "multiply by 0.001"]),
        ({"positions": 1e2 * GRASPS.positions}, ["centimetres", "multiply by 0.01"]),
        ({"positions": 1e-3 * GRASPS.positions}, ["wanted metres", "multiply by 1000"]),
        ({"positions": GRASPS.positions + [0, 2, 0]}, ["about the centre of mass"]),
        (
            {"positions": GRASPS.positions + [0.5, 0, 0], "center_of_mass": np.tile([0.5, 0, 0], (60, 1))},
            ["subtract the column center_of_mass"],
        ),
        ({"friction": 30.0}, ["friction is 30", "degrees, whose tangent is 0.577"]),
        ({"friction": np.where(SIGNS[:, 0] > 0, 60.0, 0.5)[:, 0]}, ["friction is 60", "per cent, multiply by 0.01"]),
    ],
)
def test_what_can_hardly_be_meant_is_told(tmp_path, changes, words):
    (line,) = doubts_of(tmp_path, **changes)
    assert all(word in line for word in words) and "\n" not in line


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"outward_normals": None, "frames": FRAMES},
        {"positions": 3 * GRASPS.positions},
        {"positions": 0.1 * GRASPS.positions},
        {"positions": GRASPS.positions + [0.0, 0.0, 0.1], "center_of_mass": np.tile([0, 0, 0.1], (60, 1))},
        {"positions": np.where(SIGNS > 0, GRASPS.positions, np.nan)},
        {"positions": GRASPS.positions[:, :1], "outward_normals": GRASPS.normals[:, :1]},
        {"positions": 0 * GRASPS.positions},
        {"active": np.zeros((60, 4), bool)},
        {"friction": 1.5},
    ],
)
def test_what_may_be_meant_is_left_alone(tmp_path, changes):
    assert doubts_of(tmp_path, **changes) == []


@pytest.mark.skipif(not YCB.exists(), reason="the collection of real grasps is not here")
def test_recorded_grasps_are_left_alone():
    candidates = read_candidates([YCB], max_force=5.0)
    assert doubtful_conventions(candidates) == []
    for name in np.unique(candidates.columns["object_name"]):
        assert doubtful_conventions(candidates.take(candidates.columns["object_name"] == name)) == []


@pytest.mark.parametrize("command", ["rank", "compare"])
def test_one_line_for_all_files(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    np.savez("good.npz", positions=GRASPS.positions, outward_normals=GRASPS.normals, **FRICTION)
    np.savez("mm.npz", positions=1e3 * GRASPS.positions, outward_normals=-GRASPS.normals, **FRICTION)
    options = ["--metric", "closure_residual", "--figure", "None", "--output", "table.csv"]
    assert main([command, "good.npz", "mm.npz", *options]) == 0
    warning = capsys.readouterr().err
    assert warning.count("\n") == 1 and warning.startswith("jaxgrasp: warning: mm.npz: positions")
    assert "millimetres" in warning and "by -1" in warning and "good.npz" not in warning
