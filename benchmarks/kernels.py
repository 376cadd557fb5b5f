"""Fused kernels against XLA, a hand-written C++ solver and what the processor can do at most.

    python -m benchmarks.kernels [--quick]

writes kernels.md beside itself (--quick: fewer shapes, writes nothing). Floating-point operations are counted in the
kernel's own program: a loop's as often as the mean lane goes round; the peak is the rate of a kernel that does nothing
but multiply and add, in the same run. Every figure is the best of several rounds by turns, warm.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

import jaxgrasp as jg
from benchmarks.suite import floor, ours, problems
from benchmarks.suite.clock import by_turns, say, warn_if_busy
from jaxgrasp import kernels
from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.cpu import module as cpu
from jaxgrasp.kernels.program import lowering, schedule
from jaxgrasp.kernels.store import folder

DTYPES = ("float64", "float32")
ROUNDS = 7
SHAPES = ((4, 8), (3, 8), (5, 8), (8, 8), (12, 8), (20, 8), (4, 4), (4, 16))
BATCHES = (16_384, 262_144)
# Operations of numbers; the others only choose, compare or move.
COUNTED = {"add", "sub", "mul", "div", "max", "min", "sqrt", "rsqrt"}

FIRST = """
import time; start = time.perf_counter()
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxgrasp as jg
p = np.random.default_rng(0).normal(size=(64, 4, 3))
contacts = jg.Contacts.from_normals(p, p, friction=0.5, max_force=1.0)
jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0)).margin.block_until_ready()
print(time.perf_counter() - start)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="four contacts and one batch size; writes nothing")
    quick = parser.parse_args().quick
    jax.config.update("jax_num_cpu_devices", min(2, os.cpu_count() or 1))
    jax.config.update("jax_enable_x64", True)
    if not kernels.usable():
        sys.exit("there are no fused kernels on this machine")
    load = warn_if_busy()
    lines = [
        "# Fused kernels",
        "",
        f"`python -m benchmarks.kernels`, {os.cpu_count()} cores, {llvm.processor().description.split(',')[0]}, "
        f"load average at the start {load:.1f}.",
        "",
        *first_answers(),
        *headline(BATCHES[:1] if quick else BATCHES),
        *shapes(SHAPES[:1] if quick else SHAPES),
        *around(),
    ]
    text = "\n".join(lines) + "\n"
    say(text)
    if not quick:
        (Path(__file__).parent / "kernels.md").write_text(text)


def contacts_of(grasps: problems.Grasps, dtype: str) -> jg.Contacts:
    positions, frames = grasps.positions.astype(dtype), grasps.frames.astype(dtype)
    friction, max_force = (np.asarray(x, dtype) for x in (problems.FRICTION, problems.MAX_FORCE))
    return jg.Contacts.from_frames(positions, frames, friction=friction, max_force=max_force)


def margins(contacts: jg.Contacts, disturbances: jg.DisturbanceSet, edges: int = 8):
    return functools.partial(jg.largest_disturbance, contacts, disturbances, cone_edges=edges)


def job(function):
    def run() -> None:
        jax.block_until_ready(function())

    return run


def on_xla(function, *args):
    """Compiled without kernels, spread over two devices where there are any, as XLA itself uses one core."""
    jax.clear_caches()
    with kernels.without():
        run = ours.Compiled(function, *args, min(2, len(jax.local_devices())))
    jax.clear_caches()
    return run.run


@contextlib.contextmanager
def watched() -> Iterator[list]:
    """The programs that become kernels inside."""
    seen: list = []
    register = primitive.register

    def watching(plan):
        seen.append((plan.trace(), plan.shared))
        return register(plan)

    primitive.register = watching
    try:
        yield seen
    finally:
        primitive.register = register


def flops(jaxpr, shared, iterations: float) -> float:
    """Operations on numbers for one problem."""
    order = schedule.schedule(lowering.lower(jaxpr, list(shared)))
    total, inside = 0.0, []
    for event in order.events:
        if event.what == "enter":
            step = event.subject
            # A guard is for what hardly any grasp needs.
            often = 0.0 if isinstance(step, lowering.Guard) else iterations if step.rounds is None else step.rounds
            inside.append(often)
        elif event.what == "leave":
            inside.pop()
        elif event.what == "compute" and event.subject.op in COUNTED and event.subject.kind == "f":
            products = sum(x in order.fused for x in event.subject.args)
            total += (1 + products) * float(np.prod(inside))
    return total


CHAINS, IN_TURN, LOOPS = 16, 16, 200


def multiply_adds(batch: int, dtype: str):
    """Nothing but multiplications that are part of an addition, as many at a time as registers hold; and how many."""

    def function(parts):
        (x,) = parts

        def more(_, chains):
            for _ in range(IN_TURN):
                chains = tuple(v * x + x for v in chains)
            return chains

        return sum(jax.lax.fori_loop(0, LOOPS, more, tuple(x * (1 + i) for i in range(CHAINS))))

    halves = jax.numpy.full(batch, 0.5, dtype)
    run = jax.jit(lambda x: kernels.fused(function, [x], (False,), no_kernel))
    return job(functools.partial(run, halves)), 2.0 * batch * CHAINS * IN_TURN * LOOPS


def no_kernel(_leaves):
    raise AssertionError("there is a fused kernel")


def headline(batches) -> list[str]:
    """Contacts to margins, four contacts, eight edges, six directions."""
    lines = [
        "## Contacts to margins",
        "",
        "Four contacts, eight edges, the six forces. The C++ solver starts after S_1 and S_2, has no bounds and no "
        "status, and takes as many steps as it is told: ten, and as many as ours in the mean, which is between two "
        "whole numbers, and so is its time.",
        "",
        "| batch | precision | | grasps/s | cpu/wall | of C++, 10 steps | of C++, same steps |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    library = floor.build()
    for batch in batches:
        grasps = problems.sample(batch, 4)
        programs = problems.programs(grasps)
        for dtype in DTYPES:
            contacts, forces = contacts_of(grasps, dtype), jg.DisturbanceSet.forces(1.0)
            solve = margins(contacts, forces)
            steps = float(solve().iterations.mean())
            jobs = {"fused kernel": job(solve)}
            jobs["S_1 and S_2 alone"] = job(lambda: jg.worst_case(contacts, forces))  # noqa: B023
            if batch == BATCHES[0]:
                jobs["XLA"] = on_xla(jg.largest_disturbance, contacts, forces)
            counts = [] if isinstance(library, str) else [10, math.floor(steps), math.floor(steps) + 1]
            for count in counts:
                solver = floor.Floor(library, grasps, programs, dtype)
                jobs[f"C++, {count} steps"] = functools.partial(run_floor, solver, count)
            timings = by_turns(jobs, ROUNDS)
            ten, fewer, more = (timings[f"C++, {count} steps"].seconds for count in counts) if counts else (0, 0, 0)
            same = fewer + (steps - math.floor(steps)) * (more - fewer)
            for name, timing in timings.items():
                shares = [f"{seconds / timing.seconds:.2f}" if counts else "-" for seconds in (ten, same)]
                lines.append(
                    f"| {batch:,} | {dtype} | {name} | {batch / timing.seconds:,.0f} | {timing.cpu_per_wall:.2f} | "
                    + " | ".join(shares if name in ("fused kernel", "XLA") else ["", ""])
                    + " |"
                )
            lines.append(f"| {batch:,} | {dtype} | mean steps {steps:.2f} | | | | |")
    return [*lines, ""]


def run_floor(it: floor.Floor, count: int) -> None:
    floor.ITERATIONS = count
    it.run()


def shapes(chosen) -> list[str]:
    """Numbers of contacts and edges, as shares of the peak."""
    lines = [
        "## Numbers of contacts and edges",
        "",
        f"Batch {BATCHES[0]:,}, the six forces. Operations of the mean grasp, against nothing but multiply-adds.",
        "",
        "| contacts | edges | precision | grasps/s | steps | flop | Gflop/s | of the peak | compile, s | disk, ms |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for dtype in DTYPES:
        for contacts_count, edges in chosen:
            grasps = problems.sample(BATCHES[0], contacts_count)
            solve = margins(contacts_of(grasps, dtype), jg.DisturbanceSet.forces(1.0), edges)
            jax.clear_caches()
            with watched() as seen:
                solution = solve()
            if not seen:
                lines.append(f"| {contacts_count} | {edges} | {dtype} | no fused kernel | | | | | | |")
                continue
            steps = float(solution.iterations.mean())
            jaxpr, shared = seen[0]
            cold, warm = compile_seconds(jaxpr, shared)
            work = flops(jaxpr, shared, steps)
            peak_job, peak_work = multiply_adds(BATCHES[0], dtype)
            timings = by_turns({"margins": job(solve), "peak": peak_job}, ROUNDS)
            rate = BATCHES[0] / timings["margins"].seconds
            peak = peak_work / timings["peak"].seconds
            lines.append(
                f"| {contacts_count} | {edges} | {dtype} | {rate:,.0f} | {steps:.2f} | {work:,.0f} | "
                f"{rate * work / 1e9:.1f} | {rate * work / peak:.2f} | {cold:.1f} | {1e3 * warm:.0f} |"
            )
            say(lines[-1])
    return [*lines, ""]


def around() -> list[str]:
    """Gradients, other sets, many directions."""
    batch = BATCHES[0]
    grasps = problems.sample(batch, 4)
    directions = np.random.default_rng(1).normal(size=(4096, 6))
    lines = [
        "## Gradients, sets, many directions",
        "",
        f"Batch {batch:,}, four contacts, eight edges.",
        "",
        "| precision | | times the margin under six forces |",
        "| --- | --- | --- |",
    ]
    tail = ["", "| precision | S_1 and S_2, 4,096 directions | peak | of the peak |", "| --- | --- | --- | --- |"]
    for dtype in DTYPES:
        contacts = contacts_of(grasps, dtype)
        forces = jg.DisturbanceSet.forces(1.0)

        def margin(positions, contacts=contacts, forces=forces):
            moved = jg.Contacts.from_frames(
                positions, contacts.frames, friction=contacts.friction, max_force=contacts.max_force
            )
            return jg.largest_disturbance(moved, forces).margin.sum()

        value, gradient = jax.jit(margin), jax.jit(jax.value_and_grad(margin))
        box = jg.DisturbanceSet.box(np.ones(6, dtype))
        ball = jg.DisturbanceSet.ball(1.0, 0.1)
        many = jg.DisturbanceSet.vertices(directions.astype(dtype))
        jobs = {
            "margin": job(lambda: value(contacts.positions)),  # noqa: B023
            "margin with gradient": job(lambda: gradient(contacts.positions)),  # noqa: B023
            "box": job(margins(contacts, box)),
            "ball": job(margins(contacts, ball)),
            "six forces": job(margins(contacts, forces)),
            "directions": job(lambda: jg.worst_case(contacts, many)),  # noqa: B023
        }
        jobs["peak"], peak_work = multiply_adds(batch, dtype)
        with watched() as seen:
            jg.worst_case(contacts, many)
        timings = by_turns(jobs, ROUNDS)
        for name, base in (("margin with gradient", "margin"), ("box", "six forces"), ("ball", "six forces")):
            lines.append(f"| {dtype} | {name} | {timings[name].seconds / timings[base].seconds:.2f} |")
        peak = peak_work / timings["peak"].seconds
        rate = batch / timings["directions"].seconds
        share = rate * flops(*seen[-1], 1.0) / peak
        tail.append(f"| {dtype} | {rate:,.0f} grasps/s | {1e-9 * peak:,.0f} Gflop/s | {share:.2f} |")
    return [*lines, *tail, ""]


def compile_seconds(jaxpr, shared) -> tuple[float, float]:
    """From a jaxpr to object code, and from what is kept on disk to a function."""
    start = time.perf_counter()
    program, at = lowering.lower(jaxpr, list(shared)), llvm.processor()
    width = at.vector_bytes // program.builder.dtype.itemsize
    objects = llvm.compile_module(cpu.write_module(program, "timed", width, estimates=at.estimates))
    cold = time.perf_counter() - start
    folder.keep("timed", objects)
    start = time.perf_counter()
    llvm.load(folder.read("timed"), "timed")
    return cold, time.perf_counter() - start


def first_answers() -> list[str]:
    """Fresh processes, the imports included."""
    lines = ["## The first answer of a fresh process", "", "Imports included, 64 grasps, float64.", ""]
    lines += ["| | s |", "| --- | --- |"]
    with tempfile.TemporaryDirectory() as folder:
        for name, more in (
            ("nothing compiled before", {}),
            ("kernel kept on disk", {}),
            ("XLA alone", {"JAXGRASP_KERNELS": "xla"}),
        ):
            environment = {**os.environ, "XDG_CACHE_HOME": folder, **more}
            took = [
                float(
                    subprocess.run(
                        [sys.executable, "-c", FIRST], env=environment, capture_output=True, check=True
                    ).stdout
                )
                for _ in range(3 if name == "kernel kept on disk" else 1)
            ]
            lines.append(f"| {name} | {min(took):.1f} |")
            say(lines[-1])
    return [*lines, ""]


if __name__ == "__main__":
    main()
