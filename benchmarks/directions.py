"""The cost of margins, beyond S_1 and S_2, for sets with more and more directions: `python -m benchmarks.directions`.

Writes directions.md beside this file. `--quick` prints two numbers of directions in float64.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import problems  # noqa: E402
from benchmarks.suite.clock import say, warn_if_busy  # noqa: E402

BATCH, CONTACTS, ROUNDS = 4096, 4, 40
SHARED = (6, 16, 64, 128, 256, 512, 1024, 2048, 4096)
OWN = (6, 64, 256, 1024)
"""Numbers of directions for sets of each grasp's own; 1,024 are 200 MB in float64."""

Call = Callable[[], object]


def directions(count: int, dtype: np.dtype, own: bool) -> jg.DisturbanceSet:
    """Random unit wrenches."""
    wrenches = np.random.default_rng(count).normal(size=((BATCH,) if own else ()) + (count, 6))
    return jg.DisturbanceSet.vertices((wrenches / np.linalg.norm(wrenches, axis=-1, keepdims=True)).astype(dtype))


def measure(count: int, dtype: np.dtype, own: bool, rounds: int) -> tuple[float, dict[str, float]]:
    """Seconds to compile and solve first, and processor milliseconds of a warm call by what is called."""
    grasps = problems.sample(BATCH, CONTACTS)
    contacts = jg.Contacts.from_frames(
        grasps.positions.astype(dtype),
        grasps.frames.astype(dtype),
        friction=problems.FRICTION,
        max_force=problems.MAX_FORCE,
    )
    disturbances = directions(count, dtype, own)

    def margin(form: str) -> Call:
        def call() -> object:
            with jg.audit(form):
                return jg.largest_disturbance(contacts, disturbances)

        return call

    calls: dict[str, Call] = {"rows": lambda: jg.worst_case(contacts, disturbances)}
    calls |= {"margin": margin("off"), "audited": margin("sampled")}
    start = time.process_time()
    jax.block_until_ready(calls["margin"]())
    first = time.process_time() - start
    for call in calls.values():
        jax.block_until_ready(call())
    seen: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            start = time.process_time()
            jax.block_until_ready(call())
            seen[name].append(1e3 * (time.process_time() - start))
    found = {name: min(times) for name, times in seen.items()}
    for name, more in (("margin", "beyond"), ("audited", "audited beyond")):
        found[more] = found[name] - found["rows"]
    return first, found


def table(counts: tuple[int, ...], dtype: np.dtype, own: bool, rounds: int) -> list[str]:
    """Rows of the table for one precision."""
    lines, least = [], {}
    for count in counts:
        first, found = measure(count, dtype, own, rounds)
        ratios = []
        for name in ("beyond", "audited beyond"):
            least.setdefault(name, found[name])
            ratios.append(f"{found[name]:.1f} ({found[name] / least[name]:.2f})")
        kind = "each its own" if own else "shared"
        cells = [dtype.name, kind, f"{count:,}", f"{first:.1f}", f"{found['rows']:.1f}", f"{found['margin']:.1f}"]
        cells += [ratios[0], f"{found['audited']:.1f}", ratios[1]]
        lines.append(f"| {' | '.join(cells)} |")
        say(lines[-1])
    return lines


HEAD = """| precision | directions | number | first, s | S_1, S_2 | margin | beyond (of the first) | audited | beyond |
|---|---|---|---|---|---|---|---|---|"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    if parser.parse_args().quick:
        table((6, 256), np.dtype(np.float64), False, 10)
        return
    load = warn_if_busy()
    dtypes = (np.dtype(np.float64), np.dtype(np.float32))
    rows = [row for dtype in dtypes for row in table(SHARED, dtype, False, ROUNDS)]
    rows += [row for dtype in dtypes for row in table(OWN, dtype, True, ROUNDS // 4)]
    text = f"""# Margins of many directions

`python -m benchmarks.directions`, {platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}, load {load:.1f}.
{BATCH:,} grasps of {CONTACTS} contacts; processor milliseconds, best of {ROUNDS} rounds by turns. "Beyond" is what a
margin takes more than S_1 and S_2 by themselves, without an audit and with the default one; in brackets, over that of
six directions.
"first" is the processor time of the first call, compilation included.

{HEAD}
{chr(10).join(rows)}
"""
    Path(__file__).with_suffix(".md").write_text(text)
    say(text)


if __name__ == "__main__":
    main()
