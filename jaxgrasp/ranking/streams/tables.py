"""Arrow tables in, Arrow tables out: the ranking as a callable that other people's pipelines run where they like."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from jax.typing import ArrayLike

from jaxgrasp.candidates.arrow import candidates_of_table
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.ranking.scores import check_metrics
from jaxgrasp.ranking.streams.scored import Setting, scored, status_names


class TableRanker:
    """A callable that appends margins to Arrow tables of candidates; it is small, can be pickled, and compiles once.

    Tables have a row a candidate, see `jaxgrasp.candidates.arrow`. They get the columns margin and upper_bound,
    multiples of the disturbances, status by its name, and those of metrics; all others stay as they are. A column of
    one of these names is replaced.
    """

    def __init__(
        self,
        disturbances: ArrayLike | None = None,
        *,
        gravity: float = 0.0,
        cone_edges: int = 8,
        friction: float | None = None,
        max_force: float | None = None,
        metrics: Sequence[str] = (),
        tile: int | None = None,
    ):
        """Keeps what is asked of every candidate; nothing of JAX starts before the first table comes.

        Args:
            disturbances: Wrenches (n_d, 6), N and N m, whose hull with the origin the margin scales; the six forces of
                1 N where None.
            gravity: m/s^2 along the object's -z, for which the candidates' masses must be borne; zero for none.
            cone_edges: Edges of the friction pyramid, at least 3.
            friction: Coulomb's coefficient where a table has none.
            max_force: Largest normal force where a table has none, N.
            metrics: Names of other metrics.
            tile: Candidates at a time, at most; None chooses by platform.

        Raises:
            ValueError: A metric is unknown.
        """
        check_metrics(metrics)
        self._wrenches = None if disturbances is None else np.asarray(disturbances)
        self._settings = {
            "gravity": gravity,
            "cone_edges": cone_edges,
            "friction": friction,
            "max_force": max_force,
            "metrics": tuple(metrics),
        }
        self._tile = tile
        self._setting: Setting | None = None

    def __call__(self, table: pa.Table | pa.RecordBatch) -> pa.Table:
        """Finds the margins (21) of a table's candidates.

        Args:
            table: A row a candidate; there may be none.

        Returns:
            The table with more columns.

        Raises:
            CandidateError: A column is missing or misspelt, or cannot be used. A candidate with bad data costs no
                other anything, and is INVALID_INPUT.
        """
        if isinstance(table, pa.RecordBatch):
            table = pa.Table.from_batches([table])
        if self._setting is None:
            wrenches = self._wrenches
            own = DisturbanceSet.forces(1.0) if wrenches is None else DisturbanceSet.vertices(wrenches)
            self._setting = Setting(disturbances=own, **self._settings)
        candidates, travelling = candidates_of_table(table, "table", **vars(self._setting.given))
        found = scored(candidates, travelling, self._setting, tile=self._tile)
        columns = {
            "margin": pa.array(found.margin),
            "upper_bound": pa.array(found.upper_bound),
            "status": status_names(found.status).cast(pa.string()),
            **{name: pa.array(value) for name, value in found.metrics.items()},
        }
        table = table.drop_columns([name for name in columns if name in table.column_names])
        for name, column in columns.items():
            table = table.append_column(name, column)
        return table

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out what JAX has: other processes have devices of their own."""
        return vars(self) | {"_setting": None}


def rank_batches(
    reader: Iterable[pa.Table | pa.RecordBatch],
    disturbances: ArrayLike | None = None,
    *,
    gravity: float = 0.0,
    cone_edges: int = 8,
    friction: float | None = None,
    max_force: float | None = None,
    metrics: Sequence[str] = (),
    tile: int | None = None,
) -> Iterator[pa.Table]:
    """Finds the margins (21) of candidates in Arrow tables or batches, one after the other and in their order.

    Args:
        reader: Gives tables or batches; `pyarrow.RecordBatchReader`, `ParquetFile.iter_batches` and lists do.
        disturbances: As for `TableRanker`, like all that follow.
        gravity: m/s^2 along the object's -z.
        cone_edges: Edges of the friction pyramid.
        friction: Coulomb's coefficient where a table has none.
        max_force: Largest normal force where a table has none, N.
        metrics: Names of other metrics.
        tile: Candidates at a time, at most.

    Yields:
        Each table with the columns margin, upper_bound, status, and metrics. Two tables are in memory at once.

    Raises:
        CandidateError: A column is missing or misspelt, or cannot be used.
        ValueError: A metric is unknown.

    Example:
        >>> import pyarrow.parquet
        >>> for table in rank_batches(pyarrow.parquet.ParquetFile("grasps.parquet").iter_batches()):  # doctest: +SKIP
        ...     print(table["margin"])
    """
    ranker = TableRanker(
        disturbances,
        gravity=gravity,
        cone_edges=cone_edges,
        friction=friction,
        max_force=max_force,
        metrics=metrics,
        tile=tile,
    )
    return map(ranker, reader)
