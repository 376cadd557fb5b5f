"""kill -9 at random moments of a ranking in parts, and on with --resume: every candidate once, as if nothing had been.

python -m benchmarks.assaults.resumed [--kills 100] [--rows 40000] [--seed 0]
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet

from jaxgrasp.candidates import sample_grasps

FILES, PARTS = 4, 40
COMMAND = [sys.executable, "-m", "jaxgrasp.cli", "rank", "--figure", "None", "--top", "100"]


def killed(home: Path, kills: int, rows: int, seed: int) -> dict[str, int]:
    """Kill runs at random moments; count kills that found one at work, runs, and states of the folder."""
    for number in range(FILES):
        grasps = sample_grasps(rows // FILES, seed=number)
        fields = {name: getattr(grasps, name) for name in ("positions", "outward_normals", "friction", "max_force")}
        np.savez(home / f"{number}.npz", **fields, name=np.array([f"{number}-{row}" for row in range(rows // FILES)]))
    options = [f"{number}.npz" for number in range(FILES)] + ["--part-size", str(rows // PARTS), "--run"]
    run = lambda *rest: subprocess.run([*COMMAND, *rest], cwd=home, check=True, capture_output=True)
    run(*options, "first")
    begin = time.monotonic()
    run(*options, "whole")
    took = time.monotonic() - begin
    draw, seen, done, runs, number = random.Random(seed), set(), 0, 0, 0
    while done < kills:
        # A run that is through, or was killed before it began, makes room for another one.
        folder, number = f"run-{number}", number + 1
        arguments = [*options, folder]
        while done < kills:
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            process = subprocess.Popen([*COMMAND, *arguments], cwd=home, **quiet)
            time.sleep(draw.uniform(0.0, took))
            process.send_signal(signal.SIGKILL)
            process.wait()
            parts = len(list((home / folder).glob("parts/part-*.parquet")))
            if process.returncode == -signal.SIGKILL:
                done += 1
                seen.add((parts, (home / folder / "top.parquet").exists()))
            if (home / folder / "manifest.json").exists():
                arguments = ["--resume", folder]
            if process.returncode == 0 or parts == PARTS:
                break
        run(*arguments)
        runs += 1
        _compare(home / folder, home / "whole", rows)
    return {"kills": done, "runs that were ended by --resume": runs, "states that kills left": len(seen)}


def _compare(folder: Path, whole: Path, rows: int) -> None:
    found, wanted = (pyarrow.parquet.read_table(each / "parts") for each in (folder, whole))
    names = found["name"].to_pylist()
    assert len(names) == len(set(names)) == rows, "a candidate is missing, or there twice"
    assert found.equals(wanted), "other rows than those of an uninterrupted run"
    tops = [pyarrow.parquet.read_table(each / "top.parquet") for each in (folder, whole)]
    assert tops[0].equals(tops[1]), "another top.parquet"
    assert not [part for part in folder.rglob("*.part") if part.parent.name == "parts"], "unfinished files are left"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--kills", type=int, default=100)
    options.add_argument("--rows", type=int, default=40_000)
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = killed(Path(folder), given.kills, given.rows, given.seed)
    print(", ".join(f"{name}: {count}" for name, count in found.items()) + "; nothing lost, nothing twice")


if __name__ == "__main__":
    main()
