"""Synthesis on primitives and meshes: from random starts to which margins, and how fast; writes synthesis.md.

Run: python -m benchmarks.synthesis [mesh.stl ...]
"""

from __future__ import annotations

import os
import platform
import sys
import time
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
jax.config.update("jax_enable_x64", True)

from jaxgrasp.disturbance import DisturbanceSet  # noqa: E402
from jaxgrasp.geometry import Box, Capsule, Mesh, Sphere, sample_surface  # noqa: E402
from jaxgrasp.synthesis import synthesize  # noqa: E402

STARTS, STEPS, CONTACTS, EDGES, FRICTION = 1024, 200, 4, 16, 0.8
TETRAHEDRON = 0.8827  # the regular tetrahedron on the unit sphere under ball(1, 1), in units of f_max
POSITIVE = 1e-4


def objects(paths: list[str]) -> dict:
    """Shape, centre of mass and what the grid of a mesh costs, by name."""
    found = {
        "sphere": (Sphere.from_radius(1.0), np.zeros(3), ""),
        "box": (Box.from_half_extents((0.035, 0.025, 0.055), rounding=0.005), np.zeros(3), ""),
        "capsule": (Capsule.from_radius(0.025, 0.04), np.zeros(3), ""),
    }
    for path in paths:
        mesh = Mesh.from_file(path)
        start = time.perf_counter()
        grid = mesh.to_grid()
        seconds = time.perf_counter() - start
        off = 1e3 * mesh.deviation(np.asarray(sample_surface(grid, jax.random.key(1), 4096)))
        note = f"{seconds:.1f} s; {np.median(off):.3f} / {np.quantile(off, 0.99):.2f} / {off.max():.2f} mm"
        found[Path(path).stem] = (grid, mesh.centroid, note)
    return found


def measure(shape, centre: np.ndarray) -> dict:
    lower, upper = shape.bounds
    radius = 1.0 if isinstance(shape, Sphere) else 0.5 * float(np.linalg.norm(upper - lower))

    def run(steps: int):
        start, cpu = time.perf_counter(), time.process_time()
        found = synthesize(
            shape,
            CONTACTS,
            jax.random.key(0),
            disturbances=DisturbanceSet.ball(1.0, 1.0 if radius == 1.0 else 0.5 * radius),
            friction=FRICTION,
            max_force=1.0,
            starts=STARTS,
            steps=steps,
            center_of_mass=centre,
            cone_edges=EDGES,
        )
        return found, time.perf_counter() - start, time.process_time() - cpu

    *_, first, _ = run(10)
    found, seconds, cpu = min((run(STEPS) for _ in range(3)), key=lambda result: result[1])
    return {
        "start > 0": f"{(found.first_margin > POSITIVE).mean():.1%}",
        "end > 0": f"{(found.margin > POSITIVE).mean():.1%}",
        "best start": f"{found.first_margin.max():.4f}",
        "best": f"{found.margin[0]:.4f}",
        "median / best": f"{np.median(found.margin) / found.margin[0]:.3f}",
        "lowest tenth / best": f"{np.quantile(found.margin, 0.1) / found.margin[0]:.3f}",
        "began anew": f"{(found.restarts > 0).mean():.0%}",
        "s": f"{seconds:.2f}",
        "cpu / wall": f"{cpu / seconds:.2f}",
        "grasps / s": f"{STARTS / seconds:.0f}",
        "margins with gradient / s": f"{STARTS * STEPS / seconds:,.0f}",
        "first call of 10 steps, s": f"{first:.1f}",
    }


def main() -> None:
    rows = []
    for name, (shape, centre, note) in objects(sys.argv[1:]).items():
        rows.append({"object": name, **measure(shape, centre), "grid: time; off by median / p99 / max": note})
        print(rows[-1], flush=True)
    text = "\n".join(
        [
            "# Synthesis",
            "",
            f"{STARTS:,} random starts, {STEPS} steps, {CONTACTS} contacts, friction {FRICTION}, {EDGES} edges in the "
            "evaluation of starts and results, f_max 1 N, no limits on spacing and span.",
            "Disturbances: `ball(1, 1)` on the unit sphere, elsewhere 1 N and 1 N times a quarter of the diagonal.",
            f"The regular tetrahedron on the sphere has {TETRAHEDRON}. Times: the best of three warm runs, sampling, "
            "ascent in float32 and evaluation in float64 together; the first call compiles.",
            "",
            f"{platform.machine()}, {os.cpu_count()} cores, {jax.devices()[0].platform}, jax {jax.__version__}, load "
            f"{os.getloadavg()[0]:.1f} at the end. Made by `python -m benchmarks.synthesis` with the meshes named.",
            "",
            "| " + " | ".join(rows[0]) + " |",
            "|" + "---|" * len(rows[0]),
            *["| " + " | ".join(row.values()) + " |" for row in rows],
            "",
        ]
    )
    Path(__file__).with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
