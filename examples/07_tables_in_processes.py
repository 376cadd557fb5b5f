"""Ranks Arrow tables in processes of Python's own: a file of any length in, a file of margins out.

`TableRanker` is a callable from Arrow tables to Arrow tables. Whatever calls it, it compiles once a process.
"""

import multiprocessing

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.candidates.arrow import table_of_candidates
from jaxgrasp.ranking import TableRanker


def main() -> None:
    # A file as somebody else's generator writes it: one row a grasp, one group of rows a batch.
    pyarrow.parquet.write_table(table_of_candidates(sample_grasps(4_000)), "grasps.parquet", row_group_size=1_000)
    batches = map(as_table, pyarrow.parquet.ParquetFile("grasps.parquet").iter_batches(1_000))

    # JAX has threads, which a fork would lose: processes are spawned.
    best, writer = [], None
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        # The results come in the order of the batches.
        for number, table in enumerate(pool.imap(TableRanker(), batches)):
            writer = writer or pyarrow.parquet.ParquetWriter("margins.parquet", table.schema)
            writer.write_table(table)
            row = int(np.argmax(table["margin"]))
            best.append((table["margin"][row].as_py(), 1_000 * number + row))
    assert writer is not None
    writer.close()
    print("best of each batch:", ", ".join(f"{margin:.2f} N (row {row})" for margin, row in best))
    print("written: margins.parquet")


def as_table(batch: pa.RecordBatch) -> pa.Table:
    return pa.Table.from_batches([batch])


if __name__ == "__main__":
    main()
