"""The ranking of many candidates by their robustness margin, with the tightening forces of the best."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.candidates import Candidates
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.ranking.order import certain, least_of_best, order_of
from jaxgrasp.ranking.scores import check_metrics
from jaxgrasp.ranking.tiles import Columns, columns_of, margins, solve_in_tiles, tightening
from jaxgrasp.ranking.uncertain import COLUMNS
from jaxgrasp.solvers.status import Status


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """Candidates with their margins and their order. Arrays over all N are in the candidates' order, not the ranks'."""

    candidates: Candidates
    """What was ranked; where the ranking was cut short, as many as it reached."""

    margin: Float[np.ndarray, " batch"]
    """lambda of (21), a certified lower bound: the factor by which the disturbances may be scaled; NaN without one."""

    upper_bound: Float[np.ndarray, " batch"]
    """A certified upper bound of lambda."""

    status: Int[np.ndarray, " batch"]
    """`Status` of (21)."""

    order: Int[np.ndarray, " batch"]
    """Candidates, the best first: SOLVED, UNBOUNDED and, by the margin that is certain, MAX_ITERATIONS; then
    ILL_CONDITIONED and PRUNED, INFEASIBLE and INVALID_INPUT; each by falling margin with NaN last, equals by their
    number. With metrics: by the first of them, the better ones first and NaN last."""

    share: float
    """The part of the margin that the tightening forces below are found for."""

    forces: Float[np.ndarray, "top contacts 3"]
    """f_0 of (22) in contact frames for `order[:top]`, N; NaN where there is no answer."""

    object_forces: Float[np.ndarray, "top contacts 3"]
    """The same in the object frame."""

    effort: Float[np.ndarray, " top"]
    """1/2 f_0' f_0 of the same, N^2."""

    tightening_status: Int[np.ndarray, " top"]
    """`Status` of (22)."""

    controls: Float[np.ndarray, "top actuators"]
    """Commands with which a hand's actuators squeeze as hard; NaN where there is no answer."""

    metrics: dict[str, Float[np.ndarray, " batch"]] = field(default_factory=dict)
    """Other metrics by name, that which ranks first."""

    moments: Float[np.ndarray, "top contacts"] | None = None
    """The moments about the normals that come with the forces, N m; None for hard contacts."""

    @property
    def rank(self) -> Int[np.ndarray, " batch"]:
        """The rank of each candidate; 1 is the best."""
        rank = np.empty(len(self.order), dtype=np.int64)
        rank[self.order] = np.arange(1, len(self.order) + 1)
        return rank


class RankingInterrupted(Exception):
    """Ctrl-C or an error of the device cut the ranking short; `__cause__` is what did."""

    def __init__(self, ranking: Ranking):
        """Keeps what was ranked before.

        Args:
            ranking: The candidates that were reached, with those tightening forces that were found.
        """
        super().__init__(f"the ranking was cut short after {len(ranking.margin)} candidates")
        self.ranking = ranking


def rank(
    candidates: Candidates,
    disturbances: DisturbanceSet | None = None,
    *,
    gravity: float = 0.0,
    cone_edges: int = 8,
    share: float = 0.75,
    top: int = 10,
    prune: bool = False,
    metrics: Mapping[str, Float[np.ndarray, " batch"]] | None = None,
    tile: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Ranking:
    """Ranks candidates by the largest disturbance that they resist: (21) for all, then (22) for the best.

    Works through tiles of bounded memory, each spread over the local devices, in the precision that JAX is set to.

    Args:
        candidates: What to rank.
        disturbances: The set that the margin scales; the six forces of 1 N where None, so that margins are in N.
        gravity: m/s^2 along the object's -z, for which the candidates' masses must be borne; zero for none.
        cone_edges: Edges of the friction pyramid, at least 3.
        share: The part of its margin, in (0, 1], for which the tightening forces of a candidate are found.
        top: How many of the best get tightening forces.
        prune: Whether candidates that cannot be among the `top` are given up as soon as their bounds tell, with status
            PRUNED; the `top` themselves are the same. Not together with `metrics`.
        metrics: Of all candidates, from `score` or `uncertain_scores`; where there are any, the first ranks in place of
            the margin.
        tile: Candidates at a time, at most; None chooses by platform.
        progress: Called after each tile of (21), and then of (22), with the number of candidates done by (21).

    Returns:
        The ranking.

    Raises:
        ValueError: `share` is not in (0, 1], `top` is negative, a metric is unknown, or metrics rank what is to be
            pruned.
        RankingInterrupted: Ctrl-C or an error of the device; it holds what was ranked before.

    Status:
        One each for (21) and, for the best, (22). A bad candidate costs no other one anything.
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share: got {share}; wanted a number in (0, 1]")
    if top < 0:
        raise ValueError(f"top: got {top}; wanted a number that is not negative")
    if disturbances is None:
        disturbances = DisturbanceSet.forces(1.0)
    check_metrics([name for name in metrics or {} if name not in COLUMNS])
    if prune and metrics:
        raise ValueError("prune: got metrics, too; wanted a ranking by the margin alone")
    scores = _Scores.none(len(candidates), dict(metrics or {}))
    columns = columns_of(candidates)
    if prune:
        columns["cutoff"] = np.full(len(candidates), -np.inf)
    settings = {"gravity": gravity, "cone_edges": cone_edges, "tile": tile}
    answers = []
    try:
        for rows, answer in solve_in_tiles(margins, columns, disturbances, **settings):
            scores.fill(rows, *answer)
            if prune and top:
                # Read when the next tile is solved.
                columns["cutoff"][rows.stop :] = scores.least_of_best(top)
            if progress is not None:
                progress(scores.done)
        order = scores.order()
        for answer in _tightened(scores, columns, order[:top], share, disturbances, settings):
            answers.append(answer)
            if progress is not None:
                progress(scores.done)
    except (KeyboardInterrupt, RuntimeError, MemoryError) as reason:
        raise RankingInterrupted(scores.ranking(candidates, scores.order(), share, answers)) from reason
    return scores.ranking(candidates, order, share, answers)


def tighten(
    candidates: Candidates,
    margin: Float[np.ndarray, " batch"],
    upper_bound: Float[np.ndarray, " batch"],
    status: Int[np.ndarray, " batch"],
    disturbances: DisturbanceSet,
    *,
    gravity: float = 0.0,
    cone_edges: int = 8,
    share: float = 0.75,
    metrics: Mapping[str, Float[np.ndarray, " batch"]] | None = None,
) -> Ranking:
    """Ranks candidates whose margins are known, and finds the tightening forces (22) of all of them.

    Args:
        candidates: What to rank.
        margin: lambda of (21), multiples of the disturbances.
        upper_bound: A certified upper bound of it.
        status: `Status` of (21).
        disturbances: The set that the margins scale.
        gravity: As for `rank`, like all that follow.
        cone_edges: Edges of the friction pyramid.
        share: The part of its margin for which the forces of a candidate are found.
        metrics: Of all candidates; where there are any, the first ranks in place of the margin.
    """
    scores = _Scores(
        margin=margin, upper_bound=upper_bound, status=status, metrics=dict(metrics or {}), done=len(margin)
    )
    order = scores.order()
    settings = {"gravity": gravity, "cone_edges": cone_edges, "tile": None}
    answers = list(_tightened(scores, columns_of(candidates), order, share, disturbances, settings))
    return scores.ranking(candidates, order, share, answers)


def _tightened(
    scores: "_Scores",
    columns: Columns,
    best: np.ndarray,
    share: float,
    disturbances: DisturbanceSet,
    settings: dict[str, Any],
) -> Iterator[tuple[np.ndarray, ...]]:
    """Answers of (22) for the best, tile by tile."""
    columns = {name: column[best] for name, column in columns.items()} | {"wanted": share * scores.bearable(best)}
    for _, answer in solve_in_tiles(tightening, columns, disturbances, **settings):
        yield answer


@dataclass(kw_only=True)
class _Scores:
    """What (21) has answered so far."""

    margin: np.ndarray
    upper_bound: np.ndarray
    status: np.ndarray
    metrics: dict[str, np.ndarray]
    done: int

    @staticmethod
    def none(count: int, metrics: dict[str, np.ndarray]) -> "_Scores":
        margin, upper_bound, status = np.empty(count), np.empty(count), np.empty(count, dtype=int)
        return _Scores(margin=margin, upper_bound=upper_bound, status=status, metrics=metrics, done=0)

    def fill(self, rows: slice, margin: np.ndarray, upper_bound: np.ndarray, status: np.ndarray) -> None:
        # Minus zero is zero.
        self.margin[rows], self.upper_bound[rows], self.status[rows] = margin + 0.0, upper_bound + 0.0, status
        self.done = rows.stop

    def order(self) -> np.ndarray:
        known = slice(self.done)
        metrics = {name: value[known] for name, value in self.metrics.items()}
        return order_of(self.margin[known], self.status[known], metrics)

    def least_of_best(self, top: int) -> float:
        """What a candidate must reach to be among the best so far."""
        return least_of_best(self.margin[: self.done], self.status[: self.done], top)

    def bearable(self, rows: np.ndarray) -> np.ndarray:
        # An infinite margin says that nothing disturbs the grasp: what remains to be asked is that it bears its load.
        margin = np.where(self.status[rows] == Status.UNBOUNDED, 0.0, np.maximum(self.margin[rows], 0.0))
        return np.where(certain(self.margin[rows], self.status[rows]), margin, np.nan)

    def ranking(
        self, candidates: Candidates, order: np.ndarray, share: float, answers: list[tuple[np.ndarray, ...]]
    ) -> Ranking:
        empty, actuators = (
            np.empty((0, candidates.num_contacts, 3)),
            candidates.hand.get("idle_controls", np.empty((0, 0))),
        )
        hard = candidates.torsional_friction is None
        first = empty, empty, empty[..., 0][:, :0] if hard else empty[..., 0]
        answers = [(*first, np.empty(0), np.empty(0, dtype=int), actuators[:0]), *answers]
        found = map(np.concatenate, zip(*answers, strict=True))
        forces, object_forces, moments, effort, tightening_status, controls = found
        return Ranking(
            candidates=candidates.take(slice(self.done)),
            margin=self.margin[: self.done],
            upper_bound=self.upper_bound[: self.done],
            status=self.status[: self.done],
            order=order,
            share=share,
            forces=forces + 0.0,
            object_forces=object_forces + 0.0,
            moments=None if hard else moments + 0.0,
            effort=effort,
            tightening_status=tightening_status,
            controls=controls,
            metrics={name: value[: self.done] for name, value in self.metrics.items()},
        )
