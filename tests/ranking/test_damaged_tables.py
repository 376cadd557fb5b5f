"""Files of Parquet and Arrow that are damaged or inflate: refused, whatever pyarrow would make of them."""

import io
import itertools
import random
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import ipc, parquet

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.assaults import streamed  # noqa: E402
from jaxgrasp.ranking.streams.arrow_files import declared  # noqa: E402
from jaxgrasp.ranking.streams.sources import Given, rows_from, source_of  # noqa: E402
from jaxgrasp.storage import FileError, reading  # noqa: E402

GIVEN = Given(friction=0.5, max_force=5.0)


def read(path: Path) -> int:
    source = source_of(str(path), GIVEN)
    with rows_from(source, 0, GIVEN) as rows:
        return len(rows.read(source.rows)[0])


@pytest.mark.parametrize("kind", ["arrow", "parquet"])
def test_every_damaged_table_is_refused_or_read(tmp_path, kind):
    refused = read_well = 0
    made = {"arrow": streamed.arrows, "parquet": streamed.parquets}[kind](random.Random(1), tmp_path)
    # Large ones follow.
    for name, content in itertools.takewhile(lambda case: not case[0].startswith("codec"), made):
        path = tmp_path / f"table.{kind}"
        path.write_bytes(content)
        try:
            read_well += read(path) > 0
        except FileError as error:
            refused += 1
            assert str(error).isprintable(), name
    assert refused > 100 and read_well > 20


@pytest.mark.parametrize("codec", [None, "lz4", "zstd"])
def test_what_arrow_declares_is_what_it_takes(codec):
    count = 3000
    table = pa.table(
        {
            "zeros": np.zeros(count),
            "lists": [[0.5] * (n % 4) for n in range(count)],
            "text": [str(n % 7) for n in range(count)],
            "names": pa.array([f"name {n % 7}" for n in range(count)]).dictionary_encode(),
        }
    )
    stream = io.BytesIO()
    with ipc.new_file(stream, table.schema, options=ipc.IpcWriteOptions(compression=codec)) as writer:
        writer.write_table(table, max_chunksize=1000)
    found = declared(stream)
    assert found.rows == count and found.schema == table.schema
    # Beside the columns there are what is stored of them, and room between buffers.
    assert table.nbytes <= found.inflated + 1000 and found.inflated <= 2 * table.nbytes + 10_000


@pytest.mark.parametrize("kind", ["arrow", "parquet"])
def test_what_inflates_a_hundredfold_is_refused(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(reading, "_SMALL", 1 << 20)
    points = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(240_000)), 3)
    contacts = pa.FixedSizeListArray.from_arrays(points, 4)
    table, path = pa.table({"positions": contacts, "outward_normals": contacts}), tmp_path / f"table.{kind}"
    if kind == "parquet":
        parquet.write_table(table, path, compression="zstd")
    else:
        with ipc.new_file(path, table.schema, options=ipc.IpcWriteOptions(compression="zstd")) as writer:
            writer.write_table(table)
    with pytest.raises(FileError, match=r"that inflate to .*; wanted at most 100 times as much"):
        read(path)
