"""Ranks Arrow tables in Dask: a bag of pieces of files in, a Parquet dataset out.

Needs `pip install dask pyarrow`. On a cluster the same graph runs on its workers: `dask.distributed.Client(address)`.
"""

import dask
import pyarrow.parquet

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.candidates.arrow import table_of_candidates
from jaxgrasp.ranking import TableRanker

ranker = TableRanker()


@dask.delayed
def ranked(path: str, group: int) -> str:
    """One group of rows of a file, which only the worker reads."""
    table = ranker(pyarrow.parquet.ParquetFile(path).read_row_group(group))
    name = f"margins-{group}.parquet"
    pyarrow.parquet.write_table(table, name)
    return name


def main() -> None:
    pyarrow.parquet.write_table(table_of_candidates(sample_grasps(4_000)), "grasps.parquet", row_group_size=1_000)
    groups = pyarrow.parquet.ParquetFile("grasps.parquet").num_row_groups
    # Threads share what is compiled. With processes of Dask's own: scheduler="processes", which are spawned.
    names = dask.compute(*[ranked("grasps.parquet", group) for group in range(groups)], scheduler="threads")
    margins = pyarrow.parquet.read_table(list(names))["margin"].to_numpy()
    print(f"{len(margins):,} grasps in {len(names)} files, the best resists {margins.max():.2f} N")
    print(f"written: {names[0]}")


if __name__ == "__main__":
    main()
