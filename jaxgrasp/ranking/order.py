"""The order of a ranking, by keys that are the same for a million candidates at once and for a part of billions."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgrasp.metrics import METRICS
from jaxgrasp.ranking.uncertain import COLUMNS, P_HOLD, QUANTILE
from jaxgrasp.solvers.status import Status

_ANSWERED = (Status.SOLVED, Status.UNBOUNDED)
_TIE = 1e-9
_LAST = {Status.INFEASIBLE: 2, Status.INVALID_INPUT: 3, Status.NOT_VERIFIED: 4}


def certain(margin: Float[np.ndarray, " batch"], status: Int[np.ndarray, " batch"]) -> Bool[np.ndarray, " batch"]:
    """Which candidates have a margin that is certain; of those that are undecided it is a lower bound.

    Args:
        margin: lambda of (21).
        status: `Status` of (21).
    """
    return np.isin(status, _ANSWERED) | ((status == Status.MAX_ITERATIONS) & np.isfinite(margin))


def order_keys(
    margin: Float[np.ndarray, " batch"],
    status: Int[np.ndarray, " batch"],
    metrics: Mapping[str, Float[np.ndarray, " batch"]],
) -> tuple[Int[np.ndarray, " batch"], Float[np.ndarray, " batch"]]:
    """Two numbers a candidate that order a ranking: the best has the smallest first one, and then the smallest second.

    Args:
        margin: lambda of (21).
        status: `Status` of (21).
        metrics: Where there are any, the first ranks in place of the margin; equal probabilities to hold are ordered
            by the quantile of the margin.

    Returns:
        The group, and what ranks inside it; equals are to be ordered by file and row.
    """
    for name, value in metrics.items():
        larger_is_better = name in COLUMNS or METRICS[name].larger_is_better
        found = value if larger_is_better else -value
        if name == P_HOLD:
            # Many hold in all draws: they are told apart by the quantile. Probabilities differ by far more.
            found = found + _TIE * np.arctan(metrics[QUANTILE])
        return np.isnan(found).astype(int), np.where(np.isnan(found), 0.0, -found)
    group = np.ones(len(margin), dtype=int)
    group[certain(margin, status)] = 0
    for code, last in _LAST.items():
        group[status == code] = last
    return group, np.where(np.isnan(margin), np.inf, -margin)


def order_of(
    margin: Float[np.ndarray, " batch"],
    status: Int[np.ndarray, " batch"],
    metrics: Mapping[str, Float[np.ndarray, " batch"]],
) -> Int[np.ndarray, " batch"]:
    """Candidates, the best first, see `order_keys`; equals stay in order."""
    group, key = order_keys(margin, status, metrics)
    return np.lexsort((key, group))


def best_of(
    margin: Float[np.ndarray, " batch"],
    status: Int[np.ndarray, " batch"],
    metrics: Mapping[str, Float[np.ndarray, " batch"]],
    top: int,
) -> Int[np.ndarray, " top"]:
    """The first of `order_of`, without sorting the others.

    Args:
        margin: As for `order_keys`, like those that follow.
        status: `Status` of (21).
        metrics: Others by name.
        top: How many, at most.
    """
    if top == 0:
        return np.empty(0, dtype=np.intp)
    group, key = order_keys(margin, status, metrics)
    rows = np.flatnonzero(group == 0)
    if len(rows) < top:
        return np.lexsort((key, group))[:top]
    rows = rows[key[rows] <= np.partition(key[rows], top - 1)[top - 1]]
    return rows[np.argsort(key[rows], kind="stable")[:top]]


def least_of_best(margin: Float[np.ndarray, " batch"], status: Int[np.ndarray, " batch"], top: int) -> float:
    """What a candidate must reach to be among the best `top`; minus infinity where there are not as many."""
    best = margin[certain(margin, status)]
    return float(np.partition(best, len(best) - top)[len(best) - top]) if len(best) >= top else -np.inf
