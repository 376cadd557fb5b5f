"""The table of a ranking, best first, as Parquet, CSV or NPZ."""

import itertools
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from jaxgrasp.ranking.rank import Ranking
from jaxgrasp.solvers.status import Status
from jaxgrasp.storage import atomic_write

_PIECE = 131_072


def ranking_table(ranking: Ranking, ranks: slice = slice(None)) -> dict[str, np.ndarray]:
    """Makes the columns of the table, one row a candidate, the best first.

    Args:
        ranking: The ranking of candidates with n_c contacts.
        ranks: Which of the rows to make, the best being row 0; all N of them by default.

    Returns:
        Arrays with a leading axis of N by name: rank; source and index, the file and the row in it; margin and
        upper_bound, multiples of the disturbance set; status; other metrics that were asked for; effort, N^2, and
        forces (N, n_c, 3), N, on the object in its frame, NaN for all but the best, like the moments (N, n_c) of soft
        contacts, N m, about their normals, and the controls (N, n_u) of a hand; mass where any is known; and what
        travelled along, with `input_` before a name that the table has itself.
    """
    table = _columns(ranking, ranks)
    return table | {name: names[table[name]] for name, names in _names(ranking).items()}


def _names(ranking: Ranking) -> dict[str, np.ndarray]:
    """What the numbers in some columns stand for."""
    return {
        "source": np.array(ranking.candidates.sources),
        "status": np.array([status.name for status in Status]),
    }


def _columns(ranking: Ranking, ranks: slice) -> dict[str, np.ndarray]:
    """The same with numbers for `_names`: a million names would take as long to write as all else."""
    candidates, order = ranking.candidates, ranking.order[ranks]
    rank = np.arange(1, len(ranking.order) + 1)[ranks]
    answers = rank[rank <= len(ranking.forces)] - 1
    forces = np.full((len(order), candidates.num_contacts, 3), np.nan)
    forces[: len(answers)] = ranking.object_forces[answers]
    effort = np.full(len(order), np.nan)
    effort[: len(answers)] = ranking.effort[answers]
    table = {
        "rank": rank,
        "source": candidates.source[order],
        "index": candidates.index[order],
        "margin": ranking.margin[order],
        "upper_bound": ranking.upper_bound[order],
        "status": ranking.status[order],
        **{name: value[order] for name, value in ranking.metrics.items() if name != "margin"},
        "effort": effort,
        "forces": forces,
    }
    if ranking.moments is not None:
        moments = np.full((len(order), candidates.num_contacts), np.nan)
        moments[: len(answers)] = ranking.moments[answers]
        table["moments"] = moments
    if ranking.controls.shape[-1]:
        controls = np.full((len(order), ranking.controls.shape[-1]), np.nan)
        controls[: len(answers)] = ranking.controls[answers]
        table["controls"] = controls
    if not np.isnan(candidates.mass).all():
        table["mass"] = candidates.mass[order]
    for name, column in candidates.columns.items():
        own = name in table or name.startswith("forces_")
        table[f"input_{name}" if own else name] = column[order]
    return table


def write_table(ranking: Ranking, path: Path | str) -> None:
    """Writes the table of a ranking, in place of an older file only once it is whole.

    In Parquet, arrays per candidate are lists of fixed size and the forces of all but the best are null; in CSV they
    are columns of their own (`forces_0_x`, `joints_3`) and empty; in NPZ they are plain arrays and NaN.

    Args:
        ranking: The ranking.
        path: The file; its ending, one of `TABLE_ENDINGS`, says the format.

    Raises:
        ValueError: The ending is another one.
        OSError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix not in TABLE_ENDINGS:
        raise ValueError(f"path: got the ending {path.suffix!r}; wanted one of {', '.join(TABLE_ENDINGS)}")
    with atomic_write(path) as stream:
        _WRITERS[path.suffix](ranking, stream)


def top_table(ranking: Ranking, travelling: pa.Table) -> pa.Table:
    """The table of a ranking as Arrow's.

    Args:
        ranking: The ranking; its candidates' own columns are passed over.
        travelling: These in Arrow, in the candidates' order: Arrow has more kinds of them.
    """
    bare = replace(ranking, candidates=replace(ranking.candidates, columns={}))
    found = _arrow(_columns(bare, slice(None)).items(), _names(ranking))
    for name, column in zip(travelling.column_names, travelling.columns, strict=True):
        own = name in found.column_names or name.startswith("forces_")
        found = found.append_column(f"input_{name}" if own else name, column.take(pa.array(ranking.order)))
    return found


def _write_parquet(ranking: Ranking, stream: BinaryIO) -> None:
    names = _names(ranking)
    pieces = (_arrow(piece.items(), names) for piece in _pieces(ranking))
    first = next(pieces)
    with parquet_writer(stream, first.schema) as writer:
        for piece in itertools.chain([first], pieces):
            writer.write_table(piece)


def parquet_writer(stream: BinaryIO, schema: pa.Schema) -> parquet.ParquetWriter:
    """What writes tables of candidates to a stream as Parquet."""
    # Numbers hardly ever repeat: a dictionary of them would be given up after it was made.
    texts = [field.name for field in schema if not pa.types.is_floating(field.type)]
    # Its annotation says bool, its documentation "bool or list".
    return parquet.ParquetWriter(stream, schema, compression="zstd", use_dictionary=cast(bool, texts))


def _write_csv(ranking: Ranking, stream: BinaryIO) -> None:
    names = _names(ranking)
    pieces = (_arrow(_flat(piece), names) for piece in _pieces(ranking))
    first = next(pieces)
    with csv.CSVWriter(stream, first.schema) as writer:
        for piece in itertools.chain([first], pieces):
            writer.write_table(piece)


def _write_npz(ranking: Ranking, stream: BinaryIO) -> None:
    # numpy.savez takes the columns as keyword arguments and trips over one that is called 'file'.
    # The lowest level is three times as fast, and a fifth larger.
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, column in ranking_table(ranking).items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, column, allow_pickle=False)


_WRITERS = {".parquet": _write_parquet, ".csv": _write_csv, ".npz": _write_npz}
TABLE_ENDINGS = tuple(_WRITERS)


def _pieces(ranking: Ranking) -> Iterator[dict[str, np.ndarray]]:
    # Whole columns of file names alone would take half a gigabyte for a million candidates.
    for start in range(0, max(1, len(ranking.order)), _PIECE):
        yield _columns(ranking, slice(start, start + _PIECE))


def _arrow(columns: Iterable[tuple[str, np.ndarray]], names: dict[str, np.ndarray]) -> pa.Table:
    arrays = {
        name: pa.DictionaryArray.from_arrays(pa.array(column.astype(np.int32)), pa.array(names[name]))
        if name in names
        else arrow_column(name, column)
        for name, column in columns
    }
    return pa.table(arrays)


def arrow_column(name: str, column: np.ndarray) -> pa.Array:
    """A column of the table as Arrow's: arrays per candidate are lists of fixed size."""
    # Null is only what this table has no answer for; a margin or a travelling number that is NaN stays NaN.
    if name == "effort" or (name.startswith("forces_") and column.ndim == 1):
        return pa.array(column, mask=np.isnan(column))
    values = pa.array(column.ravel())
    for size in reversed(column.shape[1:]):
        values = pa.FixedSizeListArray.from_arrays(values, size)
    if name == "forces":
        unknown = pa.array(np.isnan(column).all(axis=(1, 2)))
        values = pa.FixedSizeListArray.from_arrays(values.values, column.shape[1], mask=unknown)
    return values


def _flat(table: dict[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    for name, column in table.items():
        for place in np.ndindex(column.shape[1:]):
            parts = [str(number) for number in place]
            if name == "forces":
                parts[-1] = "xyz"[place[-1]]
            yield "_".join([name, *parts]), column[(slice(None), *place)]
