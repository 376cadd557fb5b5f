"""The table of an evaluation, rows in the order of the grasps, as Parquet, CSV or NPZ."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from jaxgrasp.evaluation.evaluate import Evaluation
from jaxgrasp.storage import atomic_write

PARAMETERS = "protocol_parameters"
"""Where the table has all parameters of the protocol as JSON: in the metadata of Parquet, else a column or an array."""


def evaluation_table(found: Evaluation, metrics: Mapping[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    """Makes the columns of the table.

    Args:
        found: The evaluation of N grasps.
        metrics: Further columns (N,), by name.

    Returns:
        Arrays (N, ...) by name: source (FILE:ROW), object_name, object_scale, held, outcome, delta_pos (m), delta_angle
        (degrees), penetration and self_penetration (m), contact_number, contact_distance and contact_consistency (m),
        loads (N, 6), protocol; metrics; and what travelled along, with `input_` before names that the table has itself.
    """
    count, name = len(found), f"{found.protocol.name} {found.protocol.version}"
    table = {
        "source": found.grasps.source,
        "object_name": found.object,
        "object_scale": found.grasps.object_scale,
        "held": found.held,
        "outcome": found.outcome,
        "delta_pos": found.delta_pos,
        "delta_angle": found.delta_angle,
        "penetration": found.penetration,
        "self_penetration": found.self_penetration,
        "contact_number": found.contact_number,
        "contact_distance": found.contact_distance,
        "contact_consistency": found.contact_consistency,
        "loads": found.loads,
        "protocol": np.full(count, name),
        **(metrics or {}),
    }
    for column, values in found.grasps.columns.items():
        table[f"input_{column}" if column in table else column] = values
    return table


def write_evaluation(found: Evaluation, path: Path | str, metrics: Mapping[str, np.ndarray] | None = None) -> None:
    """Writes the table, in place of an older file only once it is whole.

    Args:
        found: The evaluation.
        path: The file; its ending, one of `TABLE_ENDINGS`, says the format.
        metrics: Further columns (N,), by name.

    Raises:
        ValueError: The ending is another one.
        OSError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix not in TABLE_ENDINGS:
        raise ValueError(f"path: got the ending {path.suffix!r}; wanted one of {', '.join(TABLE_ENDINGS)}")
    with atomic_write(path) as stream:
        _WRITERS[path.suffix](evaluation_table(found, metrics), found.protocol.as_json(), stream)


def _write_parquet(table: dict[str, np.ndarray], parameters: str, stream: BinaryIO) -> None:
    columns = {}
    for name, column in table.items():
        values = pa.array(column.ravel())
        for size in reversed(column.shape[1:]):
            values = pa.FixedSizeListArray.from_arrays(values, size)
        columns[name] = values
    whole = pa.table(columns)
    parquet.write_table(whole.replace_schema_metadata({PARAMETERS: parameters}), stream, compression="zstd")


def _write_csv(table: dict[str, np.ndarray], parameters: str, stream: BinaryIO) -> None:
    columns = {
        "_".join([name, *map(str, place)]): column[(slice(None), *place)]
        for name, column in table.items()
        for place in np.ndindex(column.shape[1:])
    }
    columns[PARAMETERS] = np.full(len(table["source"]), parameters)
    csv.write_csv(pa.table({name: pa.array(np.ascontiguousarray(column)) for name, column in columns.items()}), stream)


def _write_npz(table: dict[str, np.ndarray], parameters: str, stream: BinaryIO) -> None:
    # numpy.savez takes the columns as keyword arguments and trips over one that is called 'file'.
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, column in {**table, PARAMETERS: np.array(parameters)}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, column, allow_pickle=False)


_WRITERS = {".parquet": _write_parquet, ".csv": _write_csv, ".npz": _write_npz}
TABLE_ENDINGS = tuple(_WRITERS)
