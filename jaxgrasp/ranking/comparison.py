"""How metrics agree with each other, and with what became of the grasps: rank correlations and ROC curves."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

_AT_ONCE = 64


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """How well metrics tell the grasps that succeeded from the others; arrays over the M metrics."""

    success: Bool[np.ndarray, " batch"]
    """What became of the grasps."""

    auc: Float[np.ndarray, " metrics"]
    """Area under the ROC curve: the chance that a success has the better value than a failure, ties counting half."""

    interval: Float[np.ndarray, "metrics 2"]
    """95 % bootstrap interval of it."""

    lead: Float[np.ndarray, "metrics 3"]
    """How much the first metric's area is larger, and a 95 % interval by the same resamples."""

    curves: tuple[Float[np.ndarray, "points 2"], ...]
    """Shares of the failures and of the successes that are at least as good, from (0, 0) to (1, 1)."""


@dataclass(frozen=True, kw_only=True)
class MetricComparison:
    """M metrics on N grasps."""

    names: tuple[str, ...]
    """Of the metrics."""

    answered: Float[np.ndarray, " metrics"]
    """How many grasps each has a value for."""

    correlation: Float[np.ndarray, "metrics metrics"]
    """Spearman's, between the metrics turned so that larger is better; NaN with one that is constant."""

    prediction: Prediction | None
    """None where nobody knows what became of the grasps."""


def compare_metrics(
    metrics: Mapping[str, Float[np.ndarray, " batch"]],
    success: Bool[np.ndarray, " batch"] | None = None,
    *,
    smaller_is_better: frozenset[str] = frozenset(),
    within: np.ndarray | None = None,
    resamples: int = 1000,
    seed: int = 0,
) -> MetricComparison:
    """Compares metrics of the same grasps by rank alone.

    A grasp for which a metric has no answer (NaN) counts as worse than all others.

    Args:
        metrics: Values (N,) by name.
        success: Whether each grasp succeeded; None where that is unknown.
        smaller_is_better: Names of the metrics whose small values are good.
        within: (N,), labels, of objects for example: then areas count only pairs with the same label (correlations and
            curves do not know of it).
        resamples: How many bootstrap resamples of the grasps the intervals are made of.
        seed: Of the resamples.

    Returns:
        The comparison.

    Raises:
        ValueError: Without metrics, or without a pair of a success and a failure to compare.
    """
    if not metrics:
        raise ValueError("metrics: got none; wanted at least one")
    turned = [-np.asarray(value) if name in smaller_is_better else np.asarray(value) for name, value in metrics.items()]
    values = np.array([np.where(np.isnan(value), -np.inf, value) for value in turned])
    ranks = np.array([_ranks(value) for value in values])
    ranks -= ranks.mean(1, keepdims=True)
    size = np.sqrt((ranks**2).sum(1))
    with np.errstate(invalid="ignore"):
        correlation = (ranks @ ranks.T) / np.outer(size, size)
    return MetricComparison(
        names=tuple(metrics),
        answered=np.array([np.sum(~np.isnan(value)) for value in turned]),
        correlation=correlation,
        prediction=None if success is None else _predict(values, success, within, resamples, seed),
    )


def _predict(
    values: np.ndarray, success: np.ndarray, within: np.ndarray | None, resamples: int, seed: int
) -> Prediction:
    count = len(success)
    labels = np.zeros(count, int) if within is None else np.unique(within, return_inverse=True)[1]
    whole = np.array([_areas(value, success, labels, np.ones((1, count)))[0] for value in values])
    if np.isnan(whole).any():
        raise ValueError("success: got no pair of a success and a failure; wanted at least one of each")
    random = np.random.default_rng(seed)
    drawn = [
        random.multinomial(count, np.full(count, 1 / count), size=min(_AT_ONCE, resamples - start)).astype(float)
        for start in range(0, resamples, _AT_ONCE)
    ]
    areas = np.array([np.concatenate([_areas(v, success, labels, w) for w in drawn]) for v in values])
    limits = lambda x: np.nanquantile(x, [0.025, 0.975], axis=1).T
    return Prediction(
        success=success,
        auc=whole,
        interval=limits(areas),
        lead=np.column_stack([whole[0] - whole, limits(areas[0] - areas)]),
        curves=tuple(_curve(value, success) for value in values),
    )


def _ranks(value: np.ndarray) -> np.ndarray:
    """Ranks, equals having their mean."""
    _, inverse, counts = np.unique(value, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[inverse]


def _areas(value: np.ndarray, success: np.ndarray, labels: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Areas under the ROC curve with grasps counted as often as weights (resamples, N) say; NaN without pairs."""
    won, pairs = np.zeros(len(weights)), np.zeros(len(weights))
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        rows = rows[np.argsort(value[rows], kind="stable")]
        ordered = value[rows]
        first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
        good = np.add.reduceat(weights[:, rows] * success[rows], first, axis=1)
        bad = np.add.reduceat(weights[:, rows] * ~success[rows], first, axis=1)
        won += (good * (np.cumsum(bad, 1) - bad / 2)).sum(1)
        pairs += good.sum(1) * bad.sum(1)
    with np.errstate(invalid="ignore"):
        return np.where(pairs > 0, won / np.where(pairs > 0, pairs, 1), np.nan)


def _curve(value: np.ndarray, success: np.ndarray) -> np.ndarray:
    rows = np.argsort(-value, kind="stable")
    ordered = value[rows]
    last = np.flatnonzero(np.concatenate([ordered[1:] != ordered[:-1], [True]]))
    points = np.column_stack([np.cumsum(~success[rows])[last], np.cumsum(success[rows])[last]])
    return np.concatenate([[[0.0, 0.0]], points / [np.sum(~success), np.sum(success)]])
