"""What derivatives cost, in units of a solve: `python -m benchmarks.derivatives`.

Writes derivatives.md beside this file.
"""

from __future__ import annotations

import os
import platform
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import problems  # noqa: E402
from benchmarks.suite.clock import by_turns, warn_if_busy  # noqa: E402
from jaxgrasp.compiling import options  # noqa: E402

BATCH, CONTACTS, ROUNDS = 16_384, 4, 9
SMOOTHING = 1e-3
FORCES = jg.DisturbanceSet.forces(1.0)


def solve(positions, frames, smoothing=None) -> jg.Solution:
    contacts = jg.Contacts.from_frames(positions, frames, friction=problems.FRICTION, max_force=problems.MAX_FORCE)
    return jg.largest_disturbance(contacts, FORCES, smoothing=smoothing)


def margin(positions, frames):
    return jnp.sum(jnp.nan_to_num(solve(positions, frames).margin))


def programs(weights: jax.Array) -> dict:
    """By name: what is differentiated, and its derivative with respect to positions and frames."""

    def pulled(positions, frames, smoothing):
        forces = solve(positions, frames, smoothing).forces
        return jnp.sum(jnp.where(jnp.isfinite(forces), forces, 0) * weights)

    smooth = lambda positions, frames: solve(positions, frames, SMOOTHING).forces  # noqa: E731
    return {
        "margin": lambda *x: solve(*x).margin,
        "margin and its gradient": jax.value_and_grad(margin, argnums=(0, 1)),
        "exact forces and their vector-Jacobian product": jax.value_and_grad(
            lambda *x: pulled(*x, None), argnums=(0, 1)
        ),
        "smoothed forces": smooth,
        "smoothed forces and their vector-Jacobian product": jax.value_and_grad(
            lambda *x: pulled(*x, SMOOTHING), argnums=(0, 1)
        ),
    }


def wait_for(program, x: tuple) -> None:
    jax.block_until_ready(program(*x))


def measure(dtype) -> list[str]:
    grasps = problems.sample(BATCH, CONTACTS)
    x = jnp.asarray(grasps.positions, dtype), jnp.asarray(grasps.frames, dtype)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(BATCH, CONTACTS, 3)), dtype)
    jobs, compiled = {}, {}
    for name, program in programs(weights).items():
        start = time.perf_counter()
        ready = jax.jit(program, compiler_options=options()).lower(*x).compile()
        compiled[name] = time.perf_counter() - start
        jobs[name] = partial(wait_for, ready, x)
    timings = by_turns(jobs, ROUNDS)
    base = timings["margin"].seconds
    precision = jnp.dtype(dtype).name
    return [
        f"| {precision} | {name} | {1e6 * t.seconds / BATCH:.1f} | {t.seconds / base:.2f} | {compiled[name]:.0f} |"
        for name, t in timings.items()
    ]


def main() -> None:
    load = warn_if_busy()
    rows = [*measure(jnp.float64), *measure(jnp.float32)]
    text = f"""# What derivatives cost

`python -m benchmarks.derivatives`: {BATCH:,} random grasps with {CONTACTS} contacts, eight edges, six unit forces, on
one device, best of {ROUNDS} rounds by turns, warm. Derivatives are with respect to positions and frames; smoothing is
{SMOOTHING:g}. Each line includes the solve that it differentiates.

| precision | | us a grasp | in margins | compiled in s |
|---|---|---|---|---|
{chr(10).join(rows)}

Python {platform.python_version()}, JAX {jax.__version__}, {os.cpu_count()} cores, load {load:.1f} at the start.
"""
    Path(__file__).with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
