"""The solvers that one would use instead, each called the way its authors document for many programs of one shape.

They get the scaled, orthonormalised programs ready made, in the memory layout that they want, so that only their own
work is timed; ours has to make its programs from the contacts. These run in
worker processes, where only qpax imports JAX.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from benchmarks.suite import problems
from benchmarks.suite.problems import Programs

# The loosest at which the interior-point ones still have lambda right to 1e-6.
TOLERANCE = 1e-6
PROXIMAL = 1e-3

Solve = Callable[[], np.ndarray]
"""Solves all programs again; x[-1] of each, nan where the solver does not call it solved."""

PEERS = {
    "highs": "scipy",
    "clarabel": "clarabel",
    "piqp_dense": "piqp",
    "piqp_sparse": "piqp",
    "proxqp": "proxsuite",
    "proxqp_parallel": "proxsuite",
    "osqp": "osqp",
    "qpax_float64": "qpax",
    "qpax_float32": "qpax",
}
"""Each with the distribution that has it."""

THREADED = ("proxqp_parallel",)
"""Those that spread a batch over threads by themselves."""


def reference(batch: Programs) -> Solve:
    """The optimum that the others are measured against."""
    return lambda: problems.highs(batch, 1e-10, _together(batch))


def highs(batch: Programs) -> Solve:
    return lambda: problems.highs(batch, 1e-7, _together(batch))


def _together(batch: Programs) -> int:
    # SciPy's checks of its arguments cost more than one small program, so that many side by side are fastest; large
    # ones are fastest in fours.
    return 64 if batch.B.shape[-1] <= 25 else 4


def clarabel(batch: Programs) -> Solve:
    clarabel = importlib.import_module("clarabel")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    # What `update` asks for.
    settings.presolve_enable = settings.chordal_decomposition_enable = settings.input_sparse_dropzeros = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    values, pattern = sparse(np.concatenate([batch.B, batch.A], 1))
    cones = [clarabel.ZeroConeT(6), clarabel.NonnegativeConeT(len(batch.h))]
    n = len(batch.cost)
    nothing = sp.csc_matrix((n, n))
    solver = clarabel.DefaultSolver(nothing, batch.cost, pattern, np.r_[np.zeros(6), batch.h], cones, settings)

    def solve() -> np.ndarray:
        answers = np.full(len(values), np.nan)
        for i, data in enumerate(values):
            solver.update(A=data)
            solution = solver.solve()
            if str(solution.status) == "Solved":
                answers[i] = solution.x[-1]
        return answers

    return solve


def piqp_dense(batch: Programs) -> Solve:
    piqp = importlib.import_module("piqp")
    A, B = (np.asfortranarray(np.moveaxis(x, 0, -1)) for x in (batch.A, batch.B))
    A, B = [A[..., i] for i in range(len(batch))], [B[..., i] for i in range(len(batch))]
    n = len(batch.cost)
    return _piqp(piqp.DenseSolver(), np.zeros((n, n), order="F"), batch, A, B)


def piqp_sparse(batch: Programs) -> Solve:
    piqp = importlib.import_module("piqp")
    values, pattern = sparse(batch.A)
    A = [sp.csc_matrix((data, pattern.indices, pattern.indptr), pattern.shape) for data in values]
    values, pattern = sparse(batch.B)
    B = [sp.csc_matrix((data, pattern.indices, pattern.indptr), pattern.shape) for data in values]
    n = len(batch.cost)
    return _piqp(piqp.SparseSolver(), sp.csc_matrix((n, n)), batch, A, B)


def _piqp(solver, P, batch: Programs, A: list, B: list) -> Solve:
    piqp = importlib.import_module("piqp")
    solver.settings.eps_abs = solver.settings.eps_rel = TOLERANCE
    solver.settings.check_duality_gap = True
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = TOLERANCE
    # The programs are scaled already, and alike.
    solver.settings.preconditioner_iter = 0
    solver.setup(P, batch.cost, B[0], np.zeros(6), A[0], None, batch.h)

    def solve() -> np.ndarray:
        answers = np.full(len(A), np.nan)
        for i, (inequalities, equalities) in enumerate(zip(A, B, strict=True)):
            solver.update(A=equalities, G=inequalities)
            if solver.solve() == piqp.PIQP_SOLVED:
                answers[i] = solver.result.x[-1]
        return answers

    return solve


def proxqp(batch: Programs) -> Solve:
    dense = importlib.import_module("proxsuite").proxqp.dense
    qp = _proxqp_program(batch, dense.QP)
    qp.init(None, batch.cost, batch.B[0], np.zeros(6), batch.A[0], None, batch.h, rho=PROXIMAL)
    solved = importlib.import_module("proxsuite").proxqp.PROXQP_SOLVED

    def solve() -> np.ndarray:
        answers = np.full(len(batch), np.nan)
        for i in range(len(batch)):
            qp.update(A=batch.B[i], C=batch.A[i], update_preconditioner=False, rho=PROXIMAL)
            qp.solve()
            if qp.results.info.status == solved:
                answers[i] = qp.results.x[-1]
        return answers

    return solve


def proxqp_parallel(batch: Programs) -> Solve:
    """Its own batch: one workspace a program, spread over two threads."""
    proxqp = importlib.import_module("proxsuite").proxqp
    programs = proxqp.dense.VectorQP()
    for i in range(len(batch)):
        qp = _proxqp_program(batch, proxqp.dense.QP)
        qp.init(None, batch.cost, batch.B[i], np.zeros(6), batch.A[i], None, batch.h, rho=PROXIMAL)
        programs.append(qp)

    def solve() -> np.ndarray:
        proxqp.dense.solve_in_parallel(programs, 2)
        solved = [qp.results.info.status == proxqp.PROXQP_SOLVED for qp in programs]
        return np.where(solved, [qp.results.x[-1] for qp in programs], np.nan)

    return solve


def _proxqp_program(batch: Programs, make):
    proxqp = importlib.import_module("proxsuite").proxqp
    qp = make(
        len(batch.cost),
        6,
        len(batch.h),
        hessian_type=proxqp.dense.HessianType.Zero,
        dense_backend=proxqp.dense.DenseBackend.PrimalDualLDLT,
    )
    qp.settings.eps_abs = TOLERANCE
    # At the default of 1e-4 two fifths of these programs, all feasible, are called infeasible.
    qp.settings.eps_primal_inf = qp.settings.eps_dual_inf = 1e-8
    # Better than the default of 1e-6 where there is no curvature: none is lost.
    qp.settings.default_rho = PROXIMAL
    qp.settings.check_duality_gap = True
    qp.settings.eps_duality_gap_abs = TOLERANCE
    # The last program's answer is no start for the next one.
    qp.settings.initial_guess = proxqp.NO_INITIAL_GUESS
    return qp


def osqp(batch: Programs) -> Solve:
    osqp = importlib.import_module("osqp")
    values, pattern = sparse(np.concatenate([batch.B, batch.A], 1))
    solver = osqp.OSQP()
    n = len(batch.cost)
    upper = np.r_[np.zeros(6), batch.h]
    lower = np.r_[np.zeros(6), np.full(len(batch.h), -np.inf)]
    solver.setup(
        sp.csc_matrix((n, n)), batch.cost, pattern, lower, upper, verbose=False, warm_starting=False,
        eps_abs=TOLERANCE, eps_rel=TOLERANCE, max_iter=20_000, polishing=True,
    )  # fmt: skip

    def solve() -> np.ndarray:
        answers = np.full(len(values), np.nan)
        for i, data in enumerate(values):
            solver.update(Ax=data)
            result = solver.solve(raise_error=False)
            if result.info.status == "solved":
                answers[i] = result.x[-1]
        return answers

    return solve


def qpax_float64(batch: Programs) -> Solve:
    return _qpax(batch, "float64", "e", TOLERANCE)


def qpax_float32(batch: Programs) -> Solve:
    # In float32 its explicit method ends on none of these programs, at any tolerance; its implicit one on all.
    return _qpax(batch, "float32", "i", 1e-5)


def _qpax(batch: Programs, dtype: str, backend: str, tolerance: float) -> Solve:
    """By vmap, as its authors show.

    In processes like the others: its implicit method never returns when run on two CPU devices of one process at once.
    """
    import jax
    import jax.numpy as jnp
    import qpax

    jax.config.update("jax_enable_x64", True)
    n = len(batch.cost)
    cost, h = jnp.asarray(batch.cost, dtype), jnp.asarray(batch.h, dtype)

    def one(A: jax.Array, B: jax.Array) -> jax.Array:
        x, _, _, _, converged, _ = qpax.solve_qp(
            jnp.zeros((n, n), dtype), cost, B, jnp.zeros(6, dtype), A, h, backend=backend, solver_tol=tolerance
        )
        return jnp.where(converged == 1, x[-1], jnp.nan)

    matrices = jnp.asarray(batch.A, dtype), jnp.asarray(batch.B, dtype)
    call = jax.jit(jax.vmap(one)).lower(*matrices).compile()
    return lambda: np.asarray(call(*matrices), float)


def sparse(matrices: np.ndarray) -> tuple[np.ndarray, sp.csc_matrix]:
    """(count, nonzeros) values of matrices of one pattern in columns, and the first of them."""
    there = np.any(matrices != 0, axis=0)
    row, column = np.nonzero(there.T)[::-1]
    values = np.ascontiguousarray(matrices[:, row, column])
    start = np.r_[0, np.cumsum(there.sum(0))]
    return values, sp.csc_matrix((values[0], row, start), there.shape)
