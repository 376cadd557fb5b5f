"""Ranks Arrow tables in Spark: a DataFrame of grasps in, the same with margins out.

Needs `pip install pyspark` and Java. `mapInArrow` gives batches as they are; `mapInPandas` does where functions around
it want pandas: `lambda frames: (ranker(pa.Table.from_pandas(f)).to_pandas() for f in frames)`.
"""

import os
import sys
from collections.abc import Iterator

import pyarrow as pa
import pyarrow.parquet
from pyspark.sql import SparkSession
from pyspark.sql.types import DoubleType, StringType, StructField, StructType

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.candidates.arrow import table_of_candidates
from jaxgrasp.ranking import rank_batches


def ranked(batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    """Runs in the workers, a partition at a time."""
    for table in rank_batches(batches):
        yield from table.to_batches()


def main() -> None:
    pyarrow.parquet.write_table(table_of_candidates(sample_grasps(4_000)), "grasps.parquet", row_group_size=1_000)
    os.environ["PYSPARK_PYTHON"] = sys.executable
    spark = SparkSession.builder.master("local[2]").config("spark.ui.enabled", "false").getOrCreate()
    grasps = spark.read.parquet("grasps.parquet")
    own = [("margin", DoubleType()), ("upper_bound", DoubleType()), ("status", StringType())]
    schema = StructType([*grasps.schema, *(StructField(name, kind) for name, kind in own)])
    best = grasps.mapInArrow(ranked, schema).orderBy("margin", ascending=False).limit(10)
    pyarrow.parquet.write_table(best.toArrow(), "best.parquet")
    spark.stop()
    margins = pyarrow.parquet.read_table("best.parquet")["margin"].to_numpy()
    print(f"the best ten resist {margins.max():.2f} to {margins.min():.2f} N")
    print("written: best.parquet")


if __name__ == "__main__":
    main()
