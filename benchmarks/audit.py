"""What the audit of answers costs, by turns in one run: `python -m benchmarks.audit`.

Writes audit.md beside this file.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import problems  # noqa: E402
from benchmarks.suite.clock import by_turns, say, warn_if_busy  # noqa: E402
from jaxgrasp.robustness.auditing.setting import FORMS  # noqa: E402

BATCH, CONTACTS, ROUNDS, SHARE = 16_384, 4, 25, 0.75
FORCES = jg.DisturbanceSet.forces(1.0)
FIRST = """
import sys, time
start = time.perf_counter()
import jax
jax.config.update("jax_enable_x64", True)
if len(sys.argv) > 1:
    jax.config.update("jax_compilation_cache_dir", sys.argv[1])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
import jaxgrasp as jg
from benchmarks.suite import problems
grasps = problems.sample(64, 4)
contacts = jg.Contacts.from_frames(grasps.positions, grasps.frames, friction=0.5, max_force=10.0)
jax.block_until_ready(jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0)).margin)
print(time.perf_counter() - start)
"""


def measure(dtype: type) -> list[str]:
    """Rows of the table: milliseconds of each program under every form, and what the audit adds."""
    grasps = problems.sample(BATCH, CONTACTS)
    contacts = jg.Contacts.from_frames(
        grasps.positions.astype(dtype),
        grasps.frames.astype(dtype),
        friction=problems.FRICTION,
        max_force=problems.MAX_FORCE,
    )
    margin = np.maximum(np.asarray(jg.largest_disturbance(contacts, FORCES).margin), 0) * dtype(SHARE)
    programs = {
        "margin": lambda: jg.largest_disturbance(contacts, FORCES),
        "effort": lambda: jg.least_effort(contacts, FORCES, margin),
    }

    def audited(program, form: str):
        def job() -> None:
            with jg.audit(form):
                jax.block_until_ready(program())

        return job

    jobs = {f"{name} {form}": audited(program, form) for name, program in programs.items() for form in FORMS}
    timings = by_turns(jobs, ROUNDS)
    rows = []
    for name in programs:
        off = timings[f"{name} off"].seconds
        cells = [f"{1e3 * off:.1f}"]
        for form in FORMS[:-1]:
            found = timings[f"{name} {form}"].seconds
            cells.append(f"{1e3 * (found - off):.1f} ({(found - off) / off:.2f})")
        rows.append(f"| {np.dtype(dtype).name} | {name} | {' | '.join(cells)} |")
    return rows


def first_answers() -> list[str]:
    """Rows of the table: seconds to a first answer in a new process, best of four, by what is on disk."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, caches in {
            "kernels and XLA's programs": (True, folder),
            "kernels": (True,),
            "nothing": (False,),
        }.items():
            seconds = {form: min(_first(form, *caches) for _ in range(4)) for form in FORMS}
            say(f"  first answer, {name} on disk: {seconds}")
            cells = " | ".join(f"{seconds[form]:.2f}" for form in ("off", *FORMS[:-1]))
            rows.append(f"| {name} | {cells} |")
    return rows


def _first(form: str, kernels: bool, programs: str | None = None) -> float:
    """Seconds to a first answer, with kernels on disk or without, and XLA's programs in a folder or nowhere."""
    with tempfile.TemporaryDirectory() as folder:
        setting = os.environ | {"JAXGRASP_AUDIT": form} | ({} if kernels else {"XDG_CACHE_HOME": folder})
        command = [sys.executable, "-c", FIRST, *([programs] if programs else [])]
        return float(subprocess.run(command, env=setting, capture_output=True, text=True, check=True).stdout)


def main() -> None:
    load = warn_if_busy()
    rows = [row for dtype in (np.float64, np.float32) for row in measure(dtype)]
    text = f"""# What the audit costs

`python -m benchmarks.audit`, {platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}, load {load:.1f}.
{BATCH:,} grasps of {CONTACTS} contacts, six forces, best of {ROUNDS} rounds by turns; in brackets, of the solve.

| precision | program | off, ms | sampled adds, ms | strict adds, ms |
|---|---|---|---|---|
{chr(10).join(rows)}

Seconds to the first margins of 64 grasps in a new process, imports included, best of four:

| on disk | off | sampled | strict |
|---|---|---|---|
{chr(10).join(first_answers())}
"""
    Path(__file__).with_suffix(".md").write_text(text)
    say(text)


if __name__ == "__main__":
    main()
