"""Share of random programs that `solve_qp` answers rightly, by recipe and precision; writes solve_qp_table.md.

Every answer is judged in float64 with NumPy on the caller's data: a solution by its residuals, an infeasible or
unbounded program by its certificate.
"""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import qp_recipes  # noqa: E402

from jaxgrasp.solvers import solve_qp  # noqa: E402
from jaxgrasp.solvers.status import Status  # noqa: E402

LANES = 100
# Of float32's seven digits an interior point keeps three to five.
WANTED = {"float64": 1e-6, "float32": 1e-3}


def measure(recipe: str, dtype: str, solve) -> dict:
    total = right = wrong = 0
    worst, iterations = 0.0, []
    for size in qp_recipes.SIZES:
        programs = qp_recipes.batch(recipe, size, LANES)
        data = [v.astype(dtype) for v in qp_recipes.stacked(programs, size)]
        solution = jax.tree.map(np.asarray, solve(*data))
        for lane, program in enumerate(programs):
            one = jax.tree.map(lambda v, lane=lane: v[lane], solution)
            # Judged on the data as they were given: rounding them to float32 changes the program.
            given = [v[lane].astype(float) for v in data]
            error = qp_recipes.error(one, given)
            status = Status(int(one.status))
            expected = status == Status[program.answer.upper()]
            good = expected and error <= WANTED[dtype]
            total, right = total + 1, right + good
            wrong += status in (Status.SOLVED, Status.INFEASIBLE, Status.UNBOUNDED) and not good
            worst = max(worst, error if expected else 0.0)
            iterations.append(int(one.iterations))
    return {
        "recipe": recipe.replace("_", " "),
        "programs": total,
        "right": f"{right / total:.1%}",
        "wrong": wrong,
        "undecided": total - right - wrong,
        "worst error": f"{worst:.0e}",
        "iterations, median / max": f"{int(np.median(iterations))} / {max(iterations)}",
    }


def main() -> None:
    solve = jax.jit(solve_qp)
    lines = [
        "# `solve_qp` on random programs",
        "",
        f"{LANES} programs of every recipe at each of the sizes (variables, equalities, inequalities) "
        + ", ".join(str(size) for size in qp_recipes.SIZES)
        + ". `error` is the largest of",
        "the absolute primal and dual residuals, negative slacks and multipliers, and the gap relative to",
        "max(1, |objective|); for an infeasible or unbounded program, that of its "
        "certificate, scaled to b'y + h'z = -1 or q'x = -1.",
        "`right`: the known answer, with an error of at most 1e-6 in float64 and 1e-3 in float32.",
        "`wrong`: another answer, or a larger error, without saying so. `undecided`: reported as MAX_ITERATIONS.",
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, {jax.devices()[0].platform}, jax {jax.__version__}, "
        f"numpy {np.__version__}. Made by `python benchmarks/solve_qp_table.py`.",
    ]
    for dtype in WANTED:
        rows = [measure(recipe, dtype, solve) for recipe in qp_recipes.RECIPES]
        lines += ["", f"## {dtype}", "", "| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
        lines += ["| " + " | ".join(str(value) for value in row.values()) + " |" for row in rows]
    text = "\n".join(lines) + "\n"
    Path(__file__).with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
