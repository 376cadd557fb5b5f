"""A million candidates from an archive to a table: the package at hand, or another checkout of it by turns.

python -m benchmarks.assaults.million [--before CHECKOUT] [--turns 3] [--count 1000000]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

# Reading and writing alone, of the package that is found first.
BOTH = """
import sys, time, numpy as np
from types import SimpleNamespace
from jaxgrasp.candidates import read_candidates
from jaxgrasp.ranking import Ranking, write_table
clock = time.process_time if sys.argv[2] == "processor" else time.perf_counter
begun = clock()
candidates = read_candidates(["grasps.npz"])
read = clock()
margin = candidates.positions[:, 0, 0]
n, empty = len(margin), np.zeros((0, 4, 3))
ranking = Ranking(candidates=candidates, margin=margin, upper_bound=margin, status=np.zeros(n, int), share=0.75,
    order=np.argsort(-margin), forces=empty, object_forces=empty, effort=np.zeros(0),
    tightening_status=np.zeros(0, int), controls=np.zeros((0, 0)))
sorted_ = clock()
write_table(ranking, sys.argv[1])
print(read - begun, clock() - sorted_)
"""
WHOLE = """
import time
begun = time.perf_counter()
from jaxgrasp.cli import main
assert main(["rank", "grasps.npz", "--figure", "None"]) == 0
print(time.perf_counter() - begun)
"""


def timed(package: Path, program: str, home: Path, *arguments: str) -> list[float]:
    environment = {**os.environ, "PYTHONPATH": str(package)}
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=home, env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    return [float(number) for number in done.stdout.split("\n")[-2].split()]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--before", type=Path)
    options.add_argument("--turns", type=int, default=3)
    options.add_argument("--count", type=int, default=1_000_000)
    options.add_argument("--whole", action="store_true", help="the whole command, too")
    options.add_argument("--clock", choices=("wall", "processor"), default="wall", help="processor: for busy machines")
    given = options.parse_args()
    packages = {"now": Path(__file__).resolve().parents[2]} | ({"before": given.before} if given.before else {})
    draw = np.random.default_rng(0)
    normals = draw.normal(size=(given.count, 4, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        np.savez(
            home / "grasps.npz",
            positions=0.05 * normals,
            outward_normals=normals,
            friction=np.full(given.count, 0.6),
            max_force=np.full((given.count, 4), 10.0),
            object_name=np.full(given.count, "thing"),
        )
        found: dict[str, list[list[float]]] = {name: [] for name in packages}
        endings = (".parquet", ".csv")
        for _ in range(given.turns):
            for name, package in packages.items():
                row = []
                for ending in endings:
                    row += timed(package, BOTH, home, f"table{ending}", given.clock)
                found[name].append(row + (timed(package, WHOLE, home) if given.whole else []))
        titles = [f"{what} {ending}" for ending in endings for what in ("read, then", "write")]
        titles += ["whole command"] if given.whole else []
        print("| best of", given.turns, "|", " | ".join(titles), "|\n|---|" + "---:|" * len(titles))
        for name, rows in found.items():
            print(f"| {name} |", " | ".join(f"{value:.2f} s" for value in np.min(rows, axis=0)), "|")


if __name__ == "__main__":
    main()
