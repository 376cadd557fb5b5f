"""The field's metrics that have kernels: rates beside the margin's, and every answer against HiGHS or Qhull.

    python -m benchmarks.metric_kernels [--quick]

writes metric_kernels.md beside itself (--quick: fewer grasps, writes nothing). HiGHS solves the programs of many grasps
side by side, as one program of blocks.
"""

from __future__ import annotations

import argparse
import functools
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

import jaxgrasp as jg
from benchmarks.suite.clock import Job, by_turns, say, warn_if_busy
from jaxgrasp import metrics
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.kernels.code import llvm

BATCH, ROUNDS = 16_384, 7
CHECKED, TOGETHER, CHUNK = 20_000, 16, 512
HIGHS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10, "presolve": False}
RANK = 1e-9
"""Singular values below this share of the largest are zero."""
SMALLEST = 1e-7
"""Smaller balls count as none, in units of the longest wrench."""


def rates() -> list[str]:
    """Grasps a second, by turns."""
    found = sample_grasps(BATCH, seed=1)
    task = jg.DisturbanceSet.forces(1.0)
    lines = ["| precision | | grasps/s | of the margin's | cpu/wall |", "|---|---|---|---|---|"]
    for dtype in ("float64", "float32"):
        given = (np.asarray(x, dtype) for x in (found.positions, found.outward_normals))
        scalars = {name: np.asarray(getattr(found, name), dtype) for name in ("friction", "max_force")}
        contacts = jg.Contacts.from_normals(*given, **scalars)
        programs: dict[str, Callable] = {
            "margin": lambda c: jg.largest_disturbance(c, task).margin,
            "min_weight": metrics.min_weight,
            "force_closure": metrics.force_closure,
            "closure_residual": metrics.closure_residual,
            "task_wrench": lambda c: metrics.task_wrench(c, task),
        }
        jobs: dict[str, Job] = {
            name: functools.partial(run, jax.jit(program), contacts) for name, program in programs.items()
        }
        # A search, which is not a part of a program.
        jobs["ferrari_canny"] = functools.partial(run, metrics.ferrari_canny, contacts)
        timings = by_turns(jobs, ROUNDS)
        for name, timing in timings.items():
            share = timings["margin"].seconds / timing.seconds
            rate = f"{BATCH / timing.seconds:,.0f}"
            lines.append(f"| {dtype} | {name} | {rate} | {share:.2f} | {timing.cpu_per_wall:.2f} |")
    return lines


def run(program: Callable, contacts: jg.Contacts) -> None:
    jax.block_until_ready(program(contacts))


def checked_grasps(count: int) -> jg.Contacts:
    """Random grasps of a thumb and three fingers; of eight, one from one side, and one with its contacts on a line."""
    found = sample_grasps(count, seed=2)
    rng = np.random.default_rng(3)
    positions, normals = found.positions.copy(), np.array(found.outward_normals)
    # From one side no contact pushes down.
    normals[::8, :, 2] = np.abs(normals[::8, :, 2]) + 1
    line = rng.normal(size=(len(positions[4::8]), 1, 3))
    positions[4::8] = 0.03 * line * rng.uniform(-1, 1, (len(line), 4, 1))
    return jg.Contacts.from_normals(positions, normals, friction=0.6, max_force=1.0)


def least_weights(W: np.ndarray) -> np.ndarray:
    """The min-weights of grasps (k, m, 6) by HiGHS, times m; -inf where there are none."""
    k, m = W.shape[:2]
    # z >= 0, l free:  W'z + l W'1 = 0,  1'z + m l = 1.
    blocks = []
    for w in W:
        rows = np.column_stack([w.T, w.sum(0)])
        blocks.append(np.vstack([rows, np.append(np.ones(m), m)]))
    cost = np.tile(np.append(np.zeros(m), -1.0), k)
    side = np.tile(np.append(np.zeros(6), 1.0), k)
    bounds = np.tile(np.vstack([np.tile([0, np.inf], (m, 1)), [[-np.inf, np.inf]]]), (k, 1))
    found = linprog(cost, A_eq=sp.block_diag(blocks, "csc"), b_eq=side, bounds=bounds, method="highs", options=HIGHS)
    if found.status == 0:
        return m * found.x.reshape(k, m + 1)[:, -1]
    return np.full(1, -np.inf) if k == 1 else np.concatenate([least_weights(w[None]) for w in W])


def answers(W: np.ndarray) -> np.ndarray:
    """Min-weights, times the number of edges."""
    least = np.concatenate([least_weights(W[i : i + TOGETHER]) for i in range(0, len(W), TOGETHER)])
    singular = np.linalg.svd(W, compute_uv=False)
    # By definition: edges that do not span the space close nothing.
    return np.where(singular[:, 5] <= RANK * singular[:, 0], np.minimum(least, 0), least)


def factors(W: np.ndarray) -> np.ndarray:
    """The largest factors of unit forces that grasps (k, m, 6) exert, by HiGHS: the least of six programs each."""
    m = W.shape[1]
    # z >= 0, s >= 0:  W'z = s c,  1'z <= 1.
    blocks = [np.column_stack([w.T, -wrench]) for w in W for wrench in np.concatenate([np.eye(6)[:3], -np.eye(6)[:3]])]
    total = [np.append(np.ones(m), 0)[None]] * len(blocks)
    found = linprog(
        np.tile(np.append(np.zeros(m), -1), len(blocks)),
        sp.block_diag(total, "csr"),
        np.ones(len(blocks)),
        sp.block_diag(blocks, "csc"),
        np.zeros(6 * len(blocks)),
        method="highs",
        options=HIGHS,
    )
    if found.status == 0:
        return found.x.reshape(len(W), 6, m + 1)[..., -1].min(-1)
    return np.full(1, np.nan) if len(W) == 1 else np.concatenate([factors(w[None]) for w in W])


def tasks(W: np.ndarray) -> np.ndarray:
    """`factors`, a few grasps at a time."""
    return np.concatenate([factors(W[i : i + TOGETHER // 4]) for i in range(0, len(W), TOGETHER // 4)])


def radii(W: np.ndarray) -> np.ndarray:
    """The largest balls of grasps (k, m, 6) by Qhull; 0 where the wrenches do not span the space."""
    found = np.zeros(len(W))
    for row, w in enumerate(W):
        points = np.concatenate([np.zeros((1, 6)), w])
        singular = np.linalg.svd(points - points.mean(0), compute_uv=False)
        if singular[5] > RANK * singular[0]:
            found[row] = max(0.0, -ConvexHull(points).equations[:, -1].max())
    return found


def checks(count: int) -> list[str]:
    """The largest differences from HiGHS and Qhull."""
    contacts, space = checked_grasps(count), metrics.WrenchSpace()
    W = np.asarray(metrics.edge_wrenches(contacts, space)).reshape(count, -1, 6)
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        parts = [W[i : i + CHUNK] for i in range(0, count, CHUNK)]
        least, balls, forces = (np.concatenate(list(pool.map(answer, parts))) for answer in (answers, radii, tasks))
    found = jax.tree.map(np.asarray, metrics.force_closure(contacts, space))
    ours, finite = found.min_weight * W.shape[1], np.isfinite(least)
    assert (ours[~finite] == least[~finite]).all()
    difference = np.abs(ours - least)[finite]
    relative = difference / np.maximum(np.abs(least[finite]), 1e-2)
    wrong = (found.closed != (least > 1e-7)).sum()
    exerted = np.asarray(metrics.task_wrench(contacts, jg.DisturbanceSet.forces(1.0), space))
    answered = ~np.isnan(forces)
    factor = np.abs(exerted - forces)[answered] / np.maximum(forces[answered], 1e-2)
    facets = jax.tree.map(np.asarray, metrics.nearest_facet(contacts, space=space))
    some = balls > SMALLEST * np.linalg.norm(W, axis=-1).max(-1)
    assert (facets.radius[~some] <= 2 * SMALLEST * np.linalg.norm(W[~some], axis=-1).max(-1)).all()
    apart = np.abs(facets.radius - balls)[some] / balls[some]
    low = (1 - facets.lower_bound / np.where(some, balls, 1))[some]
    return [
        f"{count:,} grasps, of which {(~found.closed).mean():.0%} have no force closure; {np.isnan(ours).sum()} are "
        f"unsolved. Min-weights, times the number of edges, differ by at most {np.nanmax(difference):.1e}, and by "
        f"{np.nanmax(relative):.1e} of the larger of themselves and 0.01. `force_closure` differs on {wrong} of them "
        "from HiGHS' min-weight above 1e-7.",
        "",
        f"`task_wrench` of six forces is positive for {(exerted > 0).mean():.0%} and unsolved for "
        f"{np.isnan(exerted).sum()}; it differs by at most {np.nanmax(factor):.1e} of the larger of itself and 0.01 on "
        f"the {answered.sum():,} for which HiGHS has an answer, and is 0 where HiGHS is below 1e-9 on all but "
        f"{((exerted == 0) != (forces < 1e-9))[answered].sum()}.",
        "",
        f"`ferrari_canny` proves its answer on {(facets.status == jg.Status.SOLVED).sum():,} of them. It differs from "
        f"Qhull's by at most {apart.max():.1e} of itself, and its lower bound is at most {low.max():.1e} below; where "
        "Qhull's ball is smaller than 2e-7 of the longest wrench so is ours.",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer grasps are checked; writes nothing")
    quick = parser.parse_args().quick
    jax.config.update("jax_enable_x64", True)
    load = warn_if_busy()
    text = "\n".join(
        [
            "# Metrics by kernels",
            "",
            f"`python -m benchmarks.metric_kernels`, {os.cpu_count()} cores, "
            f"{llvm.processor().description.split(',')[0]}, load average at the start {load:.1f}.",
            "",
            f"Four contacts, eight edges, batch {BATCH:,}, warm, by turns, best of {ROUNDS}. `ferrari_canny` is a "
            "search of many programs; all others are in a `jax.jit`.",
            "",
            *rates(),
            "",
            "## Against HiGHS and Qhull, float64",
            "",
            *checks(512 if quick else CHECKED),
            "",
        ]
    )
    say(text)
    if not quick:
        (Path(__file__).parent / "metric_kernels.md").write_text(text)


if __name__ == "__main__":
    main()
