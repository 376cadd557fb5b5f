"""Random grasps, the linear programs (21) that they make, and their optimum by HiGHS.

NumPy and SciPy only, nothing of the package.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

FRICTION, MAX_FORCE, EDGES = 0.8, 2.0, 8
SIX_FORCES = np.vstack([np.eye(6)[:3], -np.eye(6)[:3]])
AXES = np.array([1.0, 0.8, 0.6])


@dataclass(frozen=True)
class Grasps:
    """Fingers anywhere on an ellipsoid, tangents turned at random."""

    positions: np.ndarray
    """(grasps, n_c, 3), m."""
    frames: np.ndarray
    """(grasps, n_c, 3, 3), columns t1, t2, n."""

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, rows) -> Grasps:
        return Grasps(self.positions[rows], self.frames[rows])

    def columns(self) -> np.ndarray:
        """The blocks of the grasp map G, (grasps, n_c, 6, 3)."""
        moments = np.cross(self.positions[..., None, :], np.swapaxes(self.frames, -1, -2))
        return np.concatenate([self.frames, np.swapaxes(moments, -1, -2)], -2)


@dataclass(frozen=True)
class Programs:
    """(21) as min cost'x, A x <= h, B x = 0 with x = (scaled forces, lambda / Lambda), all numbers of order one."""

    A: np.ndarray
    """(programs, n_c (n_e + 1), 3 n_c + 1)."""
    h: np.ndarray
    """(n_c (n_e + 1),), the same for all."""
    B: np.ndarray
    """(programs, 6, 3 n_c + 1), orthonormal rows."""
    cost: np.ndarray
    """(3 n_c + 1,)."""
    scale: np.ndarray
    """(programs,), Lambda in newtons: lambda = Lambda x[-1]."""
    S_1: np.ndarray
    """(programs, n_c, n_e), unscaled."""
    S_2: np.ndarray
    """(programs, n_c), unscaled."""

    def __len__(self) -> int:
        return len(self.A)

    def __getitem__(self, rows) -> Programs:
        shared = ("h", "cost")
        return Programs(**{f.name: getattr(self, f.name)[... if f.name in shared else rows] for f in fields(self)})


def sample(count: int, n_c: int, seed: int = 0) -> Grasps:
    rng = np.random.default_rng([seed, n_c])
    unit = rng.normal(size=(count, n_c, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    normals = unit / AXES
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    first = np.cross(rng.normal(size=unit.shape), normals)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return Grasps(unit * AXES, np.stack([first, np.cross(normals, first), normals], -1))


def facets(edges: int = EDGES) -> np.ndarray:
    """(edges, 3): the rows of the inscribed pyramid in units of mu F and F."""
    half_angle = (2 * np.arange(edges) + 1) * np.pi / edges
    return np.stack([np.cos(half_angle), np.sin(half_angle), np.full(edges, np.cos(np.pi / edges))], -1)


def programs(grasps: Grasps, wrenches: np.ndarray = SIX_FORCES) -> Programs:
    count, n_c = grasps.positions.shape[:2]
    G = np.swapaxes(grasps.columns(), 1, 2).reshape(count, 6, 3 * n_c)
    changes = (np.linalg.pinv(G) @ wrenches.T).reshape(count, n_c, 3, -1)
    rows = facets() * [1.0, 1.0, FRICTION]
    S_1 = np.minimum(0.0, np.einsum("ke,gned->gnkd", rows, changes).min(-1))
    S_2 = np.maximum(0.0, changes[:, :, 2].max(-1))
    sigma = np.concatenate([-S_1 / FRICTION, S_2[..., None]], -1) / MAX_FORCE
    scale = 1.0 / sigma.max((1, 2))
    block = np.vstack([facets(), [0.0, 0.0, -1.0]])
    A = np.zeros((count, n_c, EDGES + 1, 3 * n_c + 1))
    for i in range(n_c):
        A[:, i, :, 3 * i : 3 * i + 3] = block
    A[..., -1] = sigma * scale[:, None, None]
    B = np.zeros((count, 6, 3 * n_c + 1))
    B[..., :-1] = np.swapaxes(np.linalg.qr(np.swapaxes(G * np.tile([FRICTION, FRICTION, 1.0], n_c), 1, 2))[0], 1, 2)
    return Programs(
        A=A.reshape(count, -1, 3 * n_c + 1),
        h=np.tile(np.r_[np.zeros(EDGES), 1.0], n_c),
        B=B,
        cost=np.r_[np.zeros(3 * n_c), -1.0],
        scale=scale,
        S_1=S_1,
        S_2=S_2,
    )


def highs(batch: Programs, tolerance: float, together: int) -> np.ndarray:
    """x[-1] of every program, nan where HiGHS does not call it optimal; `together` of them side by side in a call."""
    answers = np.full(len(batch), np.nan)
    # Without presolve: it costs more than it saves on programs this small and dense.
    options = {"primal_feasibility_tolerance": tolerance, "dual_feasibility_tolerance": tolerance, "presolve": False}
    for start in range(0, len(batch), together):
        part = batch[start : start + together]
        result = linprog(
            np.tile(part.cost, len(part)),
            sp.block_diag(list(part.A), format="csc"),
            np.tile(part.h, len(part)),
            sp.block_diag(list(part.B), format="csc"),
            np.zeros(6 * len(part)),
            (None, None),
            "highs",
            options=options,
        )
        if result.status == 0:
            answers[start : start + together] = result.x.reshape(len(part), -1)[:, -1]
    return answers
