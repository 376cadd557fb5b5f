"""The same mathematics a second time, in plain NumPy and with other people's solvers.

Nothing here imports the package under test. Every function takes a `Grasp`, in double precision, and follows the
equations literally: the grasp map from its definition, pseudo-inverses by least squares, the worst case from an
explicit maximum over the vertices, the programs as explicit matrices given to HiGHS and to Clarabel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import clarabel
import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.optimize import linprog

RANK_TOLERANCE = 1e-9
"""Singular values of the scaled grasp map, and residuals outside its range, below this share count as zero."""

HIGHS_OPTIONS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10, "presolve": False}

ROWS_A_CALL = 600
"""HiGHS is given several small programs at once, side by side: a call costs more than a small program."""


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """One grasp in the object frame; contacts that are absent have been dropped."""

    positions: np.ndarray
    """(n_c, 3), metres."""
    frames: np.ndarray
    """(n_c, 3, 3), columns t1, t2, n."""
    friction: np.ndarray
    """(n_c,)."""
    max_force: np.ndarray
    """(n_c,), newtons."""
    vertices: np.ndarray
    """(n_d, 6) wrenches."""
    required_wrench: np.ndarray
    """(6,)."""
    compliance: np.ndarray | None = None
    """None for the identity, (n_c, 3, 3) blocks, (3 n_c, 3 n_c), or (n_d, 3 n_c, 3 n_c) with one for each vertex."""
    cone_edges: int = 8
    cone_margin: float | np.ndarray = 0.0
    """d, newtons: for all rows, (n_c, 1), or (n_c, n_e)."""
    torsional: np.ndarray | None = None
    """(n_c,), metres; None for hard contacts. Moments m about the normals are a fourth component, m mu / gamma, N,
    which compliances and weights weigh."""

    @property
    def components(self) -> int:
        return 3 if self.torsional is None else 4

    @cached_property
    def row_scale(self) -> np.ndarray:
        """(6,): moments are divided by the root-mean-square distance of the contacts, 1 where that is zero."""
        length = float(np.sqrt(np.mean(np.sum(self.positions**2, axis=-1)))) or 1.0
        return np.repeat([1.0, 1.0 / length], 3)

    @cached_property
    def grasp_map(self) -> np.ndarray:
        """Equation (5): G (6, 3 n_c), contact i contributes [R_i; p_i x R_i], its normal alone without friction."""
        frames = self.frames * np.stack([self.friction > 0] * 2 + [self.friction >= 0], axis=-1)[:, None]
        moments = np.cross(self.positions[:, :, None], frames, axis=1)
        blocks = np.concatenate([frames, moments], axis=1)
        if self.torsional is not None:
            arms = self.torsional / np.where(self.friction > 0, self.friction, np.inf)
            turn = np.concatenate([np.zeros((len(arms), 3)), arms[:, None] * self.frames[..., 2]], axis=1)
            blocks = np.concatenate([blocks, turn[..., None]], axis=2)
        return blocks.transpose(1, 0, 2).reshape(6, -1)

    @cached_property
    def cone_matrix(self) -> np.ndarray:
        """C of (1): (n_c n_e, 3 n_c), block diagonal."""
        rows = facet_rows if self.torsional is None else soft_facet_rows
        return scipy.linalg.block_diag(*(rows(mu, self.cone_edges) for mu in self.friction))

    @cached_property
    def row_margins(self) -> np.ndarray:
        """d of (1): (n_c n_e,)."""
        rows = self.cone_edges * (self.components - 2)
        return np.broadcast_to(self.cone_margin, (len(self.positions), rows)).reshape(-1)

    @cached_property
    def normal_matrix(self) -> np.ndarray:
        """E of (8): (n_c, 3 n_c), picks the normal components."""
        return np.kron(np.eye(len(self.positions)), np.eye(self.components)[2])

    @cached_property
    def range_basis(self) -> np.ndarray:
        """(6, rank): an orthonormal basis of the range of G with scaled rows."""
        U, singular, _ = np.linalg.svd(self.row_scale[:, None] * self.grasp_map, full_matrices=False)
        return U[:, singular > RANK_TOLERANCE * singular[0]]

    @cached_property
    def force_changes(self) -> np.ndarray:
        """(n_d + 1, 3 n_c): G*_j W_j for every vertex and for the origin; the blocking forces (15) are its negative.

        Of all forces with G delta = W on the range of G these have the least Q-norm.
        """
        on_range = self.range_basis.T @ (self.row_scale[:, None] * self.grasp_map)
        targets = self.vertices * self.row_scale @ self.range_basis
        Qs = compliance_matrix(self.compliance, len(self.positions), self.components)
        felt = np.abs(self.grasp_map).max(0) > 0
        Qs = np.where(felt[:, None] & felt, Qs, np.eye(len(felt)))
        if Qs.ndim == 2:
            changes = least_norm(on_range, Qs, targets)
        else:
            changes = np.concatenate([least_norm(on_range, Q, w[None]) for Q, w in zip(Qs, targets, strict=True)])
        return np.vstack([changes, np.zeros(self.components * len(self.positions))])

    def outside_range(self, wrenches: np.ndarray) -> np.ndarray:
        """(n,) bool: which of the (n, 6) wrenches no contact forces can balance, however large."""
        scaled = wrenches * self.row_scale
        residual = np.linalg.norm(scaled - scaled @ self.range_basis @ self.range_basis.T, axis=-1)
        return residual > RANK_TOLERANCE * np.linalg.norm(scaled, axis=-1)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a largest-disturbance program says."""

    status: str
    margin: float
    scale: float
    """The margin's natural scale, Lambda: one over the largest of -S_1 / (mu f_max) and S_2 / f_max."""
    by_definition: bool
    """The margin is 0 because some disturbance lies outside the range of G, not because a program says so."""
    one_sided: bool
    """Some row is not loaded by any disturbance, so that no negative lambda can relieve it."""


def facet_rows(friction: float, edges: int) -> np.ndarray:
    """Equation (1): (edges, 3) rows of the pyramid whose edges stand at 2 pi k / edges from t1, on Coulomb's cone.

    Without friction they say that a finger does not pull.
    """
    if friction == 0:
        return np.tile([0.0, 0.0, np.cos(np.pi / edges)], (edges, 1))
    k = np.arange(edges)
    edge = friction * np.stack([np.cos(2 * np.pi * k / edges), np.sin(2 * np.pi * k / edges)], axis=-1)
    middle = (edge + np.roll(edge, -1, axis=0)) / 2
    angle = (2 * k + 1) * np.pi / edges
    return np.stack([np.cos(angle), np.sin(angle), np.linalg.norm(middle, axis=-1)], axis=-1)


def soft_facet_rows(friction: float, edges: int) -> np.ndarray:
    """(2 edges, 4) rows of the polytope with the edges of the pyramid and two poles of pure torsion, moments in N.

    Every facet holds two neighbouring edges and a pole: it is what no edge and no pole exceeds.
    """
    if friction == 0:
        return np.tile([0.0, 0.0, np.cos(np.pi / edges), 0.0], (2 * edges, 1))
    angle = 2 * np.pi * np.arange(edges) / edges
    edge = np.stack([friction * np.cos(angle), friction * np.sin(angle), -np.ones(edges), np.zeros(edges)], axis=-1)
    rows = []
    for sign in (1.0, -1.0):
        for k in range(edges):
            corners = np.stack(
                [edge[k], edge[(k + 1) % edges], [0.0, 0.0, -1.0, sign * friction], [0.0, 0.0, -1.0, 0.0]]
            )
            # Zero at the corners, and below zero inside.
            row = np.linalg.solve(corners, [0.0, 0.0, 0.0, -1.0])
            rows.append(row / np.linalg.norm(row[:2]))
    return np.array(rows)


def compliance_matrix(compliance: np.ndarray | None, n_c: int, components: int = 3) -> np.ndarray:
    """(3 n_c, 3 n_c), or (n_d, 3 n_c, 3 n_c) where every direction has its own; 4 for 3 with torsion."""
    if compliance is None:
        return np.eye(components * n_c)
    blocks = compliance.shape == (n_c, components, components)
    return np.asarray(scipy.linalg.block_diag(*compliance)) if blocks else compliance


def least_norm(G: np.ndarray, Q: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """(n, 3 n_c): for each of the (n, rank) targets the x of least x' Q x with G x = target; G has full row rank."""
    root = np.linalg.cholesky(Q).T
    B = np.linalg.solve(root.T, G.T).T
    return np.linalg.solve(root, np.linalg.lstsq(B, targets.T, rcond=None)[0]).T


def worst_case(grasp: Grasp) -> tuple[np.ndarray, np.ndarray]:
    """Equations (17) and (18): S_1 (n_c n_e,) <= 0 and S_2 (n_c,) >= 0."""
    changes = grasp.force_changes
    return (changes @ grasp.cone_matrix.T).min(axis=0), (changes @ grasp.normal_matrix.T).max(axis=0)


@dataclass(frozen=True, kw_only=True)
class Program:
    """The rows of (21) or (16) in units in which every number is of order one: A g + sigma t <= h, B g = c."""

    A: np.ndarray
    h: np.ndarray
    sigma: np.ndarray
    B: np.ndarray
    c: np.ndarray
    columns: np.ndarray
    """f = columns * g."""
    scale: float
    """lambda = scale * t."""


def program(grasp: Grasp, every_direction: bool = False) -> Program:
    """(21), or (16) with `every_direction`, which keeps the rows of all disturbances apart."""
    F, mu = grasp.max_force, grasp.friction
    tangential = np.where(mu > 0, mu, 1.0) * F
    columns = np.stack([tangential, tangential, F, tangential][: grasp.components], axis=-1).reshape(-1)
    cone_unit = np.repeat(tangential, len(grasp.cone_matrix) // len(F))
    rows = np.vstack([grasp.cone_matrix, -grasp.normal_matrix])
    unit = np.concatenate([cone_unit, F])
    limit = np.concatenate([-grasp.row_margins, F])
    change = -grasp.force_changes @ rows.T
    sigma = change.reshape(-1) if every_direction else change.max(axis=0)
    cases = len(change) if every_direction else 1
    sigma = sigma / np.tile(unit, cases)
    scale = 1.0 / sigma.max() if sigma.max() > 0 else 1.0
    U, singular, Vt = np.linalg.svd(grasp.row_scale[:, None] * grasp.grasp_map * columns, full_matrices=False)
    keep = singular > RANK_TOLERANCE * singular[0]
    return Program(
        A=np.tile(rows * columns / unit[:, None], (cases, 1)),
        h=np.tile(limit / unit, cases),
        sigma=sigma * scale,
        B=Vt[keep],
        c=(U.T @ (grasp.row_scale * grasp.required_wrench))[keep] / singular[keep],
        columns=columns,
        scale=float(scale),
    )


def largest_disturbances(grasps: Sequence[Grasp], every_direction: bool = False) -> list[Answer]:
    """The program (21), or (16), of every grasp, by HiGHS.

    lambda is free, so that a negative one proves that the required wrench cannot be borne. Where G has not full rank,
    a required wrench outside its range makes the program infeasible, and a disturbance outside it makes the margin 0.
    """
    programs, unanswerable = [], []
    for grasp in grasps:
        p = program(grasp, every_direction)
        if grasp.outside_range(grasp.required_wrench[None]).any():
            p = replace(p, c=np.full_like(p.c, np.nan))
        unanswerable.append(bool(grasp.outside_range(grasp.vertices).any()))
        programs.append(p)
    asked = [
        replace(p, sigma=np.ones_like(p.sigma)) if never or not p.sigma.any() else p
        for p, never in zip(programs, unanswerable, strict=True)
    ]
    answers = []
    for p, never, t in zip(programs, unanswerable, _solve_all(asked), strict=True):
        status, margin = "SOLVED" if t >= -RANK_TOLERANCE else "INFEASIBLE", t * p.scale
        if never:
            margin = 0.0 if status == "SOLVED" else np.nan
        elif not p.sigma.any():
            status, margin = ("UNBOUNDED", np.inf) if status == "SOLVED" else (status, np.nan)
        one_sided = bool(np.any(p.sigma < RANK_TOLERANCE))
        answers.append(
            Answer(status=status, margin=float(margin), scale=p.scale, by_definition=never, one_sided=one_sided)
        )
    return answers


def largest_disturbance(grasp: Grasp, every_direction: bool = False) -> Answer:
    return largest_disturbances([grasp], every_direction)[0]


def _solve_all(programs: Sequence[Program]) -> np.ndarray:
    """The largest t of every program, nan where it is infeasible; several programs side by side in one call."""
    if not programs:
        return np.zeros(0)
    together = max(1, ROWS_A_CALL // max(len(p.h) for p in programs))
    groups = [programs[k : k + together] for k in range(0, len(programs), together)]
    return np.concatenate([_solve(group) for group in groups])


def _solve(programs: Sequence[Program]) -> np.ndarray:
    alive = [p for p in programs if not np.isnan(p.c).any()]
    answer = np.full(len(programs), np.nan)
    if not alive:
        return answer
    rows = scipy.sparse.block_diag([np.column_stack([p.A, p.sigma]) for p in alive], format="csc")
    equalities = scipy.sparse.block_diag([np.column_stack([p.B, np.zeros(len(p.B))]) for p in alive], format="csc")
    h, c = (np.concatenate([getattr(p, name) for p in alive]) for name in ("h", "c"))
    last = np.cumsum([p.A.shape[1] + 1 for p in alive]) - 1
    cost = np.zeros(rows.shape[1])
    cost[last] = -1.0
    result = linprog(cost, rows, h, equalities, c, (None, None), "highs", options=HIGHS_OPTIONS)
    if result.status == 0:
        answer[[not np.isnan(p.c).any() for p in programs]] = result.x[last]
        return answer
    if len(programs) > 1:
        return np.concatenate([_solve([p]) for p in programs])
    if result.status != 2:
        raise RuntimeError(f"HiGHS: {result.message}")
    return answer


def least_effort(grasp: Grasp, margin: float, weights: np.ndarray | None = None) -> float:
    """The program (22) by Clarabel: the least 1/2 f' Q_0 f at the given margin; nan where there is no such f."""
    p = program(grasp)
    P = p.columns[:, None] * compliance_matrix(weights, len(grasp.positions), grasp.components) * p.columns
    unit = P.max()
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    rows = scipy.sparse.csc_matrix(np.vstack([p.B, p.A]))
    rhs = np.concatenate([p.c, p.h - p.sigma * (margin / p.scale)])
    cones = [clarabel.ZeroConeT(len(p.c)), clarabel.NonnegativeConeT(len(p.h))]
    P = scipy.sparse.csc_matrix(np.triu(P / unit))
    solution = clarabel.DefaultSolver(P, np.zeros(len(p.columns)), rows, rhs, cones, settings).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved", "InsufficientProgress"):
        return np.nan
    return float(solution.obj_val) * unit


def row_violation(grasp: Grasp, forces: np.ndarray, margin: float) -> float:
    """How far (n_c, 3) forces, (n_c, 4) with moments in newtons, overstep (21)'s rows at the margin, by f_max."""
    S_1, S_2 = worst_case(grasp)
    f, F = forces.reshape(-1), grasp.max_force
    cone = (grasp.cone_matrix @ f - S_1 * margin + grasp.row_margins) / np.repeat(F, len(S_1) // len(F))
    bound = (-(grasp.normal_matrix @ f) + S_2 * margin - F) / F
    balance = (grasp.grasp_map @ f - grasp.required_wrench) * grasp.row_scale / F.max()
    return float(max(cone.max(), bound.max(), np.abs(balance).max()))


def required_wrench(mass, gravity, inertia, twist, acceleration) -> np.ndarray:
    """Equations (2), (3): the wrench of the contacts that moves a rigid body so, about its centre of mass."""
    v, w = np.split(np.asarray(twist), 2)
    linear, angular = np.split(np.asarray(acceleration), 2)
    force = mass * (linear + np.cross(w, v) - np.asarray(gravity))
    return np.concatenate([force, inertia @ angular + np.cross(w, inertia @ w)])


def actuated_rows(
    G: np.ndarray,
    friction: np.ndarray,
    max_force: np.ndarray,
    actuation: dict[str, np.ndarray],
    wrenches: np.ndarray,
    load: np.ndarray,
    compliance: np.ndarray | None = None,
    edges: int = 8,
) -> tuple[np.ndarray, ...]:
    """(21) of one grasp and its actuators over (f, u, lambda), every row written out: A x <= h, B x = c.

    `actuation` has jacobian (n_c, 3, n_v), transmission (n_v, n_u), lower and upper (n_u,).
    """
    n_c, joints = len(friction), actuation["jacobian"].shape[-1]
    # Without friction a contact has its normal force alone.
    felt = np.stack([friction > 0, friction > 0, friction >= 0], axis=-1).reshape(-1)
    G, J, B = G * felt, actuation["jacobian"].reshape(3 * n_c, joints) * felt[:, None], actuation["transmission"]
    count = B.shape[1]
    left, values, _ = np.linalg.svd(B)
    unreached = left[:, np.sum(values > RANK_TOLERANCE * values[0]) :]
    stacked = np.vstack([G, unreached.T @ J.T])
    weights = np.where(felt[:, None] & felt, compliance_matrix(compliance, n_c), np.eye(3 * n_c))
    root = np.linalg.cholesky(weights)
    star = np.linalg.solve(root.T, np.linalg.pinv(np.linalg.solve(root, stacked.T).T, RANK_TOLERANCE))[:, :6]
    force = -wrenches @ star.T
    effort = force @ J @ np.linalg.pinv(B).T
    C = scipy.linalg.block_diag(*(facet_rows(mu, edges) for mu in friction))
    E = np.kron(np.eye(n_c), [0.0, 0.0, 1.0])
    worst = lambda change: np.maximum(change.max(0), 0)  # noqa: E731
    A = np.zeros((len(C) + n_c + 2 * count, 3 * n_c + count + 1))
    A[: len(C), : 3 * n_c], A[len(C) : len(C) + n_c, : 3 * n_c] = C, -E
    A[-2 * count : -count, 3 * n_c : -1], A[-count:, 3 * n_c : -1] = np.eye(count), -np.eye(count)
    A[:, -1] = np.concatenate([worst(force @ C.T), worst(-force @ E.T), worst(effort), worst(-effort)])
    h = np.concatenate([np.zeros(len(C)), max_force, actuation["upper"], -actuation["lower"]])
    equal = np.zeros((6 + joints, A.shape[1]))
    equal[:6, : 3 * n_c], equal[6:, : 3 * n_c], equal[6:, 3 * n_c : -1] = G, J.T, -B
    return A, h, equal, np.concatenate([load, np.zeros(joints)])


def largest_actuated(A: np.ndarray, h: np.ndarray, equal: np.ndarray, c: np.ndarray) -> float:
    """The largest last unknown by HiGHS; nan where there is none."""
    cost = np.append(np.zeros(A.shape[1] - 1), -1.0)
    # Torques and moments are small numbers; joints that neither contacts nor actuators reach have rows of zeros.
    size = np.abs(equal).max(1)
    size[size == 0] = 1.0
    options = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    result = linprog(cost, A, h, equal / size[:, None], c / size, (None, None), "highs", options=options)
    return -result.fun if result.status == 0 else np.nan
