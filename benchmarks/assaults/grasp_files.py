"""Gives `jaxgrasp convert` malicious and broken files of grasps: each must end in one line and exit 2, and run nothing.

Each file is given to the command's `main` in a process of its own, forked from one that has imported everything; every
`--sample`th is run as a command from its very start, too. A file `canary` in the working folder would show that
something in a file had been run. In the end all of them are given to one command together with good files, and
`--keep-going`: the good ones are converted. Seconds are the processor's, children included; what takes three minutes on
the clock is killed.

    python -m benchmarks.assaults.grasp_files [--sample 10] [--kind pickle] [--output grasp_files.md]
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import io
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.assaults.grasp_cases import quietly
from benchmarks.assaults.grasp_samples import HAND, JOINTS
from benchmarks.assaults.hostile_pickles import CANARY
from benchmarks.assaults.inputs import Case
from benchmarks.assaults.outcomes import Outcome, commanded, forked, table

OUT = "out.npz"


def arguments(paths: list[Path]) -> list[str]:
    return [
        "convert",
        *map(os.fspath, paths),
        "--to",
        "jaxgrasp",
        "--output",
        OUT,
        "--hand",
        "hand.xml",
        "--scale",
        "1",
    ]


def tried_with(run: Callable[[Case, list[str], Path], Outcome], case: Case, home: Path) -> Outcome:
    """Runs one, and looks for what it must not have left."""
    found = run(case, arguments([case.path]), home)
    accepted = found.code == 0 or (home / OUT).exists()
    wrong = "a canary" if (home / CANARY).exists() else "accepted" if accepted else ""
    for name in (CANARY, OUT):
        (home / name).unlink(missing_ok=True)
    return replace(found, accepted_wrongly=wrong)


def together(tried: list[Case], home: Path) -> str:
    """All of them in one command with three good files of four grasps each."""
    good = []
    for number in range(3):
        good.append(home / f"good{number}.npz")
        np.savez(good[-1], grasp_qpos=np.full((4, 10), float(number)), joint_names=np.array(JOINTS))
    # A folder without any file is no file that could be passed over.
    bad = [case.path for case in tried if not case.path.is_dir()]
    paths = [good[0], *bad[: len(bad) // 2], good[1], *bad[len(bad) // 2 :], good[2]]
    command = [sys.executable, "-m", "jaxgrasp.cli", *arguments(paths), "--keep-going"]
    done = subprocess.run(command, cwd=home, capture_output=True, text=True)
    with np.load(home / OUT) as found:
        count = len(found["grasp_qpos"])
    lines = [line for line in done.stderr.splitlines() if not line.startswith("jaxgrasp: warning")]
    canary = "a canary" if (home / CANARY).exists() else "no canary"
    return (
        f"In one command with `--keep-going`: {len(bad)} bad files, {len(lines)} lines, {count} of 12 good grasps "
        f"written, exit {done.returncode}, {canary}.\n"
    )


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--sample", type=int, default=10, help="every how manieth is run as a command; 0 for none")
    options.add_argument("--kind", help="of one kind alone")
    options.add_argument("--output", type=Path)
    options.add_argument("--verbose", action="store_true", help="print every outcome")
    given = options.parse_args()
    with contextlib.redirect_stdout(io.StringIO()):
        import jaxgrasp.cli.report
        import jaxgrasp.cli.subcommands
        import jaxgrasp.files
        import jaxgrasp.hands.hand_frames  # noqa: F401

    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder, "home")
        home.mkdir()
        (home / "hand.xml").write_text(HAND)
        # In a process of its own, whose memory the others would start with.
        with concurrent.futures.ProcessPoolExecutor(1) as maker:
            made = maker.submit(quietly, Path(folder, "inputs")).result()
        tried = [case for case in made if given.kind in (None, case.kind)]
        found = []
        for case in tried:
            found.append(tried_with(forked, case, home))
            if given.verbose or found[-1].faults or found[-1].code == 0:
                print(case.kind, repr(case.name), found[-1].code, f"{found[-1].seconds:.1f} s", end=" ")
                print(f"{found[-1].mebibytes:.0f} MiB", found[-1].faults, found[-1].errors[-300:].strip(), flush=True)
        text = "# Malicious and broken files of grasps\n\n`python -m benchmarks.assaults.grasp_files`"
        text += f", Python {platform.python_version()}, NumPy {np.__version__}, {os.cpu_count()} cores.\n\n"
        text += table(found, "In forked processes")
        if given.sample:
            text += "\n" + table([tried_with(commanded, case, home) for case in tried[:: given.sample]], "As commands")
        text += "\n" + together(tried, home)
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    main()
