"""Ctrl-C and SIGTERM at random moments of every command: exit 130 or 143, one line, never a signal.

Every command is started anew in a folder of its own; half of the signals come within the first second. What was written
has to be whole. Before Python runs the first line of the script that pip installs, no program can answer a signal: such
signals are counted apart, as are commands that were done before.

    python -m benchmarks.assaults.interrupted [--count 20] [--output interrupted.md]
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.assaults.commands import (
    ERRORS,
    GRASPS,
    HIVE,
    OF_HAND,
    ON_HAND,
    PROGRAM,
    RESUMED,
    made,
    prepare,
    write_grasps,
    write_hand_grasps,
    write_runs,
)

COMMANDS = {
    "rank": ["rank", GRASPS, "--figure", "ranking.png"],
    "rank --metric": ["rank", GRASPS, "--metric", "ferrari_canny_bound,margin", "--figure", "None"],
    "rank --uncertainty --explain": ["rank", GRASPS, "--uncertainty", ERRORS, "--draws", "20", "--explain", "2"],
    "rank --run --sorted": ["rank", HIVE, "--run", "ranked", "--sorted", "--part-size", "10000"],
    "rank --resume": ["rank", "--resume", RESUMED, "--sorted"],
    "rank --run --ray": ["rank", HIVE, "--run", "ranked", "--ray", "local", "--part-size", "10000"],
    "rank --scene": ["rank", "--scene", "four_fingers", "--samples", "500", "--picture", "None"],
    "synthesize": ["synthesize", "--starts", "256"],
    "synthesize --scene": ["synthesize", "--scene", "four_fingers", "--starts", "16", "--picture", "None"],
    "compare": ["compare", GRASPS, "--friction", "0.6", "--max-force", "5"],
    "squeeze": ["squeeze", *ON_HAND],
    "evaluate": ["evaluate", *ON_HAND],
    "evaluate --ray": ["evaluate", *ON_HAND, "--ray", "local"],
    "convert": ["convert", OF_HAND, "--to", "dexgraspbench", "--output", "converted"],
}


def signalled(arguments: list[str], number: int, moment: float, home: Path) -> tuple[int, str, bool]:
    """Exit code of a command that gets a signal at a moment, what it printed, and whether its script had begun."""
    begun, begins = os.pipe()
    script = [*PROGRAM[:-1], f"import os\nos.write({begins}, b'.')\nos.close({begins})\n{PROGRAM[-1]}"]
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "pass_fds": (begins,)}
    process = subprocess.Popen([*script, *arguments], cwd=home, **streams)
    os.close(begins)
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        process.send_signal(number)
    try:
        complaint = process.communicate(timeout=120)[1]
        return process.returncode, complaint.decode("utf-8", "replace"), bool(os.read(begun, 1))
    finally:
        process.kill()
        os.close(begun)


def whole(path: Path) -> bool:
    if path.is_dir():
        return any(path.iterdir())
    if path.suffix == ".npy":
        from jaxgrasp.files import read_grasps

        return len(read_grasps(path)) == 1
    if path.suffix == ".npz":
        import numpy as np

        with np.load(path) as archive:
            return all(np.isfinite(archive[name].shape[:1]).all() for name in archive.files)
    if path.suffix == ".parquet":
        import pyarrow.parquet

        return pyarrow.parquet.read_table(path).num_rows > 0
    if path.suffix == ".arrow":
        import pyarrow.feather

        return pyarrow.feather.read_table(path).num_columns > 0
    if path.suffix == ".json":
        return bool(json.loads(path.read_bytes()))
    content = path.read_bytes()
    return content.endswith(b"IEND\xaeB`\x82") if path.suffix == ".png" else content.endswith(b"\n")


def once(arguments: list[str], number: int, moment: float, home: Path) -> tuple[str, str]:
    """The outcome of one signal in a word, and what the command printed."""
    prepare(home, arguments)
    try:
        code, complaint, begun = signalled(arguments, number, moment, home)
    except subprocess.TimeoutExpired:
        return "hangs", ""
    if not begun:
        return "before", complaint
    if code == 0:
        return "done before", complaint
    if code != 128 + number:
        return f"exit {code}", complaint
    if complaint.count("\n") != 1 or not complaint.startswith("jaxgrasp: "):
        return "not one line", complaint
    # The lock of a run's folder stays there.
    if any(path.name.startswith(".") and path.name != ".lock" for path in made(home)):
        return "litter", complaint
    if not all(whole(path) for path in made(home) if path.name != ".lock"):
        return "broken file", complaint
    return ("kept" if made(home) else "ended"), complaint


def row(name: str, number: int, count: int, within: float, home: Path, draw: random.Random) -> str:
    outcomes: collections.Counter[str] = collections.Counter()
    for turn in range(count):
        last = 1.0 if turn % 2 else max(1.0, 0.95 * within)
        what, said = once(COMMANDS[name], number, draw.uniform(0.0, last), home)
        outcomes[what] += 1
        if what not in ("ended", "kept", "before", "done before"):
            print(name, what, said, file=sys.stderr, flush=True)
    before, ended, kept = (outcomes.pop(what, 0) for what in ("before", "ended", "kept"))
    rest = ", ".join(f"{count} {what}" for what, count in outcomes.items()) or "none"
    title = f"`{name}`, {signal.Signals(number).name}"
    return f"| {title} | {within:.1f} | {count} | {before} | {ended} | {kept} | {rest} |"


def length(name: str, home: Path) -> float:
    """How long a command takes whose kernels and programs are on disk, s."""
    for _ in range(2):
        prepare(home, COMMANDS[name])
        begun = time.perf_counter()
        subprocess.run([*PROGRAM, *COMMANDS[name]], cwd=home, check=True, capture_output=True)
    return time.perf_counter() - begun


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=20)
    options.add_argument("--command", action="append", choices=COMMANDS)
    options.add_argument("--within", type=float, help="latest moment of a signal, s; None for all that a command takes")
    options.add_argument("--output", type=Path)
    given = options.parse_args()
    # Who runs this in the background ignores SIGINT, and so would the commands.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    draw, lines = random.Random(0), []

    def say(line: str) -> None:
        print(line, flush=True)
        lines.append(line)

    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        write_grasps(home, 100_000)
        write_hand_grasps(home, 2_000)
        write_runs(home, 10_000)
        say("| command | within, s | signals | before its first line | ended at once | work kept | otherwise |")
        say("|---|---:|---:|---:|---:|---:|---|")
        for name in given.command or COMMANDS:
            within = given.within or length(name, home)
            for number in (signal.SIGINT, signal.SIGTERM):
                say(row(name, number, given.count, within, home, draw))
    if given.output:
        given.output.write_text("\n".join(lines) + f"\n\n{os.cpu_count()} cores.\n")


if __name__ == "__main__":
    main()
