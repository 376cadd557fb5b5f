"""The rows of (21) and (22) once more, in float64 NumPy and in newtons.

Nothing here is the package's: G from its definition, G* by singular values, S_1 and S_2 by the support functions of the
sets, the pyramid from its edges.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from benchmarks.suite.lanes import Lanes


@dataclass(frozen=True, kw_only=True)
class Tolerances:
    """What counts as wrong, by precision."""

    rows: float
    """Of G f = b, as a share of the larger of |b| and the sum of |f_i|; of every other row, of its max_force."""
    margin: float
    """Of margins and upper bounds, as a share of the mean max_force over the reach of the disturbances."""
    rank: tuple[float, float]
    """Singular values between these shares of the largest leave the rank in doubt."""
    outside: tuple[float, float]
    """The same of the share of a wrench that G does not reach."""
    effort: float
    """Of the least effort that multipliers prove, as a share of the effort."""
    crossed: float
    """An upper bound below the margin, as a share of the larger of both and of the margin's natural scale."""


TOLERANCES = {
    "float64": Tolerances(
        rows=1e-7, margin=1e-6, rank=(1e-13, 1e-6), outside=(1e-12, 1e-6), effort=1e-6, crossed=1e-11
    ),
    "float32": Tolerances(rows=3e-5, margin=1e-4, rank=(1e-7, 3e-3), outside=(1e-6, 3e-3), effort=1e-3, crossed=1e-5),
}


@dataclass(frozen=True, kw_only=True)
class Model:
    """The rows of a batch; moments are divided by `length`."""

    length: np.ndarray
    """(lanes,), root-mean-square distance of the contacts, m; 1 where that is zero."""
    G: np.ndarray
    """(lanes, 6, n_c, 3); zero where a contact is absent, and for tangents of contacts without friction."""
    b: np.ndarray
    """(lanes, 6)."""
    active: np.ndarray
    """(lanes, n_c)."""
    smooth: np.ndarray
    """(lanes, n_c) bool: contacts without friction, which transmit their normal force alone."""
    friction: np.ndarray
    """(lanes, n_c), 1 where absent or 0: the rows of C then say that a finger does not pull."""
    max_force: np.ndarray
    """(lanes, n_c), 1 where absent."""
    reserve: np.ndarray
    """(lanes,)."""
    facets: np.ndarray
    """(n_e, 3), of unit friction."""
    S_1: np.ndarray
    """(lanes, n_c, n_e), zero where absent."""
    S_2: np.ndarray
    """(lanes, n_c), zero where absent."""
    rank: np.ndarray
    """(lanes,), as used for S_1 and S_2."""
    doubtful: np.ndarray
    """(lanes,) bool: rank, or whether b or the disturbances are within reach, is in doubt."""
    load_outside: np.ndarray
    """(lanes,) bool: G does not reach b."""
    set_outside: np.ndarray
    """(lanes,) bool: G does not reach some disturbance."""
    rounding: np.ndarray
    """(lanes,), how far S_1 and S_2 may be off by rounding here, N."""
    reach: np.ndarray
    """(lanes,), the largest disturbance in N."""
    scale: np.ndarray
    """(lanes,), Lambda: one over the largest of -S_1 / (mu f_max) and S_2 / f_max; 1 without disturbances."""

    def __getitem__(self, lanes) -> Model:
        names = [f.name for f in fields(self)]
        return Model(**{n: getattr(self, n) if n == "facets" else getattr(self, n)[lanes] for n in names})

    @property
    def mean_force(self) -> np.ndarray:
        """Mean max_force over the reach of the disturbances: the unit of `Tolerances.margin`, (lanes,)."""
        there = np.maximum(self.active.sum(-1), 1)
        mean = np.sum(self.max_force * self.active, axis=-1) / there
        return np.where(mean > 0, mean, 1.0) / self.reach

    @property
    def radii(self) -> np.ndarray:
        """(lanes, n_c, 3): no admissible force component is larger, while lambda and the reserve are not negative."""
        tangential = np.where(self.smooth, 0.0, self.friction) * self.max_force
        return np.stack([tangential, tangential, self.max_force], axis=-1) * self.active[..., None]

    def cone(self, forces: np.ndarray) -> np.ndarray:
        """C f, (lanes, n_c, n_e)."""
        tangential = forces[..., :2] @ self.facets[:, :2].T
        return tangential + self.facets[:, 2] * (self.friction * forces[..., 2])[..., None]

    def slacks(self, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-d - C f and f_max + f_n: what is left of the rows at lambda = 0."""
        return -self.reserve[:, None, None] - self.cone(forces), self.max_force + forces[..., 2]

    def imbalance(self, forces: np.ndarray) -> np.ndarray:
        """|G f - b| over the larger of |b| and the sum of |f_i|, (lanes,)."""
        missed = np.linalg.norm(np.einsum("lrcj,lcj->lr", self.G, forces) - self.b, axis=-1)
        size = np.maximum(np.linalg.norm(self.b, axis=-1), np.linalg.norm(forces, axis=-1).sum(-1))
        return np.where(missed == 0, 0.0, missed / np.where(size > 0, size, 1.0))

    def excess(self, forces: np.ndarray, margin: np.ndarray, allowed: float = 0.0) -> np.ndarray:
        """How far forces exceed a pyramid or bound row at a margin, the largest share of its max_force, (lanes,).

        `allowed`: how many times the rounding of S_1 and S_2 is taken off.
        """
        cone, bound = self.slacks(forces)
        reach = np.where(np.isfinite(margin), margin, 0.0)[:, None]
        spare = (allowed * self.rounding)[:, None] * np.abs(reach)
        over = -(cone + self.S_1 * reach[..., None]).min(-1), self.S_2 * reach - bound
        sideways = np.where(self.smooth, np.abs(forces[..., :2]).max(-1), 0.0)
        worst = (np.maximum(np.maximum(*over) - spare, sideways)) / self.max_force
        return np.where(self.active, worst, -np.inf).max(-1)


def model(lanes: Lanes, rank: np.ndarray, tolerances: Tolerances) -> Model:
    """The rows of sound lanes; where the rank is in doubt, with that which the package says."""
    on = lanes.active
    there = lambda x, other: np.where(on.reshape(*on.shape, *[1] * (x.ndim - 2)), x, other).astype(np.float64)  # noqa: E731
    smooth, max_force = on & (lanes.friction == 0), there(lanes.max_force, 1.0)
    friction = np.where(smooth, 1.0, there(lanes.friction, 1.0))
    frames = there(lanes.frames, 0.0)
    frames[..., :2] *= ~smooth[..., None, None]
    length, units, G = grasp_map(there(lanes.positions, 0.0), frames, on)
    b = lanes.wrench.astype(np.float64) * units

    left, values, right = np.linalg.svd(G.reshape(len(on), 6, -1), full_matrices=False)
    ratios = values / np.where(values[:, :1] > 0, values[:, :1], 1.0)
    least, most = ((ratios > bound).sum(-1) for bound in reversed(tolerances.rank))
    rank = np.clip(rank, least, most)
    kept = np.arange(6) < rank[:, None]
    inverse = np.swapaxes(right, 1, 2) @ ((kept / np.where(kept, values, 1.0))[..., None] * np.swapaxes(left, 1, 2))
    # G* of physical wrenches: (lanes, n_c, 3, 6).
    star = (inverse * units[:, None]).reshape(*on.shape, 3, 6)
    facets = pyramid(lanes.cone_edges)
    rows = np.einsum("ea,lcaw->lcew", facets[:, :2], star[:, :, :2])
    rows += facets[:, 2, None] * (friction[..., None] * star[:, :, 2])[:, :, None]
    rows = np.concatenate([-rows, star[:, :, 2:]], axis=2)
    lost = support(lanes, rows.reshape(len(on), -1, 6)).reshape(*on.shape, -1) * on[..., None]

    reach, load, beyond = out_of_reach(lanes, units, b, np.swapaxes(left, 1, 2) * ~kept[..., None])
    unsure = [(x > tolerances.outside[0]) & (x < tolerances.outside[1]) for x in (load, beyond)]
    smallest = np.take_along_axis(values, np.maximum(rank - 1, 0)[:, None], 1)[:, 0]
    condition = np.where(rank > 0, values[:, 0] / np.where(rank > 0, smallest, 1.0), 1.0)
    tangential = friction * max_force
    sigma = np.concatenate([lost[..., :-1] / tangential[..., None], lost[..., -1:] / max_force[..., None]], axis=-1)
    largest = sigma.max((1, 2))
    return Model(
        length=length,
        G=G,
        b=b,
        active=on,
        smooth=smooth,
        friction=friction,
        max_force=max_force,
        reserve=lanes.reserve.astype(np.float64),
        facets=facets,
        S_1=-lost[..., :-1],
        S_2=lost[..., -1],
        rank=rank,
        doubtful=(least < most) | unsure[0] | unsure[1],
        load_outside=load >= tolerances.outside[1],
        set_outside=beyond >= tolerances.outside[1],
        rounding=16 * np.finfo(np.float64).eps * condition * lost.max((1, 2)),
        reach=np.where(reach > 0, reach, 1.0),
        scale=1 / np.where(largest > 0, largest, 1.0),
    )


def grasp_map(positions: np.ndarray, frames: np.ndarray, on: np.ndarray) -> tuple[np.ndarray, ...]:
    """The grasp's size (lanes,), what turns wrenches into newtons (lanes, 6), and G (lanes, 6, n_c, 3) in newtons."""
    mean = np.sum(positions**2, axis=(1, 2)) / np.maximum(on.sum(-1), 1)
    length = np.sqrt(np.where(mean > 0, mean, 1.0))
    units = np.repeat(np.stack([np.ones_like(length), 1 / length], axis=-1), 3, axis=-1)
    columns = np.swapaxes(frames, -1, -2)
    moments = np.cross((positions / length[:, None, None])[:, :, None], columns)
    return length, units, np.moveaxis(np.concatenate([columns, moments], axis=-1), -1, 1)


def pyramid(edges: int) -> np.ndarray:
    """(edges, 3): rows of C for unit friction; edge k stands on Coulomb's cone at 2 pi k / edges from t1."""
    angle = (2 * np.arange(edges) + 1) * np.pi / edges
    return np.stack([np.cos(angle), np.sin(angle), np.full(edges, np.cos(np.pi / edges))], axis=-1)


def out_of_reach(lanes: Lanes, units: np.ndarray, b: np.ndarray, outside: np.ndarray) -> tuple[np.ndarray, ...]:
    """The largest disturbance in newtons, and which shares of b and of it G does not reach, (lanes,) each.

    `outside`: (lanes, 6, 6), an orthonormal basis of what G does not reach, and rows of zeros.
    """
    both = lambda some, rows: np.maximum(*(support(some, s * rows, exact=True).max(-1) for s in (1, -1)))  # noqa: E731
    reach = both(lanes, np.broadcast_to(units[:, None] * np.eye(6), (len(b), 6, 6)))
    load = np.linalg.norm(np.einsum("lkr,lr->lk", outside, b), axis=-1)
    load = load / np.where(load > 0, np.linalg.norm(b, axis=-1), 1.0)
    beyond, short = np.zeros(len(b)), np.flatnonzero(outside.any((1, 2)))
    if len(short):
        beyond[short] = both(lanes[short], outside[short] * units[short, None])
    return reach, load, beyond / np.where(reach > 0, reach, 1.0)


def support(lanes: Lanes, rows: np.ndarray, exact: bool = False) -> np.ndarray:
    """h_D(a), (lanes, rows), of the set and the origin; `exact`: that of the set before it was smoothed."""
    width = None if exact or lanes.width is None else lanes.width.astype(np.float64)[:, None]
    length = lambda x: np.abs(x) if width is None else np.hypot(x, width)  # noqa: E731
    total = np.zeros(rows.shape[:2])
    if lanes.vertices is not None:
        # Rows last: NumPy's maxima over a short last axis are slow.
        reach = lanes.vertices.astype(np.float64) @ np.swapaxes(rows, 1, 2)
        most = np.maximum(reach.max(1), 0.0)
        if width is not None:
            real = (lanes.vertices != 0).any(-1)[..., None]
            shares = np.where(real, np.exp((reach - most[:, None]) / width[:, None]), 0.0).sum(1)
            most = most + width * np.log(np.exp(-most / width) + shares)
        total += most
    if lanes.half_extents is not None:
        half = lanes.half_extents.astype(np.float64)
        total += np.sum([length(rows[..., i] * half[:, None, i]) for i in range(6)], axis=0)
    if lanes.radii is not None:
        radii = lanes.radii.astype(np.float64)
        total += length(radii[:, :1] * np.linalg.norm(rows[..., :3], axis=-1))
        total += length(radii[:, 1:] * np.linalg.norm(rows[..., 3:], axis=-1))
    if lanes.shape_matrix is not None:
        total += length(np.linalg.norm(rows @ lanes.shape_matrix.astype(np.float64), axis=-1))
    return total
