"""What makes an answer to (21) or (22) wrong, lane by lane, from rows and certificates that are NumPy's own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.suite import certificates
from benchmarks.suite.lanes import Claims
from benchmarks.suite.rows import Model, Tolerances

SOLVED, INFEASIBLE, UNBOUNDED, INVALID, NOT_VERIFIED = 0, 1, 2, 5, 7


@dataclass(kw_only=True)
class Findings:
    """What was found of every lane, (lanes,) bool each."""

    solved: np.ndarray
    invalid: np.ndarray
    """A sound lane that is called INVALID_INPUT."""
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
    suboptimal: np.ndarray
    """(22) alone: SOLVED, and the multipliers do not prove the effort to be the least."""

    @property
    def wrong(self) -> np.ndarray:
        return self.balance | self.rows | self.value


def margins(m: Model, claims: Claims, tolerances: Tolerances) -> tuple[Findings, tuple[np.ndarray, np.ndarray]]:
    """What (21) answers of sound lanes; and bounds of their optima, (lanes,) each."""
    found = held(m, claims, np.where(np.isfinite(claims.margin), claims.margin, 0.0), tolerances)
    unit = tolerances.margin * m.mean_force
    lower, upper = certificates.bounds(m, claims)
    again = np.flatnonzero(~(distance(claims, lower, upper) <= unit))
    if len(again):
        polished = certificates.bounds(m[again], claims[again], polish=True)
        lower[again] = np.maximum(lower[again], polished[0])
        upper[again] = np.minimum(upper[again], polished[1])
    found.balance |= found.solved & ~np.isfinite(claims.margin)
    settled = (distance(claims, lower, upper) <= unit) | found.balance
    refuted = (claims.status == INFEASIBLE) & ~m.load_outside & ~(upper < 0)
    undisturbed = (m.S_1 == 0).all((1, 2)) & (m.S_2 == 0).all(-1)
    found.false_status = (claims.status == UNBOUNDED) & ~m.doubtful & ~undisturbed
    found.open = ((found.solved & ~settled) | refuted) & ~m.doubtful
    return found, (lower, upper)


def efforts(
    m: Model, claims: Claims, asked: np.ndarray, optimum: tuple[np.ndarray, np.ndarray], tolerances: Tolerances
) -> Findings:
    """What (22) answers of sound lanes; `optimum` has bounds of what (21) allows."""
    margin = np.where(np.isfinite(claims.margin), np.maximum(claims.margin, asked), asked)
    found = held(m, claims, margin, tolerances)
    unit = tolerances.margin * m.mean_force
    effort = 0.5 * np.sum(np.nan_to_num(claims.forces) ** 2, axis=(1, 2))
    # float32 cannot tell smaller ones from nothing.
    told = np.abs(claims.effort - effort) <= 10 * tolerances.rows * effort + np.finfo(np.float32).tiny
    found.balance |= found.solved & (np.isnan(claims.margin) | ~told)
    off = (claims.margin < asked - unit) | (claims.upper_bound < optimum[0] - unit)
    found.value = found.solved & ~m.doubtful & (off | (claims.upper_bound > optimum[1] + unit))
    refused = (claims.status == INFEASIBLE) & ~m.doubtful & ~m.load_outside
    found.false_status = refused & (asked < optimum[0] - unit)
    # Efforts count relative to themselves, but not below a thousandth of all strength.
    size = np.maximum(effort, 5e-4 * np.sum((m.max_force * m.active) ** 2, axis=-1))
    least = certificates.least_effort(m, claims, asked)
    found.suboptimal = found.solved & ~m.doubtful & ~(effort - least <= tolerances.effort * size)
    return found


def held(m: Model, claims: Claims, margin: np.ndarray, tolerances: Tolerances) -> Findings:
    """The rules that both programs have in common: what forces hold at a margin, and bounds that do not cross."""
    solved = claims.status == SOLVED
    forces = np.where(np.isfinite(claims.forces), claims.forces, 0.0)
    stray = ((claims.forces != 0).any(-1) & ~m.active).any(-1)
    unbalanced = (m.imbalance(forces) > tolerances.rows) | stray | ~np.isfinite(claims.forces).all((1, 2))
    exceeded, beyond = (m.excess(forces, margin, allowed) > tolerances.rows for allowed in (0.0, 1.0))
    size = np.maximum(np.maximum(np.abs(claims.margin), np.abs(claims.upper_bound)), m.scale)
    return Findings(
        solved=solved,
        invalid=claims.status == INVALID,
        balance=solved & unbalanced,
        rows=solved & beyond,
        rounding=solved & exceeded & ~beyond,
        value=np.zeros_like(solved),
        crossed=(claims.status != NOT_VERIFIED) & (claims.margin - claims.upper_bound > tolerances.crossed * size),
        false_status=np.zeros_like(solved),
        open=np.zeros_like(solved),
        suboptimal=np.zeros_like(solved),
    )


def distance(claims: Claims, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """How far margin and upper bound may be off an optimum between lower and upper, (lanes,)."""
    above, below = (f(claims.margin, claims.upper_bound) for f in (np.maximum, np.minimum))
    return np.maximum(above - lower, upper - below)
