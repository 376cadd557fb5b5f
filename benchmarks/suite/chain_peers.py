"""The chain's programs in loops over Clarabel, HiGHS and PIQP, for grasps of one shape without load.

Each peer gets its programs ready made, as `peers` describes; the free formulations as one program a direction, which is
faster for all of them than the whole program. Ours makes its programs from the contacts.
"""

from __future__ import annotations

import importlib

import clarabel
import numpy as np
import scipy.sparse as sp

from benchmarks.suite import chain, peers
from benchmarks.suite.peers import Solve
from benchmarks.suite.problems import Programs


def programs(batch: chain.Batch, name: str) -> tuple[Programs, int]:
    """The linear programs of a formulation, and how many belong to a grasp."""
    A, h, B, scale = [], None, [], []
    for i in range(len(batch)):
        case = batch.case(i)
        rows, sides = case.rows
        count = len(case.W)
        G = np.hstack([case.G, np.zeros((6, 1))])
        own = {
            "16": [np.vstack([np.hstack([rows, (rows @ a)[:, None]]) for a in case.answers])],
            "per_direction_prestrained": [
                np.vstack([np.hstack([rows, (rows @ one)[:, None]]) for one in (a, 0 * a)]) for a in case.answers[:-1]
            ],
        }.get(name, [np.hstack([rows, np.zeros((len(rows), 1))])] * count)
        equal = [np.hstack([case.G, w[:, None]]) for w in case.W] if name in ("13", "per_direction") else [G] * len(own)
        A += own
        B += equal
        h = np.tile(sides, len(own[0]) // len(sides))
        scale += [case.scale] * len(own)
    cost = np.r_[np.zeros(A[0].shape[1] - 1), -1.0]
    made = Programs(
        A=np.array(A), h=h, B=np.array(B), cost=cost, scale=np.array(scale), S_1=np.zeros(0), S_2=np.zeros(0)
    )
    return made, len(A) // len(batch)


PEERS = {
    **dict.fromkeys(("12", "12_fixed"), ("Clarabel",)),
    **dict.fromkeys(("13", "16", "per_direction", "per_direction_prestrained"), ("HiGHS", "Clarabel", "PIQP")),
    "11": ("Clarabel", "PIQP"),
}
"""By formulation."""


def solver(batch: chain.Batch, name: str, label: str, margin: np.ndarray) -> Solve:
    """One peer for a formulation; the margin is for (11) alone."""
    if name == "11":
        return {"Clarabel": effort_by_clarabel, "PIQP": effort_by_piqp}[label](*total_effort(batch, margin))
    return conic(batch, name) if name in ("12", "12_fixed") else linear(batch, name, label)


def linear(batch: chain.Batch, name: str, label: str) -> Solve:
    """Margins of a linear formulation."""
    made, each = programs(batch, name)
    solve = {"HiGHS": peers.highs, "Clarabel": peers.clarabel, "PIQP": peers.piqp_dense}[label](made)
    return lambda: (solve() * made.scale).reshape(-1, each).min(-1)


def _settings(tolerance: float) -> clarabel.DefaultSettings:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.presolve_enable = settings.chordal_decomposition_enable = settings.input_sparse_dropzeros = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    return settings


def conic(batch: chain.Batch, name: str) -> Solve:
    """Margins of (12), one program a direction, or with blocking forces, one program."""
    matrices, scale, kinds, sides = [], [], [], None
    for i in range(len(batch)):
        case = batch.case(i)
        cones = case.cones(False)
        if name == "12":
            for w in case.W:
                rows = [np.hstack([case.G, w[:, None]])] + [np.hstack([A, np.zeros((len(A), 1))]) for _, A, _ in cones]
                matrices.append(np.vstack(rows))
            copies, each = 1, len(case.W)
        else:
            rows = [np.hstack([case.G, np.zeros((6, 1))])]
            for a in case.answers:
                rows += [np.hstack([A, (A @ a)[:, None]]) for _, A, _ in cones]
            matrices.append(np.vstack(rows))
            copies, each = len(case.answers), 1
        scale += [case.scale] * each
        sides = np.concatenate([np.zeros(6), *[h for *_, h in cones] * copies])
        kinds = [(kind, len(h)) for kind, _, h in cones] * copies
    values, pattern = peers.sparse(np.array(matrices))
    order = [clarabel.ZeroConeT(6)]
    order += [clarabel.SecondOrderConeT(n) if kind == "q" else clarabel.NonnegativeConeT(n) for kind, n in kinds]
    cost = np.r_[np.zeros(pattern.shape[1] - 1), -1.0]
    nothing = sp.csc_matrix((len(cost), len(cost)))
    solver = clarabel.DefaultSolver(nothing, cost, pattern, sides, order, _settings(peers.TOLERANCE))

    def solve() -> np.ndarray:
        answers = np.full(len(values), np.nan)
        for i, data in enumerate(values):
            solver.update(A=data)
            solution = solver.solve()
            if str(solution.status) == "Solved":
                answers[i] = solution.x[-1]
        return (answers * scale).reshape(len(batch), -1).min(-1)

    return solve


def total_effort(batch: chain.Batch, margin: np.ndarray) -> tuple:
    """(11) with Q = Q_0 = I: P, equalities and their right-hand sides of every grasp, rows and theirs, unit."""
    equal, sides, rows = [], [], None
    for i in range(len(batch)):
        case = batch.case(i)
        count, size = len(case.W), case.G.shape[1]
        A, h = case.rows
        equal.append(sp.block_diag([case.G] * (count + 1)).toarray())
        sides.append(np.concatenate([case.b, *(-margin[i] / case.scale * case.W)]))
    # One friction and one f_max, as `conic` and `linear` could do without.
    weights = np.tile(np.repeat(batch.max_force[0], 3) ** 2, count + 1)
    rows = np.zeros(((count + 1) * len(A), (count + 1) * size))
    for j in range(count + 1):
        block = slice(j * len(A), (j + 1) * len(A))
        rows[block, :size] = A
        rows[block, j * size : (j + 1) * size] = A
    P = sp.diags(weights / weights.max()).tocsc()
    return P, np.array(equal), np.array(sides), rows, np.tile(h, count + 1), weights.max()


def effort_by_clarabel(P, equal, sides, rows, h, unit) -> Solve:
    """Efforts of (11)."""
    values, pattern = peers.sparse(np.concatenate([equal, np.tile(rows, (len(equal), 1, 1))], 1))
    kinds = [clarabel.ZeroConeT(len(sides[0])), clarabel.NonnegativeConeT(len(h))]
    cost = np.zeros(P.shape[0])
    solver = clarabel.DefaultSolver(P, cost, pattern, np.r_[sides[0], h], kinds, _settings(peers.TOLERANCE))

    def solve() -> np.ndarray:
        answers = np.full(len(values), np.nan)
        for i, data in enumerate(values):
            solver.update(A=data, b=np.r_[sides[i], h])
            solution = solver.solve()
            if str(solution.status) == "Solved":
                answers[i] = solution.obj_val * unit
        return answers

    return solve


def effort_by_piqp(P, equal, sides, rows, h, unit) -> Solve:
    """Efforts of (11)."""
    piqp = importlib.import_module("piqp")
    own, shape = peers.sparse(equal)
    equalities = [sp.csc_matrix((data, shape.indices, shape.indptr), shape.shape) for data in own]
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = peers.TOLERANCE
    solver.setup(P, np.zeros(P.shape[0]), equalities[0], sides[0], sp.csc_matrix(rows), None, h)

    def solve() -> np.ndarray:
        answers = np.full(len(equal), np.nan)
        for i, matrix in enumerate(equalities):
            solver.update(A=matrix, b=sides[i])
            if solver.solve() == piqp.PIQP_SOLVED:
                x = solver.result.x
                answers[i] = 0.5 * x @ (P @ x) * unit
        return answers

    return solve
