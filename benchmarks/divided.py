"""Batches that are divided over four devices of one CPU, against the batch by itself.

    python -m benchmarks.divided [--batch 16384] [--rounds 9] [--output benchmarks/divided.md]

Rates by turns in one run, whether the compiled program sends anything between devices, and the largest difference of
any result.
"""

from __future__ import annotations

import argparse
import os
import re
from functools import partial
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 4)

import numpy as np  # noqa: E402
from jax.sharding import AxisType, NamedSharding  # noqa: E402
from jax.sharding import PartitionSpec as P  # noqa: E402

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite.clock import by_turns, warn_if_busy  # noqa: E402
from benchmarks.suite.face import FUNCTIONS, grasps, pushes  # noqa: E402
from benchmarks.ways import slope as slope_of  # noqa: E402

SENT = re.compile(r"\b(all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter)")
PUSHES = pushes(6)


def margin(c: jg.Contacts) -> jax.Array:
    return FUNCTIONS["margin"](c, PUSHES)


def effort(c: jg.Contacts) -> jax.Array:
    return FUNCTIONS["effort"](c, PUSHES)


def slope(c: jg.Contacts) -> jax.Array:
    return slope_of(margin, c)


def wait_for(run, contacts: jg.Contacts) -> None:
    jax.block_until_ready(run(contacts))


def measured(function, batch: int, rounds: int) -> list[str]:
    """Rows of the table: with automatic and with explicit axes."""
    contacts = grasps(batch)
    programs = {"alone": (jax.jit(function).lower(contacts).compile(), contacts)}
    for kind in (AxisType.Auto, AxisType.Explicit):
        mesh = jax.make_mesh((4,), ("g",), axis_types=(kind,))
        spread = jax.device_put(contacts, NamedSharding(mesh, P("g")))
        programs[kind.name] = jax.jit(function).lower(spread).compile(), spread
    jobs = {name: partial(wait_for, *own) for name, own in programs.items()}
    timings = by_turns(jobs, rounds)
    results = {name: np.asarray(run(x)) for name, (run, x) in programs.items()}
    rows = []
    for name in (AxisType.Auto.name, AxisType.Explicit.name):
        apart = np.nanmax(np.abs(results[name] - results["alone"]))
        rate = timings["alone"].seconds / timings[name].seconds
        sent = ", ".join(sorted(set(SENT.findall(programs[name][0].as_text())))) or "nothing"
        rows.append(f"| {function.__name__} | {name.lower()} | {rate:.2f} | {sent} | {apart:.1e} |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=16_384)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    load = warn_if_busy()
    rows = [row for function in (margin, effort, slope) for row in measured(function, given.batch, given.rounds)]
    text = f"""`python -m benchmarks.divided`: {given.batch:,} grasps divided over four devices of a CPU with {os.cpu_count()} cores, best of
{given.rounds} by turns, load {load:.1f} at the start. Rates are in those of the batch by itself.

| function | axes of the mesh | rate | sent | largest difference |
|---|---|---|---|---|
{chr(10).join(rows)}
"""  # noqa: E501
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    main()
