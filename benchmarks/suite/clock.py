"""Timing by turns: every job once a round, so that what disturbs the machine disturbs all of them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

# A round slower than this times the best one was disturbed by something else.
NOISY = 1.15

Job = Callable[[], float | None]
"""Does the work and waits for it; returns processor seconds spent in other processes, if any."""


@dataclass(frozen=True)
class Timing:
    seconds: float
    """Best round."""
    cpu_per_wall: float
    """Processor seconds a second in that round: near the number of cores where all were at work."""
    rounds: int
    discarded: int
    """Rounds that were more than `NOISY` times as long as the best."""


def by_turns(jobs: dict[str, Job], rounds: int) -> dict[str, Timing]:
    """Time warm jobs; the first call of each is not counted."""
    for job in jobs.values():
        job()
    seen: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            start, cpu = time.perf_counter(), time.process_time()
            elsewhere = job() or 0.0
            wall = time.perf_counter() - start
            seen[name].append((wall, (time.process_time() - cpu + elsewhere) / wall))
    timings = {}
    for name, pairs in seen.items():
        best, cpu_per_wall = min(pairs)
        discarded = sum(wall > NOISY * best for wall, _ in pairs)
        timings[name] = Timing(best, cpu_per_wall, rounds, discarded)
        say(
            f"  {name}: {1e3 * best:.3g} ms, cpu/wall {cpu_per_wall:.2f}"
            + (f", {discarded} of {rounds} rounds discarded as noisy" if discarded else "")
        )
    return timings


def say(text: str) -> None:
    print(text, flush=True)


def warn_if_busy() -> float:
    """The load average of the last minute; other people's work makes every figure worthless."""
    load = os.getloadavg()[0]
    if load > 0.5:
        say(f"The machine is not idle: load average {load:.1f}. Ratios may hold, times do not.")
    return load
