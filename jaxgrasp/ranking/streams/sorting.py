"""All candidates of a run, the best first: into buckets by ranges of their keys, then bucket by bucket."""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import ipc, parquet

from jaxgrasp.ranking.order import order_keys
from jaxgrasp.ranking.streams.run import Job
from jaxgrasp.ranking.table import parquet_writer
from jaxgrasp.solvers.status import Status
from jaxgrasp.storage import atomic_write

SORTED = "sorted.parquet"
_SCRATCH = ".sorting"
# Rows a bucket, about; of more candidates than files may be open buckets are larger. So many keys a part are looked at.
_BUCKET, _MOST, _SAMPLE = 500_000, 200, 1_000
_NUMBERS = {status.name: int(status) for status in Status}


def write_sorted(job: Job, progress: Callable[[int], None] | None = None) -> Path:
    """Writes all rows of a finished run in the order of `rank`, with a column of ranks, beside its parts.

    Rows of one key, such as margins of zero, are in the order of the inputs already, and pass through without sorting.

    Args:
        job: The run.
        progress: Called with the number of rows written.

    Returns:
        The file.

    Raises:
        OSError: It cannot be written.
    """
    report, path, scratch = progress or (lambda _: None), job.folder / SORTED, job.folder / _SCRATCH
    # A dead process may have left it.
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        cuts = _cuts(job)
        _divide(job, cuts, scratch)
        with contextlib.ExitStack() as stack:
            done, writer = 0, None
            stream = stack.enter_context(atomic_write(path))
            for table in _in_order(job, len(cuts), scratch):
                rank = pa.array(np.arange(done + 1, done + table.num_rows + 1))
                table = table.add_column(0, "rank", rank)
                writer = writer or stack.enter_context(parquet_writer(stream, table.schema))
                writer.write_table(table)
                done += table.num_rows
                report(done)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return path


def _cuts(job: Job) -> np.ndarray:
    """Keys that divide the candidates evenly."""
    sample = []
    for number in range(len(job.plan)):
        keys = _keys(job, _rows(job, number))
        sample.append(keys[:: -(-len(keys) // _SAMPLE) or 1])
    sample = np.sort(np.concatenate(sample))
    count = min(_MOST, job.rows // _BUCKET)
    return np.unique(sample[(np.arange(1, count + 1) * len(sample)) // (count + 1)])


def _divide(job: Job, cuts: np.ndarray, scratch: Path) -> None:
    """Every row into the bucket 2 i + 1 where its key is cut i, else into 2 i below it."""
    with contextlib.ExitStack() as stack:
        writers = {}
        for number in range(len(job.plan)):
            table = _rows(job, number)
            keys = _keys(job, table)
            place = np.searchsorted(cuts, keys)
            equal = np.append(cuts, np.nan)[place] == keys
            buckets = 2 * place + equal
            order = np.argsort(buckets, kind="stable")
            table, buckets = table.take(pa.array(order)), buckets[order]
            for bucket in np.unique(buckets):
                start, stop = np.searchsorted(buckets, [bucket, bucket + 1])
                if bucket not in writers:
                    stream = stack.enter_context(open(scratch / str(bucket), "wb"))
                    writers[bucket] = stack.enter_context(ipc.new_stream(stream, table.schema))
                writers[bucket].write_table(table.slice(start, stop - start))


def _in_order(job: Job, cuts: int, scratch: Path) -> Iterator[pa.Table]:
    for bucket in range(2 * cuts + 1):
        if not (scratch / str(bucket)).exists():
            continue
        with open(scratch / str(bucket), "rb") as stream, ipc.open_stream(stream) as reader:
            if bucket % 2:
                yield from (pa.Table.from_batches([batch]) for batch in reader)
            else:
                table = reader.read_all().unify_dictionaries().combine_chunks()
                yield table.take(pa.array(np.argsort(_keys(job, table), kind="stable")))


def _rows(job: Job, number: int) -> pa.Table:
    table = parquet.read_table(job.parts.path(number)).replace_schema_metadata()
    return table.unify_dictionaries().combine_chunks()


def _keys(job: Job, table: pa.Table) -> np.ndarray:
    """The two keys of each row as one that NumPy sorts by its real part, then by its imaginary part."""
    found = table.column("status").combine_chunks()
    numbers = np.array([_NUMBERS[name] for name in found.dictionary.to_pylist()], dtype=int)
    status = numbers[found.indices.to_numpy()]
    metrics = {name: table.column(name).to_numpy() for name in job.setting.columns[:2]}
    keys = np.empty(table.num_rows, dtype=complex)
    keys.real, keys.imag = order_keys(table.column("margin").to_numpy(), status, metrics)
    return keys
