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


def role(*words: str) -> tuple[float, float]:
    return spent(["-m", "benchmarks.suite.fresh", *words])


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
    small = str(MEMORY_BATCH)
    jobs = {"imports only": ("imports", "float32", "1")}
    for dtype in ("float64", "float32"):
        jobs[f"first answer, jit, {dtype}"] = ("jit", dtype, "64")
        jobs[f"first answer, direct call, {dtype}"] = ("direct", dtype, "64")
        jobs[f"jaxgrasp {dtype}, {small} programs"] = ("jit", dtype, small)
        if everything:
            jobs[f"jaxgrasp {dtype}, {LARGE_BATCH} programs"] = ("jit", dtype, str(LARGE_BATCH))
    for peer, distribution in peers.PEERS.items():
        if find_spec(distribution) and everything and peer != "osqp":
            jobs[f"{peer}, {small} programs"] = ("peer", peer)
    rows = []
    for name, words in jobs.items():
        runs = [role(*words) for _ in range(2 if "first" in name else 1)]
        rows.append({"what": name, "seconds": min(s for s, _ in runs), "peak_mib": min(m for _, m in runs)})
    if everything:
        seconds, peak = million_candidates(CANDIDATES)
        rows.append({"what": f"jaxgrasp rank, {CANDIDATES} candidates", "seconds": seconds, "peak_mib": peak})
    for row in rows:
        say(f"  {row['what']}: {row['seconds']:.1f} s, {row['peak_mib']:.0f} MiB")
    return rows


def _main(what: str, *words: str) -> None:
    if what == "peer":
        batch = problems.programs(problems.sample(MEMORY_BATCH, 4))
        getattr(peers, words[0])(batch)()
        return
    dtype, count = words[0], int(words[1])
    import jax

    jax.config.update("jax_enable_x64", dtype == "float64")
    import jaxgrasp as jg
    from benchmarks.suite import ours

    grasps = problems.sample(count, 4)
    contacts, disturbances = ours.contacts(grasps, dtype), jg.DisturbanceSet.forces(1.0)
    if what == "jit":
        jax.block_until_ready(jax.jit(jg.largest_disturbance)(contacts, disturbances))
    if what == "direct":
        jax.block_until_ready(jg.largest_disturbance(contacts, disturbances))


if __name__ == "__main__":
    _main(*sys.argv[1:])
