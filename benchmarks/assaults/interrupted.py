"""Ctrl-C and SIGTERM at random moments of every command: exit 130 or 143, one line, never a signal.

Every command is started anew in a folder of its own; half of the signals come within the first second. What was written
has to be whole. A command that was done before its signal came does not count. Before Python has reached the command's
first line a signal ends it as it ends any Python program: moments are drawn from 0.1 s on, which busy machines exceed.

    python -m benchmarks.assaults.interrupted [--count 20] [--output interrupted.md]
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

COMMANDS = {
    "rank": ["rank", "grasps.npz", "--figure", "ranking.png"],
    "rank --metric": ["rank", "grasps.npz", "--metric", "ferrari_canny_bound,margin", "--figure", "None"],
    "rank --scene": ["rank", "--scene", "four_fingers", "--samples", "500", "--picture", "None"],
    "synthesize": ["synthesize", "--starts", "256"],
    "synthesize --scene": ["synthesize", "--scene", "four_fingers", "--starts", "16", "--picture", "None"],
    "compare": ["compare", "grasps.npz", "--friction", "0.6", "--max-force", "5"],
}
FIRST = 0.1


def whole(path: Path) -> bool:
    if path.suffix == ".npz":
        with np.load(path) as archive:
            return all(np.isfinite(archive[name].shape[:1]).all() for name in archive.files)
    if path.suffix == ".parquet":
        import pyarrow.parquet

        return pyarrow.parquet.read_table(path).num_rows > 0
    content = path.read_bytes()
    return content.endswith(b"IEND\xaeB`\x82") if path.suffix == ".png" else content.endswith(b"\n")


def once(arguments: list[str], number: int, moment: float, home: Path) -> tuple[str, str]:
    """The outcome of one input in a word, and what the command printed."""
    for path in home.iterdir():
        if path.name != "grasps.npz":
            path.unlink()
    process = subprocess.Popen(
        [sys.executable, "-m", "jaxgrasp.cli", *arguments], cwd=home, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
    else:
        return "done before", ""
    try:
        complaint = process.communicate(timeout=120)[1].decode("utf-8", "replace")
    except subprocess.TimeoutExpired:
        process.kill()
        return "hangs", ""
    if process.returncode == 0:
        return "done before", complaint
    if process.returncode != 128 + number:
        return f"exit {process.returncode}", complaint
    if complaint.count("\n") != 1 or not complaint.startswith("jaxgrasp: "):
        return "not one line", complaint
    made = [path for path in home.iterdir() if path.name != "grasps.npz"]
    if any(path.name.startswith(".") for path in made):
        return "litter", complaint
    if not all(whole(path) for path in made):
        return "broken file", complaint
    return ("kept" if made else "ended"), complaint


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=20)
    options.add_argument("--command", action="append", choices=COMMANDS)
    options.add_argument("--within", type=float, help="latest moment of a signal, s; None for all that a command takes")
    options.add_argument("--output", type=Path)
    given = options.parse_args()
    draw = random.Random(0)
    lines = [
        "| command | within, s | signals | ended at once | work kept | otherwise |",
        "|---|---:|---:|---:|---:|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        from jaxgrasp.candidates import sample_grasps

        grasps = sample_grasps(100_000)
        np.savez(
            home / "grasps.npz",
            positions=grasps.positions,
            outward_normals=grasps.normals,
            friction=grasps.friction,
            max_force=grasps.max_force,
        )
        for name in given.command or COMMANDS:
            arguments = COMMANDS[name]
            begun = time.perf_counter()
            for _ in range(0 if given.within else 2):
                begun = time.perf_counter()
                subprocess.run(
                    [sys.executable, "-m", "jaxgrasp.cli", *arguments], cwd=home, check=True, capture_output=True
                )
            length = given.within or time.perf_counter() - begun
            for number in (signal.SIGINT, signal.SIGTERM):
                count = given.count if number == signal.SIGINT else max(1, given.count // 4)
                outcomes: dict[str, int] = {}
                for turn in range(count):
                    last = 1.0 if turn % 2 else max(1.0, 0.95 * length)
                    what, said = once(arguments, number, draw.uniform(FIRST, last), home)
                    outcomes[what] = outcomes.get(what, 0) + 1
                    if what not in ("ended", "kept", "done before"):
                        print(name, what, said, file=sys.stderr, flush=True)
                ended, kept = outcomes.pop("ended", 0), outcomes.pop("kept", 0)
                rest = ", ".join(f"{count} {what}" for what, count in outcomes.items()) or "none"
                title = f"`{name}`, {signal.Signals(number).name}"
                lines.append(f"| {title} | {length:.1f} | {count} | {ended} | {kept} | {rest} |")
                print(lines[-1], flush=True)
    text = "\n".join(lines) + "\n"
    if given.output:
        given.output.write_text(f"{text}\n{os.cpu_count()} cores.\n")


if __name__ == "__main__":
    main()
