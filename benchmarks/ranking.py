"""Where the time of `jaxgrasp rank` goes, for a million candidates: a fresh process, split by what it does.

    python -m benchmarks.ranking [--candidates N]

writes ranking.md beside itself, for the default number alone. The command runs as users run it, with clocks around its
parts; the solver's are read after its results are there, so that nothing is still on its way.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.suite.clock import say, warn_if_busy

CANDIDATES = 1_000_000
CONTACTS = 4
ROUNDS = 3
PARTS = {
    "start": "start of Python, imports, options",
    "read": "reading the file",
    "first": "the first tile, with all compilation",
    "solve": "the other tiles: solving",
    "tiles": "the other tiles: to and from the solver",
    "order": "sorting",
    "tighten": "tightening forces of the best, with compilation",
    "table": "writing the table",
    "figure": "drawing and writing the figure",
    "rest": "all else",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--candidates", type=int, default=CANDIDATES)
    parser.add_argument("--child", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        _child(given.child)
        return
    load = warn_if_busy()
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "candidates.npz"
        _write_candidates(source, given.candidates)
        runs = {}
        for format_, note in ((".parquet", "kernels on disk"), (".npz", "kernels on disk")):
            environment = {**os.environ, "XDG_CACHE_HOME": folder}
            output = ["--output", str(Path(folder) / f"ranking{format_}"), "--figure", str(Path(folder) / "figure.png")]
            command = ["rank", str(source), "--friction", "0.8", "--max-force", "2", *output]
            if not runs:
                runs["nothing compiled before"] = _run(command, environment)
            best = min((_run(command, environment) for _ in range(ROUNDS)), key=lambda run: run["total"])
            runs[f"{note}, {format_}"] = best
    text = "\n".join(_report(runs, given.candidates, load)) + "\n"
    say(text)
    if given.candidates == CANDIDATES:
        (Path(__file__).parent / "ranking.md").write_text(text)


def _write_candidates(path: Path, count: int) -> None:
    from benchmarks.suite import problems

    grasps = problems.sample(count, CONTACTS)
    np.savez(path, positions=grasps.positions, frames=grasps.frames)


def _run(command: list[str], environment: dict[str, str]) -> dict[str, float]:
    """Seconds by part of one fresh process, and its peak of memory."""
    with tempfile.NamedTemporaryFile() as told:
        begin = time.time()
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.ranking", "--child", told.name, repr(begin), *command],
            cwd=Path(__file__).resolve().parents[1],
            env=environment,
            stdout=subprocess.DEVNULL,
        )
        _, status, usage = os.wait4(process.pid, 0)
        total = time.time() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}")
        parts = json.loads(Path(told.name).read_text())
    named = sum(parts.values())
    cpu = usage.ru_utime + usage.ru_stime
    return {**parts, "rest": total - named, "total": total, "cpu": cpu, "MiB": usage.ru_maxrss / 1024}


def _report(runs: dict[str, dict[str, float]], count: int, load: float) -> list[str]:
    lines = [
        "# Ranking from file to file",
        "",
        f"`python -m benchmarks.ranking`, {count:,} candidates of {CONTACTS} contacts, float64, table and figure; "
        f"{os.cpu_count()} cores, load average at the start {load:.1f}. Seconds, the best of {ROUNDS} runs but for the "
        "first.",
        "",
        f"| | {' | '.join(runs)} |",
        f"| --- |{' --- |' * len(runs)}",
    ]
    for key, name in PARTS.items():
        lines.append(f"| {name} | " + " | ".join(f"{run.get(key, 0.0):.2f}" for run in runs.values()) + " |")
    lines.append("| **all** | " + " | ".join(f"**{run['total']:.1f}**" for run in runs.values()) + " |")
    lines.append("| processor seconds | " + " | ".join(f"{run['cpu']:.1f}" for run in runs.values()) + " |")
    lines.append("| peak memory, MiB | " + " | ".join(f"{run['MiB']:.0f}" for run in runs.values()) + " |")
    return lines


def _child(arguments: list[str]) -> None:
    """The command, with clocks; file of the result, time of the start, then its command line."""
    told, begin, *command = arguments
    parts: dict[str, float] = {}

    def add(name: str, seconds: float) -> None:
        parts[name] = parts.get(name, 0.0) + seconds

    def timed(module: Any, name: str, part: str) -> None:
        function: Callable[..., Any] = getattr(module, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                add(part, time.perf_counter() - start)

        setattr(module, name, call)

    # As the command does, before JAX starts.
    from jaxgrasp.cli import main as rank
    from jaxgrasp.cli.setting import configure_jax

    configure_jax()
    import jax

    import jaxgrasp.candidates
    import jaxgrasp.ranking
    import jaxgrasp.viewer
    from jaxgrasp.ranking import tiles

    ranking = sys.modules["jaxgrasp.ranking.rank"]
    timed(jaxgrasp.candidates, "read_candidates", "read")
    timed(ranking._Scores, "order", "order")  # pyright: ignore[reportAttributeAccessIssue]
    timed(jaxgrasp.ranking, "write_table", "table")
    timed(jaxgrasp.viewer, "figure_of_ranking", "figure")
    timed(jaxgrasp.viewer, "write_figure", "figure")
    solve, in_tiles, seconds = tiles._solve_tile, tiles.solve_in_tiles, [0.0]

    def solved(*args: Any) -> Any:
        start = time.perf_counter()
        answer = jax.block_until_ready(solve(*args))
        seconds[0] = time.perf_counter() - start
        return answer

    def tiled(solver: Any, *args: Any, **kwargs: Any) -> Any:
        steps, first = in_tiles(solver, *args, **kwargs), True
        while True:
            start, seconds[0] = time.perf_counter(), 0.0
            answer = next(steps, None)
            took = time.perf_counter() - start
            if solver is tiles.tightening:
                add("tighten", took)
            elif first:
                add("first", took)
            else:
                add("solve", seconds[0])
                add("tiles", took - seconds[0])
            if answer is None:
                return
            first = False
            yield answer

    tiles._solve_tile, ranking.solve_in_tiles = solved, tiled  # pyright: ignore[reportAttributeAccessIssue]
    add("start", time.time() - float(begin))
    sys.argv = ["jaxgrasp", *command]
    code = rank()
    Path(told).write_text(json.dumps(parts))
    sys.exit(code)


if __name__ == "__main__":
    main()
