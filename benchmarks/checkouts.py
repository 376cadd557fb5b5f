"""Kernel programs of this package against those of another checkout, by turns in one run, without audits.

    git worktree add ../before 509c6ad
    python -m benchmarks.checkouts ../before [--batch 16384] [--rounds 15]

Each checkout has a process of its own, and the two take turns call by call. Printed are the best times and their ratio.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.suite.clock import warn_if_busy

WORKER = """
import sys, time
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np
import jaxgrasp as jg
from jaxgrasp.compiling import options
assert jg.__file__.startswith(sys.argv[1]), jg.__file__
batch = int(sys.argv[2])
normals = np.random.default_rng(5).normal(size=(batch, 4, 3))
normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
pushes = jg.DisturbanceSet.forces(1.0)
def contacts(normals):
    return jg.Contacts.from_normals(0.05 * normals, normals, friction=0.5, max_force=1.0)
def margin(normals):
    return jg.largest_disturbance(contacts(normals), pushes).margin
def slope(normals):
    return jax.grad(lambda n: jnp.nan_to_num(margin(n)).sum())(normals)
def slope_of_contacts(normals):
    # Frames are constants: how tangents follow from normals has changed, and is no kernel's work.
    frames = known[normals.dtype.name]
    def total(positions, frames):
        moved = jg.Contacts.from_frames(positions, frames, friction=0.5, max_force=1.0)
        return jnp.nan_to_num(jg.largest_disturbance(moved, pushes).margin).sum()
    return jax.grad(total, (0, 1))(0.05 * normals, frames)
def effort(normals):
    return jg.least_effort(contacts(normals), pushes, 0.1).effort
known = {dtype: contacts(jnp.asarray(normals, dtype)).frames for dtype in ("float64", "float32")}
programs = {"margin": margin, "gradient": slope, "gradient by contacts": slope_of_contacts, "effort": effort}
ready = {}
for dtype in ("float64", "float32"):
    given = jnp.asarray(normals, dtype)
    for name, program in programs.items():
        compiled = jax.jit(program, compiler_options=options()).lower(given).compile()
        ready[f"{name} {dtype}"] = compiled, given
        jax.block_until_ready(compiled(given))
print(";".join(ready), flush=True)
for line in sys.stdin:
    program, given = ready[line.strip()]
    begun = time.perf_counter()
    jax.block_until_ready(program(given))
    print(time.perf_counter() - begun, flush=True)
"""


class Worker:
    """A process with the programs of one checkout."""

    def __init__(self, checkout: Path, batch: int, home: str) -> None:
        environment = {**os.environ, "PYTHONPATH": str(checkout), "JAXGRASP_AUDIT": "off"}
        command = [sys.executable, "-W", "ignore", "-c", WORKER, str(checkout), str(batch)]
        self.process = subprocess.Popen(
            command, cwd=home, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def said(self) -> str:
        assert self.process.stdout
        line = self.process.stdout.readline().strip()
        if not line:
            raise SystemExit(f"{self.process.args[-2]}: its programs do not run")
        return line

    def time(self, name: str) -> float:
        assert self.process.stdin
        self.process.stdin.write(name + "\n")
        self.process.stdin.flush()
        return float(self.said())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("before", type=Path)
    parser.add_argument("--batch", type=int, default=16_384)
    parser.add_argument("--rounds", type=int, default=15)
    given = parser.parse_args()
    load = warn_if_busy()
    here = Path(__file__).resolve().parent.parent
    with tempfile.TemporaryDirectory() as home:
        workers = [Worker(checkout.resolve(), given.batch, home) for checkout in (given.before, here)]
        names = [worker.said().split(";") for worker in workers][0]
        best = {name: [float("inf")] * 2 for name in names}
        for round_ in range(given.rounds):
            for name in names:
                for i in (0, 1) if round_ % 2 else (1, 0):
                    best[name][i] = min(best[name][i], workers[i].time(name))
        for worker in workers:
            worker.process.communicate()
    print(f"{given.batch:,} grasps, four contacts, eight edges, best of {given.rounds} by turns, load {load:.1f}\n")
    print("| program | before, ms | here, ms | ratio |\n|---|---|---|---|")
    for name, (before, now) in best.items():
        print(f"| {name} | {1e3 * before:.2f} | {1e3 * now:.2f} | {now / before:.3f} |")


if __name__ == "__main__":
    main()
