"""(21) of single lanes by HiGHS, from the rows of `rows`, in units of order one."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from benchmarks.suite.rows import Model

OPTIONS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10, "presolve": False}
TOGETHER = 16


def optima(m: Model) -> tuple[np.ndarray, np.ndarray]:
    """lambda* of every lane, and where HiGHS does not tell.

    nan where b cannot be borne whatever lambda, inf where nothing disturbs. lambda is free, so a negative one says
    that b cannot be borne. Where a disturbance is out of reach and b is borne it is 0 by definition.
    """
    programs = [_program(m[lane : lane + 1]) for lane in range(len(m.b))]
    found = [_solve(programs[k : k + TOGETHER]) for k in range(0, len(programs), TOGETHER)]
    t = np.concatenate([np.zeros(0), *found])
    unknown = np.isposinf(t) & ~m.load_outside
    undisturbed = (m.S_1 == 0).all((1, 2)) & (m.S_2 == 0).all(-1)
    by_definition = np.where(m.set_outside, 0.0, np.inf)
    value = np.where(m.set_outside | undisturbed, np.where(t >= -1e-9, by_definition, np.nan), t * m.scale)
    return np.where(m.load_outside, np.nan, value), unknown


def _program(m: Model) -> tuple[np.ndarray, ...]:
    """A x <= h, B x = c over x = (scaled forces of the contacts that are there, lambda / Lambda)."""
    on = np.flatnonzero(m.active[0])
    if not len(on):
        # Nothing holds and nothing is held: lambda <= 0.
        return np.ones((1, 1)), np.zeros(1), np.zeros((0, 1)), np.zeros(0)
    mu, F = m.friction[0, on], m.max_force[0, on]
    tangential = mu * F
    edges, size = len(m.facets), 3 * len(on)
    A = np.zeros((len(on), edges + 1, size + 1))
    for i in range(len(on)):
        A[i, :edges, 3 * i : 3 * i + 3] = m.facets
        A[i, edges, 3 * i + 2] = -1.0
    A[:, :edges, -1] = -m.S_1[0, on] / tangential[:, None] * m.scale
    A[:, edges, -1] = m.S_2[0, on] / F * m.scale
    if m.set_outside[0] or not A[..., -1].any():
        A[..., -1] = 1.0
    h = np.zeros((len(on), edges + 1))
    h[:, :edges], h[:, edges] = -m.reserve[0] / tangential[:, None], 1.0
    columns = np.stack([tangential, tangential, F], axis=-1).reshape(-1)
    left, values, right = np.linalg.svd(m.G[0, :, on].transpose(1, 0, 2).reshape(6, -1) * columns, full_matrices=False)
    kept = slice(0, m.rank[0])
    B = np.zeros((m.rank[0], size + 1))
    B[:, :-1] = right[kept]
    c = (left.T @ m.b[0])[kept] / values[kept]
    return A.reshape(-1, size + 1), h.reshape(-1), B, c


def _solve(programs: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    """The largest last unknown of each, nan where there is none, inf where HiGHS fails.

    Side by side, since a call costs more than one small program.
    """
    A, h, B, c = zip(*programs, strict=True)
    last = np.cumsum([a.shape[1] for a in A]) - 1
    cost = np.zeros(last[-1] + 1)
    cost[last] = -1.0
    result = linprog(
        cost,
        sp.block_diag(A, format="csc"),
        np.concatenate(h),
        sp.block_diag(B, format="csc"),
        np.concatenate(c),
        (None, None),
        "highs",
        options=OPTIONS,
    )
    if result.status == 0:
        return result.x[last]
    if len(programs) > 1:
        return np.concatenate([_solve([one]) for one in programs])
    return np.full(1, np.nan if result.status == 2 else np.inf)
