"""Ranking more candidates than memory is for: peak and rate of `jaxgrasp rank --run` beside a ranking in memory.

    python -m benchmarks.streams [--candidates 10000000] [--memory 1000000] [--rounds 3] [--reference]

writes streams.md beside itself, for the default numbers alone. Each round ranks both, by turns, in fresh processes that
have compiled everything before the clock starts: what is timed is a whole command, from its options to its figure.
--reference ranks all candidates in memory, too (for each million about 1 GiB), and compares the best 100.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet

from benchmarks.suite.clock import say, warn_if_busy

CANDIDATES, MEMORY, ROUNDS, TOP = 10_000_000, 1_000_000, 3, 100
CONTACTS, A_FILE = 4, 500_000
COMMON = ["--friction", "0.8", "--max-force", "2", "--top", str(TOP)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--candidates", type=int, default=CANDIDATES)
    parser.add_argument("--memory", type=int, default=MEMORY)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--reference", action="store_true")
    parser.add_argument("--child", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        _child(*given.child)
        return
    load = warn_if_busy()
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        _write_candidates(home / "in", given.candidates)
        _write_candidates(home / "memory", given.memory)
        _write_candidates(home / "warm", 200_000)
        found: dict[str, list[dict[str, float]]] = {"in memory": [], "in parts": []}
        for number in range(given.rounds):
            memory = [str(home / "memory"), "--output", str(home / "a.parquet"), "--figure", str(home / "a.png")]
            parts = [str(home / "in"), "--run", str(home / f"run-{number}")]
            warm = [str(home / "warm"), "--run", str(home / f"warm-{number}")]
            found["in memory"].append(_run(home, memory, memory, given.memory))
            found["in parts"].append(_run(home, warm, parts, given.candidates))
        text = _report(found, given.candidates, given.memory, load) + _costs(
            home / "run-0", home / "in", given.candidates
        )
        if given.reference:
            text += _reference(home, sorted((home / "in").iterdir()), home / "run-0")
    say(text)
    if (given.candidates, given.memory) == (CANDIDATES, MEMORY):
        (Path(__file__).parent / "streams.md").write_text(text)


def _write_candidates(folder: Path, count: int) -> None:
    """Files of grasps, none of them twice."""
    from benchmarks.suite import problems

    folder.mkdir()
    for number, start in enumerate(range(0, count, A_FILE)):
        grasps = problems.sample(min(A_FILE, count - start), CONTACTS, seed=number)
        np.savez(folder / f"{number:04d}.npz", positions=grasps.positions, frames=grasps.frames)


def _run(home: Path, warm: list[str], command: list[str], count: int) -> dict[str, float]:
    told = home / "told.json"
    arguments = [
        sys.executable,
        "-m",
        "benchmarks.streams",
        "--child",
        str(told),
        json.dumps(warm),
        json.dumps(command),
    ]
    process = subprocess.Popen(arguments, cwd=Path(__file__).resolve().parents[1], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}")
    took = json.loads(told.read_text())
    rate = {"rate": count / took["wall"], "rate_cpu": count / took["cpu"]}
    return {**took, **rate, "GiB": usage.ru_maxrss / 2**20}


def _child(told: str, warm: str, command: str) -> None:
    from jaxgrasp.cli import main as jaxgrasp

    assert jaxgrasp(["rank", *json.loads(warm), *COMMON]) == 0
    wall, cpu = time.perf_counter(), time.process_time()
    assert jaxgrasp(["rank", *json.loads(command), *COMMON]) == 0
    Path(told).write_text(json.dumps({"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}))


def _report(found: dict[str, list[dict[str, float]]], candidates: int, memory: int, load: float) -> str:
    median = {
        what: {key: float(np.median([run[key] for run in runs])) for key in runs[0]} for what, runs in found.items()
    }
    ratio = lambda key: median["in parts"][key] / median["in memory"][key]
    peak = max(run["GiB"] for run in found["in parts"])
    lines = [
        "# Ranking in parts",
        "",
        f"`python -m benchmarks.streams`: {candidates:,} candidates of {CONTACTS} contacts with --run, and "
        f"{memory:,} in memory, float64, table, figure and the forces of {TOP}; {os.cpu_count()} cores, load average "
        f"at the start {load:.1f}. Medians of {len(found['in parts'])} rounds by turns; whole commands once everything "
        "is compiled.",
        "",
        "| | s | processor s | candidates a second | a processor second | peak memory, GiB |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for what, run in median.items():
        numbers = (
            f"{run['wall']:.1f} | {run['cpu']:.1f} | {run['rate']:,.0f} | {run['rate_cpu']:,.0f} | {run['GiB']:.2f}"
        )
        lines.append(f"| {what} | {numbers} |")
    lines += [
        "",
        f"In parts the rate is {ratio('rate'):.2f} of that in memory ({ratio('rate_cpu'):.2f} a processor second); "
        f"the largest peak is {peak:.2f} GiB.",
    ]
    return "\n".join(lines) + "\n"


def _costs(run: Path, inputs: Path, candidates: int) -> str:
    """Measure what a plan for more needs: bytes on disks and in networks, and the time to merge summaries."""
    from pyarrow import ipc

    from jaxgrasp.ranking.streams.scored import Summary

    size = lambda folder: sum(path.stat().st_size for path in folder.iterdir())
    paths = sorted((run / "summaries").iterdir())
    read, begin, opened = [], 0.0, 0.0
    # The first time takes what Arrow imports.
    for _ in range(2):
        begin = time.process_time()
        read = [Summary.from_table(ipc.open_file(path).read_all()) for path in paths]
        opened = time.process_time()
    Summary.merged(read, TOP)
    merged = time.process_time()
    each, rows = len(paths), candidates / len(paths)
    return (
        f"\nA candidate takes {size(inputs) / candidates:.0f} bytes of input and "
        f"{size(run / 'parts') / candidates:.1f} of parts; a summary {size(run / 'summaries') / each / 1024:.0f} KiB "
        f"for {rows:,.0f} candidates, {1e3 * (opened - begin) / each:.1f} processor ms to read and "
        f"{1e3 * (merged - opened) / each:.2f} to merge.\n"
    )


def _reference(home: Path, files: list[Path], run: Path) -> str:
    """Compares the best with those of a ranking of everything in memory."""
    from jaxgrasp.candidates import read_candidates
    from jaxgrasp.cli.setting import configure_jax
    from jaxgrasp.ranking import rank

    configure_jax()
    candidates = read_candidates(files, friction=0.8, max_force=2.0)
    ranking = rank(candidates, top=TOP)
    best, order = pyarrow.parquet.read_table(run / "top.parquet"), ranking.order[:TOP]
    sources = [candidates.sources[number] for number in candidates.source[order]]
    same = best["source"].to_pylist() == sources and best["index"].to_pylist() == candidates.index[order].tolist()
    apart = float(np.abs(best["margin"].to_numpy() - ranking.margin[order]).max())
    rows = pyarrow.parquet.read_table(run / "parts", columns=["margin"])["margin"].to_numpy()
    whole = float(np.nanmax(np.abs(rows - ranking.margin)))
    return (
        f"\nThe best {TOP} of {len(candidates):,} are {'the same' if same else 'OTHERS'} as in memory, in "
        f"the same order, with margins at most {apart:.1e} apart; all margins are at most {whole:.1e} apart.\n"
    )


if __name__ == "__main__":
    main()
