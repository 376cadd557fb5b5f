"""The programs (21) and (22) once more, in float64 NumPy, and what makes an answer to them wrong.

Nothing here is the package's: G from its definition, G* by singular values, S_1 and S_2 by the support functions of the
sets, rows in newtons, bounds by weak duality. A bound is the lane's own forces or multipliers put into these rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from benchmarks.suite.lanes import Claims, Lanes

SOLVED, INFEASIBLE, UNBOUNDED, INVALID = 0, 1, 2, 5


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
    crossed: float
    """An upper bound below the margin, as a share of the larger of both and of the margin's natural scale."""


TOLERANCES = {
    "float64": Tolerances(rows=1e-7, margin=1e-6, rank=(1e-13, 1e-6), outside=(1e-12, 1e-6), crossed=1e-11),
    "float32": Tolerances(rows=3e-5, margin=1e-4, rank=(1e-7, 3e-3), outside=(1e-6, 3e-3), crossed=1e-5),
}


@dataclass(frozen=True, kw_only=True)
class Model:
    """The rows of a batch; moments are divided by `length`."""

    length: np.ndarray
    """(lanes,), root-mean-square distance of the contacts, m; 1 where that is zero."""
    G: np.ndarray
    """(lanes, 6, n_c, 3); zero where a contact is absent."""
    b: np.ndarray
    """(lanes, 6)."""
    active: np.ndarray
    """(lanes, n_c)."""
    friction: np.ndarray
    """(lanes, n_c), 1 where absent."""
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
        tangential = self.friction * self.max_force
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
        # Rows of C without friction do not say that a finger cannot pull.
        pull = np.where(self.friction == 0, forces[..., 2], 0.0)
        worst = (np.maximum(np.maximum(*over) - spare, pull)) / self.max_force
        return np.where(self.active, worst, -np.inf).max(-1)


def model(lanes: Lanes, rank: np.ndarray, tolerances: Tolerances) -> Model:
    """The rows of sound lanes; where the rank is in doubt, with that which the package says."""
    on = lanes.active
    there = lambda x, other: np.where(on.reshape(*on.shape, *[1] * (x.ndim - 2)), x, other).astype(np.float64)  # noqa: E731
    positions, frames = there(lanes.positions, 0.0), there(lanes.frames, 0.0)
    friction, max_force = there(lanes.friction, 1.0), there(lanes.max_force, 1.0)
    mean = np.sum(positions**2, axis=(1, 2)) / np.maximum(on.sum(-1), 1)
    length = np.sqrt(np.where(mean > 0, mean, 1.0))
    units = np.repeat(np.stack([np.ones_like(length), 1 / length], axis=-1), 3, axis=-1)
    moments = np.cross(positions[:, :, None], np.swapaxes(frames, -1, -2)) / length[:, None, None, None]
    # (lanes, n_c, column, 6) to (lanes, 6, n_c, column).
    G = np.moveaxis(np.concatenate([np.swapaxes(frames, -1, -2), moments], axis=-1), -1, 1)
    b = lanes.wrench.astype(np.float64) * units

    left, values, right = np.linalg.svd(G.reshape(len(on), 6, -1), full_matrices=False)
    ratios = values / np.where(values[:, :1] > 0, values[:, :1], 1.0)
    least, most = ((ratios > bound).sum(-1) for bound in reversed(tolerances.rank))
    rank = np.clip(rank, least, most)
    kept = np.arange(6) < rank[:, None]
    inverse = np.swapaxes(right, 1, 2) @ ((kept / np.where(kept, values, 1.0))[..., None] * np.swapaxes(left, 1, 2))
    # G* of physical wrenches: (lanes, n_c, 3, 6).
    star = (inverse * units[:, None]).reshape(*on.shape, 3, 6)

    angle = (2 * np.arange(lanes.cone_edges) + 1) * np.pi / lanes.cone_edges
    flat = np.full(lanes.cone_edges, np.cos(np.pi / lanes.cone_edges))
    facets = np.stack([np.cos(angle), np.sin(angle), flat], axis=-1)
    rows = np.einsum("ea,lcaw->lcew", facets[:, :2], star[:, :, :2])
    rows += facets[:, 2, None] * (friction[..., None] * star[:, :, 2])[:, :, None]
    rows = np.concatenate([-rows, star[:, :, 2:]], axis=2)
    lost = support(lanes, rows.reshape(len(on), -1, 6)).reshape(*on.shape, -1) * on[..., None]

    unit_rows = np.broadcast_to(units[:, None] * np.eye(6), (len(on), 6, 6))
    reach = np.maximum(*(support(lanes, s * unit_rows, exact=True).max(-1) for s in (1, -1)))
    outside = np.swapaxes(left, 1, 2) * ~kept[..., None]
    load = np.linalg.norm(np.einsum("lkr,lr->lk", outside, b), axis=-1)
    load = load / np.where(load > 0, np.linalg.norm(b, axis=-1), 1.0)
    beyond = np.maximum(*(support(lanes, s * outside * units[:, None], exact=True).max(-1) for s in (1, -1)))
    beyond = beyond / np.where(reach > 0, reach, 1.0)
    unsure = [(x > tolerances.outside[0]) & (x < tolerances.outside[1]) for x in (load, beyond)]

    smallest = np.take_along_axis(values, np.maximum(rank - 1, 0)[:, None], 1)[:, 0]
    condition = np.where(rank > 0, values[:, 0] / np.where(rank > 0, smallest, 1.0), 1.0)
    tangential = np.where(friction > 0, friction, 1.0) * max_force
    sigma = np.concatenate([lost[..., :-1] / tangential[..., None], lost[..., -1:] / max_force[..., None]], -1).max(
        (1, 2)
    )
    return Model(
        length=length,
        G=G,
        b=b,
        active=on,
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
        scale=1 / np.where(sigma > 0, sigma, 1.0),
    )


def support(lanes: Lanes, rows: np.ndarray, exact: bool = False) -> np.ndarray:
    """h_D(a), (lanes, rows), of the set and the origin; `exact`: that of the set before it was smoothed."""
    width = None if exact or lanes.width is None else lanes.width.astype(np.float64)[:, None]
    length = lambda x: np.abs(x) if width is None else np.hypot(x, width)  # noqa: E731
    total = np.zeros(rows.shape[:2])
    if lanes.vertices is not None:
        reach = rows @ np.swapaxes(lanes.vertices.astype(np.float64), 1, 2)
        most = np.maximum(reach.max(-1), 0.0)
        if width is not None:
            real = (lanes.vertices != 0).any(-1)[:, None]
            shares = np.where(real, np.exp((reach - most[..., None]) / width[..., None]), 0.0).sum(-1)
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


def bounds(m: Model, claims: Claims) -> tuple[np.ndarray, np.ndarray]:
    """What a lane's forces attain and what its multipliers exclude, (lanes,) each: lower <= lambda* <= upper.

    -inf and inf where they say nothing. The upper one holds for lambda >= 0: below zero it says that b is not borne.
    """
    G, R = m.G.reshape(len(m.b), 6, -1), m.radii.reshape(len(m.b), -1)
    normal = (G * (R**2)[:, None]) @ np.swapaxes(G, 1, 2)
    sound = np.isfinite(normal).all((1, 2))
    balanced = np.linalg.pinv(np.where(sound[:, None, None], normal, 0.0), rcond=1e-14, hermitian=True)

    forces = np.where(np.isfinite(claims.forces), claims.forces, 0.0)
    missed = m.b - np.einsum("lrcj,lcj->lr", m.G, forces)
    coarse = m.imbalance(forces) > 1e-11
    change = R**2 * np.einsum("lrk,lr->lk", G, np.einsum("lrs,ls->lr", balanced, missed))
    forces = forces + np.where(coarse[:, None, None], change.reshape(forces.shape), 0.0)
    cone, bound = m.slacks(forces)
    tangential = (np.where(m.friction > 0, m.friction, 1.0) * m.max_force)[..., None]
    slack = np.concatenate([cone, bound[..., None], np.where(m.friction == 0, -forces[..., 2], np.inf)[..., None]], -1)
    sigma = np.concatenate([-m.S_1, m.S_2[..., None], np.zeros_like(bound)[..., None]], -1)
    unit = np.concatenate([np.broadcast_to(tangential, cone.shape), *[m.max_force[..., None]] * 2], -1)
    felt = sigma * m.scale[:, None, None] > 1e-9 * unit
    ratio = np.where(felt, slack / np.where(felt, sigma, 1.0), np.where(slack >= -1e-9 * unit, np.inf, -np.inf))
    lower = np.where(m.active[..., None], ratio, np.inf).min((1, 2))
    lower = np.where(np.isfinite(claims.forces).all((1, 2)) & ~(m.imbalance(forces) > 1e-9), lower, -np.inf)

    z, bound_z = (np.maximum(np.nan_to_num(x), 0.0) for x in (claims.cone_multipliers, claims.bound_multipliers))
    z, bound_z = z * m.active[..., None], bound_z * m.active
    pull = np.sum(-m.S_1 * z, axis=(1, 2)) + np.sum(m.S_2 * bound_z, axis=-1)
    usable = (pull > 0) & np.isfinite(pull)
    over = np.where(usable, pull, 1.0)
    z, bound_z = z / over[:, None, None], bound_z / over[:, None]
    left = -np.concatenate([z @ m.facets[:, :2], (m.friction * (z @ m.facets[:, 2]))[..., None]], -1)
    left[..., 2] += bound_z
    left = left.reshape(len(m.b), -1)
    y = np.nan_to_num(claims.wrench_multipliers) * np.repeat(np.stack([np.ones_like(m.length), m.length], -1), 3, -1)
    y = y / over[:, None]
    upper = np.full(len(m.b), np.inf)
    for _ in range(2):
        # The second time with the y that leaves least.
        rest = left - np.einsum("lrk,lr->lk", G, y)
        value = np.sum(m.max_force * bound_z, -1) - m.reserve * z.sum((1, 2)) + np.sum(y * m.b, -1)
        value = value + np.sum(R * np.abs(rest), -1)
        upper = np.where(usable & (value < upper), value, upper)
        y = y + np.einsum("lrs,ls->lr", balanced, np.einsum("lrk,lk->lr", G, R**2 * rest))
    # Without friction a row that some disturbance loads allows nothing.
    slippery = (m.active & (m.friction == 0) & (m.S_1.min(-1) < -1e-9 / m.scale[:, None] * m.max_force)).any(-1)
    return lower, np.where(slippery | m.set_outside, np.minimum(upper, 0.0), upper)


@dataclass(kw_only=True)
class Findings:
    """What was found of every lane, (lanes,) bool each."""

    solved: np.ndarray
    doubtful: np.ndarray
    invalid: np.ndarray
    """A spoilt lane that is not INVALID_INPUT or a sound one that is, or a field that is not hidden."""
    balance: np.ndarray
    """SOLVED, and G f misses b."""
    rows: np.ndarray
    """SOLVED, and a row is exceeded."""
    rounding: np.ndarray
    """The same, but within the rounding of S_1 and S_2 here: not counted as wrong."""
    value: np.ndarray
    """SOLVED, and the margin or the upper bound is off."""
    crossed: np.ndarray
    """The upper bound is below the margin."""
    false_status: np.ndarray
    """INFEASIBLE or UNBOUNDED, and it is not."""
    open: np.ndarray
    """The lane's own forces and multipliers do not settle it: for HiGHS."""
    suboptimal: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """(22) alone: SOLVED, and the multipliers do not prove the effort to be the least."""

    @property
    def wrong(self) -> np.ndarray:
        return self.balance | self.rows | self.value


def margins(m: Model, claims: Claims, tolerances: Tolerances) -> tuple[Findings, np.ndarray]:
    """What (21) answers of sound lanes; and lower, (lanes,), a margin that surely can be had."""
    solved = claims.status == SOLVED
    finite = np.isfinite(claims.forces).all((1, 2)) & np.isfinite(claims.margin) & np.isfinite(claims.upper_bound)
    forces = np.where(np.isfinite(claims.forces), claims.forces, 0.0)
    margin = np.where(np.isfinite(claims.margin), claims.margin, 0.0)
    stray = (np.abs(claims.forces) > 0).any(-1) & ~m.active
    lower, upper = bounds(m, claims)
    unit = tolerances.margin * m.mean_force
    known = np.where(m.set_outside, np.minimum(lower, 0.0), lower)
    off = np.maximum(margin - known, upper - margin)
    off = np.maximum(off, np.maximum(claims.upper_bound - known, upper - claims.upper_bound))
    clear = ~m.doubtful
    refuted = claims.status == INFEASIBLE
    proved = m.load_outside | (upper < 0)
    undisturbed = (m.S_1 == 0).all((1, 2)) & (m.S_2 == 0).all(-1)
    boundless = claims.status == UNBOUNDED
    exceeded = m.excess(forces, margin) > tolerances.rows
    beyond = m.excess(forces, margin, 1.0) > tolerances.rows
    return Findings(
        solved=solved,
        doubtful=m.doubtful,
        invalid=claims.status == INVALID,
        balance=solved & ((m.imbalance(forces) > tolerances.rows) | stray.any(-1) | ~finite),
        rows=solved & beyond,
        rounding=solved & exceeded & ~beyond,
        value=np.zeros_like(solved),
        crossed=crossed(m, claims, tolerances) & solved,
        false_status=boundless & clear & ~undisturbed,
        open=clear & ((solved & ~(off <= unit)) | (refuted & ~proved)),
    ), known


def crossed(m: Model, claims: Claims, tolerances: Tolerances) -> np.ndarray:
    """Where the upper bound is below the margin by more than rounding."""
    with np.errstate(invalid="ignore"):
        size = np.maximum(np.abs(claims.margin), np.abs(claims.upper_bound))
        return claims.margin - claims.upper_bound > tolerances.crossed * np.maximum(size, m.scale)


def efforts(m: Model, claims: Claims, asked: np.ndarray, attainable: np.ndarray, tolerances: Tolerances) -> Findings:
    """What (22) answers of sound lanes; `attainable` is a margin that surely can be had."""
    solved = claims.status == SOLVED
    finite = np.isfinite(claims.forces).all((1, 2)) & ~np.isnan(claims.margin)
    forces = np.where(np.isfinite(claims.forces), claims.forces, 0.0)
    margin = np.where(np.isfinite(claims.margin), np.maximum(claims.margin, asked), asked)
    stray = (np.abs(claims.forces) > 0).any(-1) & ~m.active
    unit = tolerances.margin * m.mean_force
    exceeded = m.excess(forces, margin) > tolerances.rows
    beyond = m.excess(forces, margin, 1.0) > tolerances.rows
    effort = 0.5 * np.sum(forces**2, axis=(1, 2))
    told = np.abs(claims.effort - effort) <= 10 * tolerances.rows * effort
    refused = (claims.status == INFEASIBLE) & ~m.doubtful
    least = least_effort_bound(m, claims, asked)
    accuracy = 1e-6 if tolerances.rows < 1e-6 else 1e-3
    # Efforts count relative to themselves, but not below a thousandth of all strength.
    size = np.maximum(effort, 1e-3 * 0.5 * np.sum((m.max_force * m.active) ** 2, -1))
    return Findings(
        solved=solved,
        doubtful=m.doubtful,
        invalid=claims.status == INVALID,
        balance=solved & ((m.imbalance(forces) > tolerances.rows) | stray.any(-1) | ~finite | ~told),
        rows=solved & beyond,
        rounding=solved & exceeded & ~beyond,
        value=solved & ~m.doubtful & (claims.margin < asked - unit),
        crossed=crossed(m, claims, tolerances) & solved,
        false_status=refused & (asked < attainable - unit) & ~m.load_outside,
        open=np.zeros_like(solved),
        suboptimal=solved & ~m.doubtful & ~(effort - least <= accuracy * size),
    )


def least_effort_bound(m: Model, claims: Claims, asked: np.ndarray) -> np.ndarray:
    """(lanes,): no forces that hold at `asked` have less effort, by the lane's multipliers."""
    z = np.maximum(np.nan_to_num(claims.cone_multipliers), 0.0) * m.active[..., None]
    bound_z = np.maximum(np.nan_to_num(claims.bound_multipliers), 0.0) * m.active
    y = np.nan_to_num(claims.wrench_multipliers) * np.repeat(np.stack([np.ones_like(m.length), m.length], -1), 3, -1)
    pull = np.concatenate([z @ m.facets[:, :2], (m.friction * (z @ m.facets[:, 2]))[..., None]], -1)
    pull[..., 2] -= bound_z
    pull = pull + np.einsum("lrcj,lr->lcj", m.G, y)
    held = np.sum(z * (m.S_1 * asked[:, None, None] - m.reserve[:, None, None]), (1, 2))
    held = held + np.sum(bound_z * (m.max_force - m.S_2 * asked[:, None]), -1)
    return -0.5 * np.sum(pull**2, (1, 2)) - held - np.sum(y * m.b, -1)
