"""The same parts on a cluster: Ray gives them to workers, and does again what a lost one had.

Every node must see the inputs and the run's folder by the same paths. Workers write their parts themselves, under names
of their own, so that a part that is done twice is there once; what goes over the network is a summary a part.
"""

import importlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
from jax.typing import ArrayLike
from pyarrow import ipc

from jaxgrasp.cluster import Cluster, JaxSettings, joined
from jaxgrasp.ranking.streams.run import Job, Read, Skipped
from jaxgrasp.ranking.streams.scored import Summary
from jaxgrasp.ranking.streams.tables import TableRanker
from jaxgrasp.storage import FileError, limited_to

# Ray is optional, and what is not installed has no types.
Dataset = Any

# So many summaries make one, in tasks, as long as there are more than the driver should merge itself.
_MERGED, _LEFT = 32, 256


def run_on_ray(
    job: Job,
    cluster: Cluster,
    *,
    budget: int,
    skipped: Skipped | None = None,
    progress: Callable[[int], None] | None = None,
) -> Summary:
    """Does all parts of a run that are not there yet on a cluster, see `run_job`.

    With `prune`, candidates are given up for what is best in their own part, whatever order parts are done in.

    Args:
        job: The run; its folder is an absolute path that all nodes see.
        cluster: Where to.
        budget: Bytes of memory that one file may ask for.
        skipped: Told of what could not be read.
        progress: Called with the number of candidates done.

    Returns:
        The summary of all parts.

    Raises:
        ValueError: A file cannot be read, or a part cannot be written.
        RuntimeError: A part failed for another reason than that its worker was lost.
    """
    data = _ray_data()
    report, tell = progress or (lambda _: None), skipped or (lambda _: None)
    context = data.DataContext.get_current()
    # Of equals the first one is to rank first: summaries are merged in the order of their parts.
    context.execution_options.preserve_order = True
    parts = len(job.plan)
    rows = data.from_items([{"part": number} for number in range(parts)], override_num_blocks=parts)
    rows = rows.map_batches(
        _Worker,
        fn_constructor_args=(job, JaxSettings.own(), budget),
        batch_size=1,
        batch_format="pyarrow",
        **_workers(cluster),
    )
    while parts > _LEFT:
        rows = rows.map_batches(_merge, fn_args=(job.setting.top,), batch_size=_MERGED, batch_format="pyarrow")
        parts = -(-parts // _MERGED)
    found, done = [], 0
    try:
        for row in rows.iter_rows():
            if row["failed"]:
                raise ValueError(row["failed"])
            found.append(_opened(row["summary"]))
            for error in json.loads(row["skipped"]):
                tell(ValueError(error))
            done += row["rows"]
            report(done)
    except cluster.ray.exceptions.RayError as error:
        raise RuntimeError(str(error).strip().splitlines()[0]) from error
    return Summary.merged(found, job.setting.top)


class _Worker:
    """Does parts in a process that keeps what it has compiled."""

    def __init__(self, job: Job, jax: JaxSettings, budget: int):
        jax.set()
        self._job, self._reader, self._budget = job, job.reader(), budget

    def __call__(self, batch: pa.Table) -> pa.Table:
        (number,) = batch["part"].to_pylist()
        try:
            with limited_to(self._budget):
                found = self._one(number)
        except (FileError, OSError) as error:
            # Ray would do the part again, which mends neither files nor disks, and wrap the error.
            found = {"summary": b"", "skipped": "[]", "rows": 0, "failed": str(error)}
        return pa.Table.from_pylist([found])

    def _one(self, number: int) -> dict[str, Any]:
        rows = sum(segment.stop - segment.start for segment in self._job.plan[number])
        found = self._job.parts.finished(number)
        if found is None:
            read: Read = self._job.read(self._reader, number)
            table, summary = self._job.score(read)
            self._job.write(read, table, summary)
            found = summary, [str(error) for error in read.errors]
        return {"summary": _closed(found[0]), "skipped": json.dumps(found[1]), "rows": rows, "failed": ""}


def _merge(batch: pa.Table, top: int) -> pa.Table:
    parts = batch.to_pylist()
    failed = next((part for part in parts if part["failed"]), None)
    if failed is not None:
        return pa.Table.from_pylist([failed])
    merged = {
        "summary": _closed(Summary.merged([_opened(part["summary"]) for part in parts], top)),
        "skipped": json.dumps([error for part in parts for error in json.loads(part["skipped"])]),
        "rows": sum(part["rows"] for part in parts),
        "failed": "",
    }
    return pa.Table.from_pylist([merged])


def _closed(summary: Summary) -> bytes:
    table, sink = summary.to_table(), pa.BufferOutputStream()
    with ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue().to_pybytes()


def _opened(content: bytes) -> Summary:
    return Summary.from_table(ipc.open_stream(content).read_all())


def rank_dataset(
    dataset: Dataset,
    disturbances: ArrayLike | None = None,
    *,
    gravity: float = 0.0,
    cone_edges: int = 8,
    friction: float | None = None,
    max_force: float | None = None,
    metrics: Sequence[str] = (),
    workers: int | None = None,
    batch: int = 8192,
) -> Dataset:
    """Finds the margins (21) of the candidates in a Ray dataset, on all nodes of the cluster that is joined.

    Args:
        dataset: A row a candidate, see `jaxgrasp.candidates.arrow`.
        disturbances: As for `TableRanker`, like all that follow.
        gravity: m/s^2 along the object's -z.
        cone_edges: Edges of the friction pyramid.
        friction: Coulomb's coefficient where the rows have none.
        max_force: Largest normal force where the rows have none, N.
        metrics: Names of other metrics.
        workers: How many processes; None is one a GPU, and without GPUs one a processor.
        batch: Candidates at a time.

    Returns:
        The dataset with the columns margin, upper_bound, status and those of metrics, which is computed when it is
        read; a lost worker's batch is done again.

    Raises:
        ImportError: Ray is not installed.
        ValueError: A metric is unknown.
    """
    options = {"gravity": gravity, "cone_edges": cone_edges, "friction": friction, "max_force": max_force}
    ranker = TableRanker(None if disturbances is None else np.asarray(disturbances), metrics=metrics, **options)
    with joined("auto", workers) as cluster:
        return dataset.map_batches(
            _Ranker,
            fn_constructor_args=(ranker, JaxSettings.own()),
            batch_size=batch,
            batch_format="pyarrow",
            **_workers(cluster),
        )


class _Ranker:
    """A ranker in a process that is set like the driver."""

    def __init__(self, ranker: TableRanker, jax: JaxSettings):
        jax.set()
        self._ranker = ranker

    def __call__(self, batch: pa.Table) -> pa.Table:
        return self._ranker(batch)


def _ray_data() -> Any:
    data = importlib.import_module("ray.data")
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    return data


def _workers(cluster: Cluster) -> dict[str, Any]:
    """What `map_batches` is told of workers."""
    return {"compute": _ray_data().ActorPoolStrategy(size=cluster.workers), **cluster.each}


def on_all_nodes(job: Job) -> Job:
    """The run with a folder that means the same to every process."""
    return replace(job, folder=job.folder.absolute())
