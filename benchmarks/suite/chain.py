"""The paper's chain of formulations as whole programs for HiGHS and Clarabel, and grasps to try them on.

NumPy, SciPy and Clarabel only, nothing of the package. Every program has all its unknowns: (12) and (13) one force of
every contact at rest and under every disturbance, tied by lambda; (16) the rows of all directions.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import clarabel
import numpy as np
import scipy.sparse as sp
from scipy.linalg import block_diag
from scipy.optimize import linprog

REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "ycb_allegro_grasps.npz"
HIGHS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Case:
    """One grasp: (n_c, 3), (n_c, 3, 3), (n_c,), (n_c,), wrenches (n_d, 6), load (6,), cone margins (n_c, 1 or n_e)."""

    positions: np.ndarray
    frames: np.ndarray
    friction: np.ndarray
    max_force: np.ndarray
    wrenches: np.ndarray
    load: np.ndarray
    edges: int = 8
    cone_margins: np.ndarray | float = 0.0
    torsional: np.ndarray | None = None
    """(n_c,), m: soft contacts, with moments m as the fourth component m mu / gamma; None for hard ones."""

    @property
    def size(self) -> int:
        """The number of components of a contact's force."""
        return 3 if self.torsional is None else 4

    @cached_property
    def units(self) -> np.ndarray:
        """(6,): moments by the contacts' distance, all by the mean of f_max."""
        length = np.sqrt(np.mean(np.sum(self.positions**2, -1))) or 1.0
        return np.repeat([1.0, 1 / length], 3) / self.max_force.mean()

    @cached_property
    def G(self) -> np.ndarray:
        """(6, size n_c) for forces in units of f_max; zero for tangents, and moments, of contacts without friction."""
        frames = self.frames * np.stack([self.friction > 0] * 2 + [self.friction >= 0], -1)[:, None]
        moments = np.cross(self.positions[:, :, None], frames, axis=1)
        blocks = np.concatenate([frames, moments], 1)
        if self.torsional is not None:
            arms = self.torsional / np.where(self.friction > 0, self.friction, np.inf)
            turn = self.frames[..., 2] * arms[:, None]
            blocks = np.concatenate([blocks, np.concatenate([0 * turn, turn], 1)[..., None]], 2)
        blocks = blocks * self.max_force[:, None, None]
        return self.units[:, None] * blocks.transpose(1, 0, 2).reshape(6, -1)

    @cached_property
    def W(self) -> np.ndarray:
        """(n_d, 6), for lambda in units of `scale`."""
        return self.wrenches * self.units * self.scale

    @cached_property
    def scale(self) -> float:
        """Lambda is measured in this."""
        return 1 / np.abs(self.wrenches * self.units).max()

    @cached_property
    def b(self) -> np.ndarray:
        """(6,)."""
        return self.load * self.units

    @cached_property
    def answers(self) -> np.ndarray:
        """(n_d + 1, size n_c): blocking forces for one unit of lambda, then those at rest; Q = I in newtons."""
        weights = np.repeat(self.max_force, self.size)
        G = self.G / weights
        U, s, V = np.linalg.svd(G, full_matrices=False)
        keep = s > RANK_TOLERANCE * s[0]
        inverse = (V[keep].T / s[keep]) @ U[:, keep].T
        return np.vstack([-self.W @ inverse.T / weights, np.zeros(G.shape[1])])

    @cached_property
    def outside(self) -> bool:
        """Whether some disturbance is outside the range of G."""
        missed = self.W + (self.answers[:-1]) @ self.G.T
        return bool(np.any(np.abs(missed).max(-1) > 1e-8 * np.abs(self.W).max(-1).clip(1e-300)))

    @cached_property
    def independent(self) -> np.ndarray:
        """(r, 6): orthonormal combinations of the equalities that say all that they say.

        Clarabel stalls on equalities that follow from each other.
        """
        U, s, _ = np.linalg.svd(np.column_stack([self.G, self.W.T, self.b]), full_matrices=False)
        return U[:, s > RANK_TOLERANCE * s[0]].T

    @cached_property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and right-hand sides of every contact: the pyramid or, with moments, two; then the bound."""
        angles = np.pi * (2 * np.arange(self.edges) + 1) / self.edges
        blocks = []
        for mu in self.friction:
            facets = np.stack(
                [np.cos(angles), np.sin(angles), np.full(self.edges, mu * np.cos(np.pi / self.edges))], -1
            )
            # Without friction the finger does not pull.
            facets = facets if mu > 0 else np.tile([0, 0, np.cos(np.pi / self.edges)], (self.edges, 1))
            if self.torsional is not None:
                pole = np.full((self.edges, 1), np.cos(np.pi / self.edges) * (mu > 0))
                facets = np.vstack([np.hstack([facets, pole]), np.hstack([facets, -pole])])
            blocks.append(np.vstack([facets, -np.eye(self.size)[2:3]]))
        shares = self.cone_margins / self.max_force[:, None]
        sides = np.hstack([-shares + np.zeros((len(blocks), len(blocks[0]) - 1)), np.ones((len(blocks), 1))])
        return sp.block_diag(blocks).toarray(), sides.reshape(-1)

    def cones(self, norm_bound: bool) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """(kind, A, h) with h - A f in the cone: kind "q" second-order, "l" non-negative; a contact after the other."""
        n, parts = len(self.friction), []
        shares = np.broadcast_to(self.cone_margins / self.max_force[:, None], (n, 1))[:, 0]
        for i, mu in enumerate(self.friction):
            e = np.eye(self.size * n)[self.size * i : self.size * (i + 1)]
            coulomb = ("q", np.vstack([mu * e[2], -np.delete(e, 2, 0)]), -shares[i] * np.eye(self.size)[0])
            parts.append(coulomb if mu > 0 else ("l", e[2:3], np.array([-shares[i]])))
            if norm_bound:
                parts.append(("q", np.vstack([0 * e[:1], -e[:3]]), np.array([1.0, 0, 0, 0])))
            else:
                parts.append(("l", -e[2:3], np.ones(1)))
        return parts


def rest(case: Case) -> bool:
    """Whether some admissible f_0 of the pyramids bears b."""
    A, h = case.rows
    out = linprog(np.zeros(A.shape[1]), A_ub=A, b_ub=h, A_eq=case.G, b_eq=case.b, bounds=(None, None), options=HIGHS)
    return out.status == 0


def _lp(A, h, B, c, lam: int) -> float:
    cost = np.zeros(A.shape[1])
    cost[lam] = -1
    out = linprog(
        cost, A_ub=sp.csr_matrix(A), b_ub=h, A_eq=sp.csr_matrix(B), b_eq=c, bounds=(None, None), options=HIGHS
    )
    return -out.fun if out.status == 0 else np.nan


def _least(rows: list, h: np.ndarray, equal: list, case: Case) -> float:
    """The least lambda of programs side by side, the last unknown of each; nan where one is infeasible."""
    count, size = len(rows), rows[0].shape[1]
    cost = np.tile(np.r_[np.zeros(size - 1), -1.0], count)
    A, B = sp.block_diag(rows, format="csr"), sp.block_diag(equal, format="csr")
    out = linprog(cost, A, np.tile(h, count), B, np.tile(case.b, count), bounds=(None, None), options=HIGHS)
    least = np.min(out.x.reshape(count, -1)[:, -1]) if out.status == 0 else np.nan
    return least * case.scale if not least < -1e-9 else np.nan


def per_direction(case: Case) -> float:
    """The least over the directions of max lambda with G f = b - lambda W_j; nan where one is infeasible.

    A load outside the range of G counts as infeasible, even where a disturbance outside it would cancel that part.
    """
    A, h = case.rows
    if np.abs(case.b - case.G @ np.linalg.lstsq(case.G, case.b)[0]).max() > 1e-8 * max(np.abs(case.b).max(), 1e-300):
        return np.nan
    rows = [np.hstack([A, np.zeros((len(A), 1))])] * len(case.W)
    return _least(rows, h, [np.hstack([case.G, w[:, None]]) for w in case.W], case)


def unreduced(case: Case) -> float:
    """(13), one program."""
    (A, h), count = case.rows, len(case.W) + 1
    rows = sp.hstack([sp.block_diag([A] * count), sp.csr_matrix((count * len(A), 1))])
    wrenches = np.vstack([case.W, np.zeros(6)]).reshape(-1, 1)
    equal = sp.hstack([sp.block_diag([case.G] * count), sp.csr_matrix(wrenches)])
    value = _lp(rows, np.tile(h, count), equal, np.tile(case.b, count), -1)
    return value * case.scale if not value < -1e-9 else np.nan


def every_direction(case: Case) -> float:
    """(16), the rows of all directions."""
    A, h = case.rows
    if case.outside:
        return 0.0 if rest(case) else np.nan
    rows = np.vstack([np.hstack([A, (A @ a)[:, None]]) for a in case.answers])
    value = _lp(rows, np.tile(h, len(case.answers)), np.hstack([case.G, np.zeros((6, 1))]), case.b, -1)
    return value * case.scale if not value < -1e-9 else np.nan


def prestrained(case: Case) -> float:
    """Blocking forces, another f_0 for each direction."""
    A, h = case.rows
    if case.outside:
        return 0.0 if rest(case) else np.nan
    both = lambda a: np.vstack([np.hstack([A, (A @ one)[:, None]]) for one in (a, 0 * a)])  # noqa: E731
    rows = [both(a) for a in case.answers[:-1]]
    return _least(rows, np.tile(h, 2), [np.hstack([case.G, np.zeros((6, 1))])] * len(rows), case)


def _clarabel(P, cost, rows, cones, equal, sides, tolerances=(1e-9, 1e-8)) -> tuple[str, np.ndarray, float]:
    """Rows in the cones (kind, _, h), one after the other; looser where Clarabel stalls."""
    for tolerance in tolerances:
        found = _clarabel_to(tolerance, P, cost, rows, cones, equal, sides)
        if found[0] in ("Solved", "PrimalInfeasible"):
            break
    return found


def _clarabel_to(tolerance: float, P, cost, rows, cones, equal, sides) -> tuple[str, np.ndarray, float]:
    stacked = sp.vstack([sp.csr_matrix(equal), sp.csr_matrix(rows)]).tocsc()
    # Stored zeros cost it digits: it then stalls on every third program.
    stacked.eliminate_zeros()
    kinds = [clarabel.ZeroConeT(equal.shape[0])]
    for kind, _, h in cones:
        kinds.append(clarabel.SecondOrderConeT(len(h)) if kind == "q" else clarabel.NonnegativeConeT(len(h)))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    right = np.concatenate([sides, *[h for *_, h in cones]])
    out = clarabel.DefaultSolver(sp.csc_matrix(P), cost, stacked, right, kinds, settings).solve()
    return str(out.status), np.array(out.x), out.obj_val


def _by_clarabel(cost, rows, cones, equal, sides) -> float:
    size = len(cost)
    status, _, value = _clarabel(sp.csc_matrix((size, size)), cost, rows, cones, equal, sides)
    if status == "Solved":
        return -value
    return np.nan if "Infeasible" in status else np.inf


def exact(case: Case, norm_bound: bool = False) -> float:
    """(12) with free delta f_j, one second-order cone program; nan where infeasible, inf where Clarabel fails.

    Where it fails on the whole program it is asked for f_0 and one direction at a time.
    """
    whole = _exact(case, case.W, norm_bound)
    if not np.isinf(whole):
        return whole
    each = [_exact(case, w[None], norm_bound) for w in case.W]
    return np.inf if np.isinf(each).any() else np.min(each)


def _exact(case: Case, W: np.ndarray, norm_bound: bool) -> float:
    count, size = len(W) + 1, case.G.shape[1]
    cones = case.cones(norm_bound)
    own = np.vstack([A for _, A, _ in cones])
    rows = sp.hstack([sp.block_diag([own] * count), sp.csr_matrix((count * len(own), 1))])
    U = case.independent
    wrenches = (np.vstack([W, np.zeros(6)]) @ U.T).reshape(-1, 1)
    equal = sp.hstack([sp.block_diag([U @ case.G] * count), sp.csr_matrix(wrenches)])
    cost = np.zeros(count * size + 1)
    cost[-1] = -1
    value = _by_clarabel(cost, rows, cones * count, equal, np.tile(U @ case.b, count))
    return value * case.scale if not value < -1e-7 else np.nan


def exact_fixed(case: Case, norm_bound: bool = False) -> float:
    """(12) with blocking forces."""
    if case.outside:
        return min(exact(case, norm_bound), 0.0)
    cones = case.cones(norm_bound)
    own = np.vstack([A for _, A, _ in cones])
    rows = np.vstack([np.hstack([own, (own @ a)[:, None]]) for a in case.answers])
    cost = np.zeros(case.G.shape[1] + 1)
    cost[-1] = -1
    U = case.independent
    equal = np.hstack([U @ case.G, np.zeros((len(U), 1))])
    value = _by_clarabel(cost, rows, cones * len(case.answers), equal, U @ case.b)
    return value * case.scale if not value < -1e-7 else np.nan


ORACLES = {
    "12": exact,
    "12_fixed": exact_fixed,
    "13": unreduced,
    "16": every_direction,
    "per_direction": per_direction,
    "per_direction_prestrained": prestrained,
}


@dataclass(frozen=True)
class Batch:
    """Grasps of one shape: as `Case`, with a leading axis."""

    positions: np.ndarray
    frames: np.ndarray
    friction: np.ndarray
    max_force: np.ndarray
    wrenches: np.ndarray
    load: np.ndarray
    torsional: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, rows) -> Batch:
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return Batch(**{name: None if value is None else value[rows] for name, value in given.items()})

    def case(self, i: int, edges: int = 8, cone_margins: np.ndarray | float = 0.0) -> Case:
        """One of them."""
        wrenches = self.wrenches[i]
        wrenches = wrenches[np.any(wrenches != 0, -1)]
        torsional = None if self.torsional is None else self.torsional[i]
        given = self.positions[i], self.frames[i], self.friction[i], self.max_force[i]
        return Case(*given, wrenches, self.load[i], edges, cone_margins, torsional)


def _units(rng: np.random.Generator, *shape: int) -> np.ndarray:
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def sample(seed: int, count: int, n_c: int, n_d: int) -> Batch:
    """Random grasps on ellipsoids of 5 cm.

    A third without load, a third with a light and a third with a heavy one; one in eight has its contacts on one side,
    one in eight a contact twice, one in eight all in one line (rank 5); one in five has the six forces as disturbances.
    Half of the grasps whose G is short of rank have their wrenches in its range.
    """
    rng = np.random.default_rng(seed)
    axes = rng.uniform(0.4, 1.0, (count, 1, 3))
    u = _units(rng, count, n_c)
    u[:, 1] = -u[:, 0] + 0.5 * rng.normal(size=(count, 3))
    kind = np.arange(count) % 8
    u[kind == 0, :, 2] = np.abs(u[kind == 0, :, 2]) + 0.5
    if n_c > 2:
        u[kind == 1, -1] = u[kind == 1, 0]
    line = kind == 2
    u[line] = np.where(np.arange(n_c) % 2, -1.0, 1.0)[:, None] * u[line, :1]
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    normals = u / axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    t1 = np.cross(normals, _units(rng, count, n_c))
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    max_force = np.exp(rng.uniform(np.log(2.0), np.log(10.0), (count, n_c)))
    share = np.array([0.0, 0.05, 0.3])[np.arange(count) % 3] * rng.uniform(0.2, 1, count)
    load = np.concatenate([_units(rng, count), 0.02 * _units(rng, count)], -1) * (share * max_force.sum(-1))[:, None]
    wrenches = np.concatenate([_units(rng, count, n_d), 0.05 * _units(rng, count, n_d)], -1)
    plain = np.arange(count) % 5 == 0
    wrenches[plain] = 0
    wrenches[plain, :6] = np.vstack([np.eye(6)[:3], -np.eye(6)[:3]])
    positions, frames = 0.05 * u * axes, np.stack([t1, np.cross(normals, t1), normals], -1)
    into = projections(positions, frames)
    into[np.arange(count) // 8 % 2 > 0] = np.eye(6)
    load, wrenches = np.einsum("nab,nb->na", into, load), np.einsum("nab,njb->nja", into, wrenches)
    return Batch(
        positions,
        frames,
        np.exp(rng.uniform(np.log(0.2), np.log(1.2), (count, n_c))),
        max_force,
        wrenches,
        load,
    )


def projections(positions: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Of wrenches onto the range of G, orthogonal for moments over 5 cm; exactly I where that is everything."""
    moments = np.cross(positions[:, :, :, None], frames, axis=2) / 0.05
    G = np.concatenate([frames, moments], 2).transpose(0, 2, 1, 3).reshape(len(positions), 6, -1)
    units = np.diag(np.repeat([1.0, 0.05], 3))
    out = np.tile(np.eye(6), (len(G), 1, 1))
    for i, one in enumerate(G):
        U, s, _ = np.linalg.svd(one)
        keep = s > RANK_TOLERANCE * s[0]
        if not keep.all():
            out[i] = units @ U[:, keep] @ U[:, keep].T @ np.linalg.inv(units)
    return out


def recorded() -> Batch | None:
    """The recorded grasps, without load and with their weight; None where they are absent."""
    if not REAL.exists():
        return None
    with np.load(REAL, allow_pickle=False) as data:
        positions, normals = data["positions"], data["outward_normals"]
        friction, mass = data["friction"], data["mass"]
    count, n_c = positions.shape[:2]
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    other = np.eye(3)[np.argmin(np.abs(normals), -1)]
    t1 = np.cross(normals, other)
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    load = np.zeros((2 * count, 6))
    load[count:, 2] = 9.81 * mass
    twice = lambda x: np.concatenate([x, x])  # noqa: E731
    return Batch(
        twice(positions),
        twice(np.stack([t1, np.cross(normals, t1), normals], -1)),
        twice(np.tile(friction[:, None], (1, n_c))),
        np.full((2 * count, n_c), 5.0),
        np.tile(np.vstack([np.eye(6)[:3], -np.eye(6)[:3]]), (2 * count, 1, 1)),
        load,
    )


def least_total_effort(
    case: Case, margin: float, at_rest: np.ndarray | None = None, changes: np.ndarray | None = None
) -> float:
    """(11), N^2; inf where infeasible, nan where Clarabel fails.

    Args:
        case: a grasp.
        margin: lambda.
        at_rest: Q_0, blocks (n_c, 3, 3) or full (3 n_c, 3 n_c); None for the identity.
        changes: Q, likewise, or one for each direction along the leading axis.
    """
    (A, h), size, count = case.rows, case.G.shape[1], len(case.W)
    unit = np.repeat(case.max_force, case.size)

    def whole(Q: np.ndarray | None) -> np.ndarray:
        Q = np.eye(size) if Q is None else block_diag(*Q) if Q.ndim == 3 else Q
        return unit[:, None] * Q * unit

    k = case.size
    blocks = (size // k, k, k), (size, size)
    each = [changes] * count if changes is None or changes.shape in blocks else changes
    weights = [whole(Q) for Q in (at_rest, *each)]
    # Unknowns f_0, then the changes.
    rows = sp.vstack(
        [
            sp.hstack([A, sp.csr_matrix((len(A), count * size))]),
            sp.hstack([sp.vstack([sp.csr_matrix(A)] * count), sp.block_diag([A] * count)]),
        ]
    )
    U = case.independent
    equal = sp.block_diag([U @ case.G] * (count + 1)).tocsr()
    sides = np.concatenate([U @ case.b, *(-margin / case.scale * case.W @ U.T)])
    scale = max(Q.max() for Q in weights)
    status, _, value = _clarabel(
        sp.block_diag([Q / scale for Q in weights]),
        np.zeros((count + 1) * size),
        rows,
        [("l", None, np.tile(h, count + 1))],
        equal,
        sides,
        (1e-12, 1e-11, 1e-10, 1e-9, 1e-8),
    )
    if status == "Solved":
        return value * scale
    return np.inf if "Infeasible" in status else np.nan
