"""Kernels for GPUs against XLA, where there is a GPU; what the assembler makes of them, anywhere.

    python -m benchmarks.gpu_kernels [--inspect | --quick]

Without options both, written to gpu_kernels.md beside itself; that needs a GPU of NVIDIA's. --quick: one batch size,
written nowhere. --inspect: only what `ptxas` says (on the path, or from the package nvidia-cuda-nvcc), which needs no
GPU. Every time is the best of several rounds by turns, warm, on data that are on the device already.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import site
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import llvmlite.binding as llvm
import numpy as np

import jaxgrasp as jg
from benchmarks.kernels import contacts_of, job, watched
from benchmarks.suite import problems
from benchmarks.suite.clock import by_turns, say
from jaxgrasp import kernels
from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.gpu import module as gpu
from jaxgrasp.kernels.program import lowering

DTYPES = ("float64", "float32")
SHAPES = ((4, 8), (3, 8), (5, 8), (8, 8))
CAPABILITIES = (80, 90)
BATCHES = tuple(2**k for k in range(14, 23, 2))
ROUNDS = 5
# Of max(|margin|, 1 N), the set's own force; in float32 rounding holds some gaps open that are otherwise closed.
SAME_MARGIN = {"float64": 2e-8, "float32": 1e-3}
RESULT = Path(__file__).parent / "gpu_kernels.md"


@dataclass(frozen=True)
class Assembled:
    """What `ptxas` says of a kernel."""

    registers: int
    stack: int
    """Bytes of a thread's own memory, as are the next two; those are of instructions in the code, not of their runs."""
    stores: int
    loads: int
    code: int
    """Bytes of instructions."""
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inspect", action="store_true", help="only what ptxas says; needs no GPU")
    parser.add_argument("--quick", action="store_true", help="one batch size; writes nothing")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    os.environ[primitive.SETTING] = "fused"
    there = jax.default_backend() == "gpu" and kernels.usable("cuda")
    if not (there or chosen.inspect):
        sys.exit("there is no GPU that fused kernels run on here; --inspect needs none")
    if chosen.inspect and assembler() is None:
        sys.exit("there is no ptxas here: pip install nvidia-cuda-nvcc")
    lines = [
        "# Kernels for GPUs",
        "",
        f"`python -m benchmarks.gpu_kernels{' --inspect' if chosen.inspect else ''}`.",
        "",
    ]
    if not chosen.inspect:
        lines += measured(BATCHES[:1] if chosen.quick else BATCHES)
    if assembler() is not None:
        lines += inspected(SHAPES[:1] if chosen.quick else SHAPES)
    say("\n".join(lines))
    if not chosen.quick:
        RESULT.write_text("\n".join(lines) + "\n")


def measured(batches: tuple[int, ...]) -> list[str]:
    """Contacts to margins on the first GPU, with kernels and on XLA alone, and how far apart they are."""
    device = jax.local_devices(backend="cuda")[0]
    lines = [
        "## Contacts to margins",
        "",
        f"{device.device_kind}, JAX {jax.__version__}, four contacts, eight edges, the six forces. Last columns: "
        "the share of grasps with the same status, and among them the largest difference of margins, of max(|margin|, "
        f"1 N); more than {SAME_MARGIN['float64']} (float32: {SAME_MARGIN['float32']}) would have stopped the run.",
        "",
        "| batch | precision | XLA, grasps/s | fused, grasps/s | fused/XLA | same status | difference |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for batch in batches:
        grasps = problems.sample(batch, 4)
        for dtype in DTYPES:
            contacts = jax.device_put(contacts_of(grasps, dtype), device)
            forces = jg.DisturbanceSet.forces(1.0)
            runs = {"fused": jax.jit(jg.largest_disturbance).lower(contacts, forces).compile()}
            jax.clear_caches()
            with kernels.without():
                runs["XLA"] = jax.jit(jg.largest_disturbance).lower(contacts, forces).compile()
            jax.clear_caches()
            ours, theirs = (runs[name](contacts, forces) for name in ("fused", "XLA"))
            same, difference = compared(ours, theirs)
            if difference > SAME_MARGIN[dtype]:
                sys.exit(f"batch {batch}, {dtype}: margins differ by {difference:.1e}")
            timings = by_turns({name: job(lambda run=run: run(contacts, forces)) for name, run in runs.items()}, ROUNDS)  # noqa: B023
            rates = [batch / timings[name].seconds for name in ("XLA", "fused")]
            lines.append(
                f"| {batch:,} | {dtype} | {rates[0]:,.0f} | {rates[1]:,.0f} | {rates[1] / rates[0]:.2f} | {same:.6f} | "
                f"{difference:.1e} |"
            )
            say(lines[-1])
    return [*lines, ""]


def compared(ours: jg.Solution, theirs: jg.Solution) -> tuple[float, float]:
    """Share of equal statuses, and among them the largest difference of margins, of max(|margin|, 1 N)."""
    same = np.asarray(ours.status) == np.asarray(theirs.status)
    a, b = np.asarray(ours.margin)[same], np.asarray(theirs.margin)[same]
    apart = np.abs(a - b) / np.maximum(np.abs(b), 1)
    return float(same.mean()), float(np.nanmax(apart, initial=0.0))


def inspected(shapes: tuple[tuple[int, int], ...]) -> list[str]:
    """What the assembler makes of the margin's kernels."""
    lines = [
        "## What the assembler says",
        "",
        f"{version()}, the margin's kernel under six forces. Registers are of a thread, of four bytes, 255 at most; "
        "stack, stores and loads are bytes of a thread's own memory, the last two counted in the code, not as it runs.",
        "",
        "| contacts | edges | precision | device | PTX, lines | registers | stack | stores | loads | code, kB | s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for contacts_count, edges in shapes:
        for dtype in DTYPES:
            code = kernel(contacts_count, edges, dtype)
            for capability in CAPABILITIES:
                text = gpu.write_ptx(code, capability)
                made = assembled(text, capability)
                lines.append(
                    f"| {contacts_count} | {edges} | {dtype} | sm_{capability} | {len(text.splitlines()):,} | "
                    f"{made.registers} | {made.stack:,} | {made.stores:,} | {made.loads:,} | "
                    f"{made.code / 1000:,.0f} | {made.seconds:.1f} |"
                )
                say(lines[-1])
    return [*lines, ""]


def kernel(contacts_count: int, edges: int, dtype: str) -> str:
    """LLVM's text of the margin's kernel."""
    contacts = contacts_of(problems.sample(2, contacts_count), dtype)
    kernels.usable("cuda" if jax.default_backend() == "gpu" else "cpu")
    with watched() as seen:
        forces = jg.DisturbanceSet.forces(1.0)
        jax.jit(lambda: jg.largest_disturbance(contacts, forces, cone_edges=edges)).lower()
    ((jaxpr, shared),) = seen
    return gpu.write_module(lowering.lower(jaxpr, list(shared)), "margin")


def assembler() -> str | None:
    """The `ptxas` on the path, or of an installed package."""
    found = shutil.which("ptxas")
    for folder in site.getsitepackages():
        found = found or next((str(path) for path in Path(folder).glob("nvidia/**/bin/ptxas")), None)
    return found


def version() -> str:
    said = subprocess.run([assembler(), "--version"], capture_output=True, text=True, check=True).stdout
    return f"ptxas {re.search(r'V([0-9.]+)', said)[1]}"


def assembled(ptx: str, capability: int) -> Assembled:
    """What the assembler makes of a kernel.

    Raises:
        RuntimeError: it does not accept it.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "kernel.ptx", Path(folder) / "kernel.cubin"
        source.write_text(ptx)
        start = time.perf_counter()
        given = [assembler(), "-v", f"-arch=sm_{capability}", "-o", str(out), str(source)]
        done = subprocess.run(given, capture_output=True, text=True)
        seconds = time.perf_counter() - start
        if done.returncode:
            raise RuntimeError(f"ptxas: {done.stderr}")
        sections = llvm.ObjectFileRef.from_data(out.read_bytes()).sections()
        code = sum(section.size() for section in sections if (section.name() or b"").startswith(b".text."))
    find = lambda what: int(re.search(what, done.stderr)[1])  # noqa: E731
    return Assembled(
        registers=find(r"Used (\d+) registers"),
        stack=find(r"(\d+) bytes stack frame"),
        stores=find(r"(\d+) bytes spill stores"),
        loads=find(r"(\d+) bytes spill loads"),
        code=code,
        seconds=seconds,
    )


if __name__ == "__main__":
    main()
