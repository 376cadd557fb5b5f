"""What a direct call costs after the first: time, programs that are compiled, and memory of many sizes.

    python -m benchmarks.calls [--output benchmarks/calls.md]

Second calls are timed on 64 grasps, the best of ten. Memory is what a process holds more, its contacts included, after
100 sizes of a batch in a process of its own: narrow, from 101 to 200, and wide, from 66 to 6,402.
"""

from __future__ import annotations

import argparse
import gc
import os
import subprocess
import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite.clock import warn_if_busy  # noqa: E402
from benchmarks.suite.face import FUNCTIONS, grasps, pushes  # noqa: E402

SIZES = {"narrow": range(101, 201), "wide": range(66, 6403, 64)}
PUSHES = pushes(6)
ALL = FUNCTIONS | {"explain": lambda c, d: jg.explain(c, d, cone_edges=4).position_gain}


def second_call(name: str, contacts: jg.Contacts) -> tuple[float, int]:
    """Seconds of the best of ten calls after the first, and how many programs these compile."""
    compiled = []
    jax.block_until_ready(ALL[name](contacts, PUSHES))
    count = lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(count)
    times = []
    for _ in range(10):
        begun = time.perf_counter()
        jax.block_until_ready(ALL[name](contacts, PUSHES))
        times.append(time.perf_counter() - begun)
    return min(times), len(compiled)


def held() -> float:
    """MB of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def kept(name: str, spread: str) -> float:
    """MB that the sizes of a batch leave behind."""
    for size in (2, 4):
        jax.block_until_ready(ALL[name](grasps(size), PUSHES))
    before = held()
    for size in SIZES[spread]:
        jax.block_until_ready(ALL[name](grasps(size), PUSHES))
    return held() - before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--memory", nargs=2, metavar=("FUNCTION", "SIZES"), help="this figure, in this process")
    given = parser.parse_args()
    if given.memory:
        print(kept(*given.memory))
        return
    load = warn_if_busy()
    contacts = grasps(64)
    calls = [(name, *second_call(name, contacts)) for name in ALL]
    lines = ["| function | second call, ms | compiled |", "|---|---|---|"]
    lines += [f"| {name} | {1e3 * seconds:.1f} | {count} |" for name, seconds, count in calls]
    lines += ["", "| function | sizes | MB kept |", "|---|---|---|"]
    for name in ("margin", "effort"):
        for spread in SIZES:
            command = [sys.executable, "-W", "ignore", "-m", "benchmarks.calls", "--memory", name, spread]
            found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            lines.append(f"| {name} | {spread} | {float(found):.0f} |")
    lines += ["", f"{os.cpu_count()} cores, load {load:.1f} at the start, JAX {jax.__version__}."]
    text = f"{__doc__}\n" + "\n".join(lines) + "\n"
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    main()
