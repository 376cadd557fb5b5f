"""Candidates with their margins, a part at a time; what a part leaves behind when its rows are on the disk."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int

from jaxgrasp.candidates import Candidates, concatenate
from jaxgrasp.candidates.arrow import candidates_of_table, columns_of_table, table_of_candidates
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.ranking.order import best_of, certain, least_of_best
from jaxgrasp.ranking.rank import Ranking, tighten
from jaxgrasp.ranking.scores import score
from jaxgrasp.ranking.sketch import Sketch
from jaxgrasp.ranking.streams.sources import Given
from jaxgrasp.ranking.tiles import columns_of, margins, solve_in_tiles
from jaxgrasp.ranking.uncertain import Uncertain, uncertain_scores
from jaxgrasp.solvers.status import Status

_SCORE, _METRIC, _INPUT, _SOURCE = "score:", "metric:", "input:", "source"


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is asked of every candidate."""

    disturbances: DisturbanceSet
    """The set that the margins scale."""
    gravity: float = 0.0
    """m/s^2 along the object's -z, for which the candidates' masses must be borne; zero for none."""
    cone_edges: int = 8
    """Edges of the friction pyramid."""
    share: float = 0.75
    """The part of its margin for which the tightening forces of a candidate are found."""
    top: int = 10
    """How many of the best get tightening forces."""
    prune: bool = False
    """Whether candidates that cannot be among the best are given up."""
    metrics: tuple[str, ...] = ()
    """Names of other metrics, that which ranks first."""
    uncertain: Uncertain | None = None
    """What is not known of the candidates; it ranks before other metrics."""
    friction: float | None = None
    """Coulomb's coefficient where the input has none."""
    max_force: float | None = None
    """Largest normal force where the input has none, N."""

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of everything that is found beside the margin, that which ranks first."""
        return (*(self.uncertain.names if self.uncertain else ()), *self.metrics)

    @property
    def given(self) -> Given:
        """What files without some fields get."""
        return Given(friction=self.friction, max_force=self.max_force, with_mass=self.gravity != 0.0)


@dataclass(frozen=True, kw_only=True)
class Scored:
    """Candidates with what (21) and the metrics say of them."""

    candidates: Candidates
    """Grasps without columns."""
    travelling: pa.Table
    """Other columns of the same rows."""
    margin: Float[np.ndarray, " batch"]
    """lambda of (21)."""
    upper_bound: Float[np.ndarray, " batch"]
    """A certified upper bound of it."""
    status: Int[np.ndarray, " batch"]
    """`Status` of (21)."""
    metrics: dict[str, Float[np.ndarray, " batch"]]
    """Others by name, that which ranks first."""

    def __len__(self) -> int:
        """Returns the number of candidates."""
        return len(self.margin)

    def take(self, rows: Int[np.ndarray, " rows"]) -> "Scored":
        """Returns some of them, in that order."""
        return Scored(
            candidates=self.candidates.take(rows),
            travelling=self.travelling.take(pa.array(rows)) if self.travelling.num_columns else self.travelling,
            margin=self.margin[rows],
            upper_bound=self.upper_bound[rows],
            status=self.status[rows],
            metrics={name: value[rows] for name, value in self.metrics.items()},
        )

    def best(self, top: int) -> "Scored":
        """Returns the best `top`, the best first; equals in the order of their files and rows."""
        found = self.take(best_of(self.margin, self.status, self.metrics, top))
        # Of thousands of files no more are named than these are from.
        names = _names(found.candidates).tolist()
        sources = tuple(dict.fromkeys(names))
        source = np.array([sources.index(name) for name in names], dtype=np.int32)
        return replace(found, candidates=replace(found.candidates, sources=sources, source=source))


def scored(
    candidates: Candidates,
    travelling: pa.Table,
    setting: Setting,
    *,
    best: Float[np.ndarray, " best"] | None = None,
    tile: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Scored:
    """Finds the margins (21) and the metrics of one part of many.

    Args:
        candidates: The part.
        travelling: Its other columns.
        setting: What is asked.
        best: With `prune`, the margins of the best that are known from other parts.
        tile: Candidates at a time, at most; None chooses by platform.
        progress: Called after each tile with the number of candidates done.
    """
    count, columns = len(candidates), columns_of(candidates)
    settings: dict[str, Any] = {"gravity": setting.gravity, "cone_edges": setting.cone_edges}
    own = {"disturbances": setting.disturbances, "stream": True, **settings}
    metrics = uncertain_scores(candidates, setting.uncertain, **own) if setting.uncertain else {}
    metrics |= {name: score(candidates, name, **own) for name in setting.metrics}
    margin, upper_bound, status = np.empty(count), np.empty(count), np.empty(count, dtype=int)
    best = np.empty(0) if best is None else best
    if setting.prune:
        columns["cutoff"] = np.full(count, _cutoff(best, setting.top))
    for rows, answer in solve_in_tiles(margins, columns, setting.disturbances, tile=tile, stream=True, **settings):
        # Minus zero is zero.
        margin[rows], upper_bound[rows], status[rows] = answer[0] + 0.0, answer[1] + 0.0, answer[2]
        if setting.prune:
            # Read when the next tile is solved.
            known = margin[rows][certain(margin[rows], status[rows])]
            best = np.sort(np.concatenate([best, known]))[-max(setting.top, 1) :]
            columns["cutoff"][rows.stop :] = _cutoff(best, setting.top)
        if progress is not None:
            progress(rows.stop)
    return Scored(
        candidates=candidates,
        travelling=travelling,
        margin=margin,
        upper_bound=upper_bound,
        status=status,
        metrics=metrics,
    )


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What is kept of a part, or of several: a sketch of the margins, and the best candidates themselves."""

    sketch: Sketch
    """Of all candidates."""
    best: Scored
    """The best `top`, the best first."""

    @classmethod
    def of(cls, part: Scored, top: int) -> "Summary":
        """The summary of a part."""
        return cls(sketch=Sketch.of(part.margin, part.status), best=part.best(top))

    @classmethod
    def merged(cls, summaries: "Sequence[Summary]", top: int) -> "Summary":
        """The summary of several parts, which are given in their order, or are such summaries themselves."""
        return cls(
            sketch=Sketch.sum([summary.sketch for summary in summaries]),
            best=concatenated([summary.best for summary in summaries]).best(top),
        )

    def to_table(self) -> pa.Table:
        """The summary as an Arrow table, which `from_table` reads."""
        best, own = self.best, table_of_candidates(self.best.candidates)
        columns = dict(zip(own.column_names, own.columns, strict=True))
        columns |= {_SOURCE: pa.array(_names(best.candidates)), "index": pa.array(best.candidates.index)}
        columns |= {_SCORE + name: pa.array(getattr(best, name)) for name in ("margin", "upper_bound", "status")}
        columns |= {_METRIC + name: pa.array(value) for name, value in best.metrics.items()}
        columns |= {_INPUT + name: best.travelling.column(name) for name in best.travelling.column_names}
        return pa.table(columns).replace_schema_metadata({"sketch": self.sketch.to_json()})

    @classmethod
    def from_table(cls, table: pa.Table) -> "Summary":
        """Reads what `to_table` made.

        Raises:
            ValueError: It is another table.
        """
        sketch = (table.schema.metadata or {}).get(b"sketch")
        if sketch is None:
            raise ValueError("got a table without a sketch; wanted a summary")
        names = table.column_names
        beside = [name for name in names if ":" in name or name in (_SOURCE, "index")]
        candidates, _ = candidates_of_table(table.drop_columns(beside), "summary")
        sources, source = np.unique(np.array(table.column(_SOURCE).to_pylist(), dtype=str), return_inverse=True)
        candidates = replace(
            candidates,
            sources=tuple(map(str, sources)),
            source=source.astype(np.int32),
            index=table.column("index").to_numpy(),
        )
        numbers = {name: table.column(name).to_numpy() for name in names if name.startswith((_SCORE, _METRIC))}
        travelling = table.select([name for name in names if name.startswith(_INPUT)])
        return cls(
            sketch=Sketch.from_json(sketch),
            best=Scored(
                candidates=candidates,
                travelling=travelling.rename_columns([n.removeprefix(_INPUT) for n in travelling.column_names]),
                margin=numbers[_SCORE + "margin"],
                upper_bound=numbers[_SCORE + "upper_bound"],
                status=numbers[_SCORE + "status"],
                metrics={n.removeprefix(_METRIC): v for n, v in numbers.items() if n.startswith(_METRIC)},
            ),
        )

    def known_best(self) -> Float[np.ndarray, " best"]:
        """The margins of the best that have one."""
        return self.best.margin[certain(self.best.margin, self.best.status)]

    def ranking(self, setting: Setting) -> Ranking:
        """The best ranked, with tightening forces, and with those other columns that NumPy knows."""
        best = self.best
        return tighten(
            replace(best.candidates, columns=columns_of_table(best.travelling)),
            best.margin,
            best.upper_bound,
            best.status,
            setting.disturbances,
            gravity=setting.gravity,
            cone_edges=setting.cone_edges,
            share=setting.share,
            metrics=best.metrics,
        )


def concatenated(parts: Sequence[Scored]) -> Scored:
    """Several parts in one, in their order."""
    if len(parts) == 1:
        return parts[0]
    return Scored(
        candidates=concatenate([part.candidates for part in parts]),
        travelling=pa.concat_tables([part.travelling for part in parts], promote_options="permissive"),
        margin=np.concatenate([part.margin for part in parts]),
        upper_bound=np.concatenate([part.upper_bound for part in parts]),
        status=np.concatenate([part.status for part in parts]),
        metrics={name: np.concatenate([part.metrics[name] for part in parts]) for name in parts[0].metrics},
    )


def status_names(status: Int[np.ndarray, " batch"]) -> pa.DictionaryArray:
    """Statuses by their names."""
    return pa.DictionaryArray.from_arrays(pa.array(status.astype(np.int32)), pa.array([s.name for s in Status]))


def _cutoff(best: np.ndarray, top: int) -> float:
    return least_of_best(best, np.full(len(best), Status.SOLVED), top) if top else -np.inf


def _names(candidates: Candidates) -> np.ndarray:
    """The file of each candidate."""
    return np.array(candidates.sources, dtype=str)[candidates.source]
