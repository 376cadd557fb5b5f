"""A cluster of Ray on this machine, one of whose workers is killed in the middle: complete, and equal to no cluster.

python -m benchmarks.assaults.lost_worker [--rows 400000] [--workers 4] [--parts 40]
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet

from jaxgrasp.candidates import sample_grasps

TOP = 100
COMMAND = [sys.executable, "-m", "jaxgrasp.cli", "rank", "grasps.npz", "--figure", "None", "--top", str(TOP)]


def lost(home: Path, rows: int, workers: int, parts: int) -> dict[str, float]:
    """Seconds with and without the cluster, and how many parts were there when the worker was killed."""
    grasps = sample_grasps(rows, seed=0)
    fields = {name: getattr(grasps, name) for name in ("positions", "outward_normals", "friction", "max_force")}
    np.savez(home / "grasps.npz", **fields)
    size = ["--part-size", str(-(-rows // parts))]
    begin = time.monotonic()
    subprocess.run([*COMMAND, *size, "--run", "plain"], cwd=home, check=True, capture_output=True)
    plain = time.monotonic() - begin
    cluster = [*COMMAND, *size, "--run", "cluster", "--ray", "local", "--ray-workers", str(workers)]
    begin = time.monotonic()
    process = subprocess.Popen(cluster, cwd=home, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    there = lambda: len(list((home / "cluster" / "parts").glob("*.parquet")))
    while there() < parts // 3 and process.poll() is None:
        time.sleep(0.01)
    # Between two parts a worker may be called otherwise.
    while not (killed := _workers(process.pid)) and process.poll() is None:
        time.sleep(0.01)
    at = there()
    if killed:
        os.kill(killed[0], signal.SIGKILL)
    told, _ = process.communicate(timeout=1_800)
    if process.returncode or not killed:
        raise RuntimeError(told or "the cluster was done before a worker could be killed")
    took = time.monotonic() - begin
    _compare(home / "cluster", home / "plain", rows)
    return {"without": plain, "with": took, "workers": len(killed), "parts there": at}


def _workers(parent: int) -> list[int]:
    """Processes of the class that ranks, below another process."""
    found, above = [], {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            above[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            title = (folder / "cmdline").read_bytes()
            if title.startswith(b"ray::") and b"MapWorker" in title:
                found.append(int(folder.name))
        except OSError:
            continue

    def below(number: int) -> bool:
        return number == parent or (number in above and below(above[number]))

    return sorted(number for number in found if below(number))


def _compare(found: Path, wanted: Path, rows: int) -> None:
    ours, theirs = (pyarrow.parquet.read_table(each / "parts") for each in (found, wanted))
    assert ours.num_rows == rows and ours["index"].to_pylist() == list(range(rows)), "a candidate is missing, or twice"
    assert ours.equals(theirs), "other rows than without a cluster"
    tops = [pyarrow.parquet.read_table(each / "top.parquet") for each in (found, wanted)]
    assert tops[0].equals(tops[1]), "another top.parquet"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rows", type=int, default=400_000)
    options.add_argument("--workers", type=int, default=4)
    options.add_argument("--parts", type=int, default=40)
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = lost(Path(folder), given.rows, given.workers, given.parts)
    print(
        f"{given.rows:,} candidates in {given.parts} parts on {found['workers']:.0f} workers, one killed when "
        f"{found['parts there']:.0f} parts were there: complete and equal; {found['with']:.1f} s, "
        f"{found['without']:.1f} s in one process"
    )


if __name__ == "__main__":
    main()
