"""Every command where it finds less than it is used to: it works, or says why not in one line.

"says 2" counts the lines on standard error of a command that works: what it took for granted, and what it lacks.

Python's own files have to be readable for whoever it runs as; as root, `nobody` is given the capability to read.

    python -m benchmarks.assaults.environments [--output environments.md]
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.assaults.commands import (
    ERRORS,
    GRASPS,
    HIVE,
    OF_HAND,
    ON_HAND,
    PROGRAM,
    RESUMED,
    prepare,
    write_grasps,
    write_hand_grasps,
    write_runs,
)

COMMANDS = {
    "rank": ["rank", GRASPS],
    "rank --uncertainty --explain": ["rank", GRASPS, "--uncertainty", ERRORS, "--draws", "20", "--explain", "2"],
    "rank --run --sorted": ["rank", HIVE, "--run", "ranked", "--sorted"],
    "rank --resume": ["rank", "--resume", RESUMED],
    "rank --scene": ["rank", "--scene", "four_fingers", "--samples", "50", "--picture", "None", "--figure", "None"],
    "synthesize": ["synthesize", "--starts", "16", "--steps", "10", "--figure", "None"],
    "compare": ["compare", GRASPS, "--metric", "margin,min_weight"],
    "squeeze": ["squeeze", *ON_HAND],
    "evaluate": ["evaluate", *ON_HAND, "--figure", "None"],
    "evaluate --ray": ["evaluate", *ON_HAND, "--ray", "local"],
    "convert": ["convert", OF_HAND, "--to", "dexgraspbench", "--output", "converted"],
    "help": ["--help"],
}


@dataclass(frozen=True)
class Environment:
    name: str
    variables: dict[str, str | None] = field(default_factory=dict)
    """What is set, or, where None, is not there."""
    shell: str = "exec "
    """Before the command."""
    after: str = " > out"


def environments(root: Path) -> list[Environment]:
    read_only = root / "read_only"
    read_only.mkdir(mode=0o555)
    # Root writes where nobody may: for root, as for others, a file in place of the folder is what cannot be written to.
    (root / "no_folder").write_text("")
    no_home = {"HOME": None, "XDG_CACHE_HOME": None}
    without = "--clear-groups --inh-caps=-all,+dac_read_search --ambient-caps=-all,+dac_read_search"
    someone = f"exec setpriv --reuid 54321 --regid 54321 {without} "
    nobody = f"exec setpriv --reuid 65534 --regid 65534 {without} "
    found = [
        Environment("as it is"),
        Environment("LANG=C", {"LANG": "C", "LC_ALL": "C"}),
        Environment("PYTHONIOENCODING=ascii", {"PYTHONIOENCODING": "ascii"}),
        Environment("PYTHONUTF8=0 in latin-1", {"PYTHONUTF8": "0", "PYTHONIOENCODING": "latin-1"}),
        Environment("NO_COLOR, TERM=dumb", {"NO_COLOR": "1", "TERM": "dumb"}),
        Environment("vectors of 128 bits", {"JAXGRASP_VECTOR_BITS": "128"}),
        Environment("then of 256 bits, the same cache", {"JAXGRASP_VECTOR_BITS": "256"}),
        Environment("HOME that is a file", {"HOME": str(root / "no_folder"), "XDG_CACHE_HOME": None}),
        Environment("standard output closed", after=" >&-"),
        Environment("all streams closed", after=" <&- >&- 2>&-"),
        Environment("standard output on a full disk", after=" > /dev/full"),
        Environment("into head", shell="", after=" | head -n 1 > out; exit ${PIPESTATUS[0]}"),
    ]
    if os.getuid() == 0 and shutil.which("setpriv"):
        found += [
            Environment("no HOME, no passwd entry", no_home, someone),
            Environment("read-only HOME", {"HOME": str(read_only), "XDG_CACHE_HOME": None}, someone),
            Environment("read-only XDG_CACHE_HOME", {"XDG_CACHE_HOME": str(read_only)}, someone),
            Environment("nobody", {"HOME": "/nonexistent", "XDG_CACHE_HOME": None}, nobody),
        ]
    return found


def outcome(arguments: list[str], given: Environment, home: Path) -> str:
    variables = {**os.environ, **{k: v for k, v in given.variables.items() if v is not None}}
    for name, value in given.variables.items():
        if value is None:
            variables.pop(name, None)
    command = shlex.join([*PROGRAM, *arguments])
    process = subprocess.run(
        ["bash", "-c", f"{given.shell}{command}{given.after}"],
        cwd=home,
        env=variables,
        capture_output=True,
        timeout=600,
    )
    said = process.stderr.decode("utf-8", "replace")
    lines = said.splitlines()
    if all(line.startswith("jaxgrasp: ") for line in lines):
        if process.returncode == 0:
            return f"works, says {len(lines)}" if lines else "works"
        if process.returncode == 2 and (len(lines) == 1 or ">&-" in given.after):
            return "one line, exit 2"
    print(given.name, arguments, process.returncode, said[-2000:], file=sys.stderr, flush=True)
    return f"**exit {process.returncode}, {len(lines)} lines**"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--output", type=Path)
    options.add_argument("--only", nargs="+", default=[""], help="environments with one of these in their name alone")
    options.add_argument("--command", nargs="+", choices=COMMANDS, default=[*COMMANDS])
    output = options.parse_args()
    lines = [f"| | {' | '.join(f'`{name}`' for name in output.command)} |", "|---|" + "---|" * len(output.command)]
    with tempfile.TemporaryDirectory() as name:
        root, home = Path(name), Path(name, "home")
        root.chmod(0o755)
        home.mkdir()
        home.chmod(0o777)
        write_grasps(home, 50, object_name=np.full(50, "größe 猫 $x_\\{"))
        write_hand_grasps(home, 4)
        write_runs(home, 20)
        for given in environments(root):
            if not any(part in given.name for part in output.only):
                continue
            cells = []
            for arguments in (COMMANDS[name] for name in output.command):
                prepare(home, arguments)
                (home / "out").touch()
                for path in (home, *home.rglob("*")):
                    path.chmod(0o777 if path.is_dir() else 0o666)
                cells.append(outcome(arguments, given, home))
                print(given.name, arguments[:3], cells[-1], file=sys.stderr, flush=True)
            lines.append(f"| {given.name} | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    if output.output:
        output.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
