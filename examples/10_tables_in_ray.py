"""Ranks a dataset of Ray on all nodes of its cluster: rows of grasps in, rows with margins out.

Needs `pip install 'jaxgrasp[ray]'`. `jaxgrasp rank --ray` does the same with files, a folder of parts, and --resume.
"""

import logging

import pyarrow as pa
import pyarrow.parquet
import ray

from jaxgrasp.candidates import sample_grasps
from jaxgrasp.candidates.arrow import table_of_candidates
from jaxgrasp.ranking import rank_dataset


def main() -> None:
    pyarrow.parquet.write_table(table_of_candidates(sample_grasps(4_000)), "grasps.parquet", row_group_size=1_000)
    # Here a cluster of this machine's own; ray.init("auto") joins one.
    ray.init(num_cpus=2, include_dashboard=False, logging_level="ERROR", log_to_driver=False)
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    ranked = rank_dataset(ray.data.read_parquet("grasps.parquet"), workers=1, batch=1_000)
    best = ranked.select_columns(["margin", "positions"]).sort("margin", descending=True).limit(10)
    pyarrow.parquet.write_table(pa.concat_tables(ray.get(best.to_arrow_refs())), "best.parquet")
    margins = pyarrow.parquet.read_table("best.parquet")["margin"].to_numpy()
    ray.shutdown()
    print(f"the best ten resist {margins.max():.2f} to {margins.min():.2f} N")
    print("written: best.parquet")


if __name__ == "__main__":
    main()
