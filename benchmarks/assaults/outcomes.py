"""Giving one file to a command, in a forked process or as a command of its own, and what comes of it."""

from __future__ import annotations

import collections
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.assaults.inputs import Case

SECONDS, MEBIBYTES, KILLED_AFTER = 10.0, 600.0, 180.0


@dataclass(frozen=True)
class Outcome:
    case: Case
    code: int
    """Negative for a signal."""
    errors: str
    seconds: float
    """Processor time, that of its children included, s."""
    mebibytes: float
    accepted_wrongly: str = ""

    @property
    def faults(self) -> list[str]:
        found = []
        if self.code == 2 and (self.errors.count("\n") != 1 or not self.errors.startswith("jaxgrasp: ")):
            found.append("not one line")
        if self.code == 0 and not all(line.startswith("jaxgrasp: ") for line in self.errors.splitlines()):
            found.append("said something else")
        if self.code not in (0, 2):
            found.append(f"exit {self.code}")
        if self.seconds > SECONDS:
            found.append("slow")
        if self.mebibytes > MEBIBYTES:
            found.append("large")
        if self.accepted_wrongly:
            found.append(self.accepted_wrongly)
        return found


def forked(case: Case, arguments: Sequence[str], home: Path, before: Callable[[], None] = lambda: None) -> Outcome:
    """Runs the command's `main` in a child of this process, which has imported everything.

    `before` is called in the child, which may change the package there.
    """
    begun = time.perf_counter()
    child = os.fork()
    if child == 0:
        code = 70
        try:
            os.chdir(home)
            for number, name in ((1, "out"), (2, "err")):
                os.dup2(os.open(home / name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), number)
            sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
            before()
            from jaxgrasp.cli import main

            code = main(list(arguments))
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else 70
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    return _outcome(case, home, *_wait(child, begun))


def commanded(case: Case, arguments: Sequence[str], home: Path) -> Outcome:
    """Runs one as a command, whose time and memory include the start of Python and of what it imports."""
    begun = time.perf_counter()
    command = [sys.executable, "-m", "jaxgrasp.cli", *arguments]
    with open(home / "err", "w") as errors:
        process = subprocess.Popen(command, cwd=home, stdout=subprocess.DEVNULL, stderr=errors)
        found = _outcome(case, home, *_wait(process.pid, begun))
        process.returncode = found.code
    return found


def _outcome(case: Case, home: Path, code: int, usage: resource.struct_rusage) -> Outcome:
    errors = (home / "err").read_text("utf-8", "replace")
    return Outcome(case, code, errors, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def _wait(child: int, begun: float) -> tuple[int, resource.struct_rusage]:
    while True:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), usage
        if time.perf_counter() - begun > KILLED_AFTER:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.005)


def table(found: list[Outcome], title: str) -> str:
    lines = [
        f"## {title}",
        "",
        "| kind | tried | refused, one line | accepted | otherwise | slowest, s | largest, MiB |",
    ]
    lines.append("|---|---:|---:|---:|---:|---:|---:|")
    kinds = collections.defaultdict(list)
    for outcome in found:
        kinds[outcome.case.kind].append(outcome)
    for kind, rows in [*kinds.items(), ("all", found)]:
        refused = sum(row.code == 2 and not row.faults for row in rows)
        accepted = sum(row.code == 0 and not row.faults for row in rows)
        slowest, largest = max(row.seconds for row in rows), max(row.mebibytes for row in rows)
        cells = [len(rows), refused, accepted, len(rows) - refused - accepted, f"{slowest:.1f}", f"{largest:.0f}"]
        lines.append(f"| {kind} | {' | '.join(map(str, cells))} |")
    lines += [""] + [f"- {r.case.kind} {r.case.name[:60]!r}: {', '.join(r.faults)}" for r in found if r.faults]
    return "\n".join(lines) + "\n"
