"""What can only be told of a process that has just started: the time to its first answer, and its peak memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.suite import peers, problems
from benchmarks.suite.clock import say

MEMORY_BATCH = 4096
LARGE_BATCH = 65_536
CANDIDATES = 1_000_000


def spent(command: list[str]) -> tuple[float, float]:
    """Seconds from start to exit, and the peak of resident memory in MiB, of a process of this Python."""
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *command], cwd=Path(__file__).resolve().parents[2], stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(command[:4])} ended with {process.returncode}")
    return seconds, usage.ru_maxrss / 1024


def million_candidates(count: int) -> tuple[float, float]:
    """The same of `jaxgrasp rank` on a file of candidates, table written, no figure."""
    with tempfile.TemporaryDirectory() as folder:
        grasps = problems.sample(count, 4)
        source, table = Path(folder) / "candidates.npz", Path(folder) / "ranking.parquet"
        np.savez(source, positions=grasps.positions, frames=grasps.frames)
        del grasps
        options = ["--friction", "0.8", "--max-force", "2", "--output", str(table), "--figure", "None"]
        command = "import sys; from jaxgrasp.cli import main; sys.exit(main())"
        return spent(["-c", command, "rank", str(source), *options])


def processes(*, everything: bool) -> list[dict]:
    """Fresh processes: time to the first answer, peak memory."""
    say("Fresh processes")
    rows = []

    def add(what: str, runs: int, *command: str) -> None:
        spent_by_each = [spent(["-m", *command]) for _ in range(runs)]
        seconds, peak = (min(each) for each in zip(*spent_by_each, strict=True))
        tell(what, seconds, peak)

    def tell(what: str, seconds: float, peak: float) -> None:
        rows.append({"what": what, "seconds": seconds, "peak_mib": peak})
        say(f"  {what}: {seconds:.1f} s, {peak:.0f} MiB")

    first = "benchmarks.suite.first"
    add("imports and contacts only", 1, first, "nothing", "float32", "64")
    runs = 2 if everything else 1
    for dtype in ("float32", "float64"):
        add(f"first answer, {dtype}", runs, first, "direct", dtype, "64")
    add("first answer inside a user's jit, float32", runs, first, "jit", "float32", "64")
    if everything:
        for dtype in ("float64", "float32"):
            add(f"jaxgrasp {dtype}, {LARGE_BATCH} programs", 1, first, "jit", dtype, str(LARGE_BATCH))
        for peer, distribution in peers.PEERS.items():
            # OSQP needs minutes for as many.
            if find_spec(distribution) and peer != "osqp":
                add(f"{peer}, {MEMORY_BATCH} programs", 1, "benchmarks.suite.fresh", peer)
        tell(f"jaxgrasp rank, {CANDIDATES} candidates", *million_candidates(CANDIDATES))
    return rows


def _main(peer: str) -> None:
    getattr(peers, peer)(problems.programs(problems.sample(MEMORY_BATCH, 4)))()


if __name__ == "__main__":
    _main(*sys.argv[1:])
