"""Times a ranking of grasp files, from command to table: `python -m benchmarks.scene_speed HAND FOLDER`.

FOLDER has an object's convex `pieces` and `grasps.npz`, in the layout of DexGraspBench. `jaxgrasp rank` is run as a
command of its own: first with nothing on disk, then again with programs and kernels there, then with 10,000
configurations (the file's, each moved a little), twice; with the scene's actuators and without. The rate is of what the
10,000 take longer than the file's own. Beside the seconds are those of all processors together, which hardly depend on
what else the machine does. Writes scene_speed.md beside this file.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.suite.clock import warn_if_busy

COUNT = 10_000
TRIAL = ["--mass", "0.1", "--friction", "0.6", "--gravity-vector", "0", "0", "0"]
# Of base and joints, m and rad.
MOVED = (5e-4, 1e-2)


def many(path: Path, out: Path) -> None:
    """Writes COUNT configurations, each one of the file's, moved a little."""
    with np.load(path) as given:
        rows = np.arange(COUNT) % len(given["grasp_qpos"])
        table = {name: given[name][rows] for name in ("grasp_qpos", "obj_pose", "obj_scale")}
    rng, qpos = np.random.default_rng(0), table["grasp_qpos"].astype(float)
    qpos[:, :3] += MOVED[0] * rng.normal(size=(COUNT, 3))
    qpos[:, 7:] += MOVED[1] * rng.normal(size=qpos[:, 7:].shape)
    np.savez(out, **table | {"grasp_qpos": qpos})


def ranked(hand: Path, folder: Path, grasps: Path, cache: Path, actuators: str) -> tuple[float, float, float]:
    """Seconds that the command takes, those of processors, and its peak of memory, GiB."""
    command = [sys.executable, "-m", "jaxgrasp.cli", "rank", "--hand", str(hand), "--object", str(folder / "pieces")]
    command += [*TRIAL, "--grasps", str(grasps), "--output", str(cache / "ranking.parquet"), "--figure", "None"]
    start = time.perf_counter()
    child = subprocess.Popen(
        [*command, actuators],
        env=os.environ | {"XDG_CACHE_HOME": str(cache)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=cache,
    )
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"rank ended with {status}")
    unit = 2**30 if sys.platform == "darwin" else 2**20
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / unit


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("hand", type=Path)
    options.add_argument("folder", type=Path)
    given = options.parse_args()
    hand, folder = given.hand.resolve(), given.folder.resolve()
    busy = warn_if_busy()
    lines = [
        "# From files of grasps to a ranking",
        "",
        f"Object {folder.name} of {len(list((folder / 'pieces').iterdir()))} pieces; {platform.machine()}, "
        f"{os.cpu_count()} cores, load {busy:.1f}. Made by `python -m benchmarks.scene_speed HAND FOLDER`.",
        "",
        "Seconds, and in brackets those of all processors.",
        "",
        f"| | nothing on disk | programs on disk | {COUNT:,} more, first | again | a second | peak, GiB |",
        "|---|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as name:
        out = Path(name, "many.npz")
        many(folder / "grasps.npz", out)
        for actuators in ("--no-actuators", "--actuators"):
            cache = Path(name, actuators)
            cache.mkdir()
            runs = [
                ranked(hand, folder, grasps, cache, actuators) for grasps in 2 * [folder / "grasps.npz"] + 2 * [out]
            ]
            seconds, busy_seconds, peaks = zip(*runs, strict=True)
            cells = " | ".join(f"{x:.1f} ({y:.1f})" for x, y in zip(seconds, busy_seconds, strict=True))
            _, warm, _, again = seconds
            lines.append(f"| `{actuators}` | {cells} | {COUNT / (again - warm):,.0f} | {max(peaks):.2f} |")
            print(lines[-1], flush=True)
    Path(__file__).with_suffix(".md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
