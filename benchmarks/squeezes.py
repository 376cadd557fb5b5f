"""Do published grasps hold better with our squeezes? `python -m benchmarks.squeezes HAND FOLDER... [--bare ...]`.

A FOLDER has an object's convex `pieces` and `grasps.npz` (pregrasp_qpos, grasp_qpos, squeeze_qpos, obj_pose, obj_scale,
succ_flag): grasps in the layout of DexGraspBench with the benchmark's own answers. They are tried by the protocol
`dexgraspbench-fc` with their squeezes, which says how often we agree with these answers, and with ours. `--bare HAND
GRASPS PIECES` are grasps of a hand without actuators, with no squeezes of their own: tried as they are, and with ours.
Writes squeezes.md beside this file.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import time
from pathlib import Path

import jax
import mujoco
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.evaluation import Evaluation, wilson  # noqa: E402
from jaxgrasp.files import GraspSet, read_grasps  # noqa: E402

SERVO_GAIN = 5.0


def mcnemar(won: int, lost: int) -> float:
    """The exact p value of as many changes one way and the other."""
    count = won + lost
    tail = sum(math.comb(count, k) for k in range(min(won, lost) + 1)) / 2**count
    return min(1.0, 2 * tail)


def travel(grasps: GraspSet) -> float:
    """Median way of the joints from grasp to squeeze, rad."""
    way = grasps.stages["squeeze"].joints - grasps.stages["grasp"].joints
    return float(np.median(np.linalg.norm(way, axis=-1)))


def tried(grasps: GraspSet, **scene: object) -> tuple[Evaluation, str]:
    """Tries grasps, and returns the outcomes and a phrase on how fast that was."""
    begun, worked = time.perf_counter(), time.process_time()
    found = jg.evaluate(grasps, **scene)
    rate = len(grasps) / (time.perf_counter() - begun)
    each = (time.process_time() - worked) / len(grasps)
    return found, f"{rate:.1f} grasps a second, {each:.2f} core seconds each"


def share(held: np.ndarray) -> str:
    low, high = wilson(int(held.sum()), len(held))
    return f"{held.sum()} of {len(held)} ({low:.0%} to {high:.0%})"


def row(name: str, before: np.ndarray, after: np.ndarray) -> str:
    won, lost = int((after & ~before).sum()), int((before & ~after).sum())
    return f"| {name} | {share(before)} | {share(after)} | {won} | {lost} | {mcnemar(won, lost):.2g} |"


HEAD = ["| | {} | ours | won | lost | McNemar p |", "|---|---|---|---|---|---|"]


def published(hand: str, folders: list[Path]) -> list[str]:
    """Ours in place of the authors'."""
    pieces = [folder / "pieces" for folder in folders]
    scene = {"hand": hand, "object": pieces}
    grasps = read_grasps([folder / "grasps.npz" for folder in folders], hand=hand).with_scale(None)
    theirs, rate = tried(grasps, **scene)
    answers = grasps.columns["succ_flag"].astype(bool)
    agree = theirs.held == answers
    begun = time.perf_counter()
    squeezed = jg.squeeze_grasps(grasps, **scene)
    seconds = time.perf_counter() - begun
    ours, _ = tried(squeezed, **scene)
    lines = [
        f"With the authors' squeezes {agree.sum()} of {len(agree)} trials ({agree.mean():.1%}) end as in the benchmark",
        f"itself: {rate}, scenes included. The squeezes took {seconds:.0f} s, compilation included. The joints'",
        f"median way from grasp to squeeze is {travel(squeezed):.2f} rad, theirs {travel(grasps):.2f} rad.",
        "",
        HEAD[0].format("theirs"),
        HEAD[1],
    ]
    for name in dict.fromkeys(theirs.object.tolist()):
        chosen = theirs.object == name
        lines.append(row(name, theirs.held[chosen], ours.held[chosen]))
    return [*lines, row("all", theirs.held, ours.held)]


def bare(hand: str, files: Path, pieces: Path) -> list[str]:
    """Ours in place of none, for a hand that is given servos."""
    scene = {"hand": hand, "object": pieces, "servo_gain": SERVO_GAIN}
    grasps = read_grasps(files, hand=hand).with_scale(None)
    alone, _ = tried(grasps, **scene)
    squeezed = jg.squeeze_grasps(grasps, **scene)
    ours, _ = tried(squeezed, **scene)
    return [
        f"{len(grasps)} grasps of {files.stem}, of a hand without actuators: {ours.said[0]}.",
        "They have no pre-grasp and no squeeze; the grasp stands for both in the first column. The joints' median way",
        f"from grasp to squeeze is {travel(squeezed):.2f} rad.",
        "",
        HEAD[0].format("joints as in the file"),
        HEAD[1],
        row(files.stem, alone.held, ours.held),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hand")
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--bare", nargs=3, metavar=("HAND", "GRASPS", "PIECES"))
    options = parser.parse_args()
    lines = ["# Squeezes", "", *published(options.hand, options.folders)]
    if options.bare:
        hand, files, pieces = options.bare
        lines += ["", *bare(hand, Path(files), Path(pieces))]
    lines += [
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} in the end, mujoco "
        f"{mujoco.__version__}, jax {jax.__version__}. Made by `python -m benchmarks.squeezes`.",
        "",
    ]
    text = "\n".join(lines)
    (Path(__file__).parent / "squeezes.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
