"""Malformed inputs of `rank` of many candidates: tables of Parquet and Arrow, and folders of runs."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import ipc, parquet

from benchmarks.assaults.arrays import grasps
from benchmarks.assaults.commands import leave_out_computation
from benchmarks.assaults.damage import damaged


def _table(**changes: Any) -> pa.Table:
    columns = {name: value.tolist() for name, value in grasps().items() if name != "object_name"} | changes
    return pa.table({name: value for name, value in columns.items() if value is not None})


def _tables() -> Iterator[tuple[str, pa.Table]]:
    good = grasps()
    positions = good["positions"].tolist()
    count, contacts = len(positions), len(positions[0])
    for label, value in {
        "null": [None] * count,
        "one_null": [None, *positions[1:]],
        "nan": [[[float("nan")] * 3] * contacts] * count,
        "text": [[["x"] * 3] * contacts] * count,
        "two": [[[0.0] * 2] * contacts] * count,
        "flat": [[0.0] * 3] * count,
        "numbers": [0.0] * count,
        "empty": [[]] * count,
        "one_empty": [[], *positions[1:]],
        "ragged": [row[: 1 + n % contacts] for n, row in enumerate(positions)],
        "deep": [[[[0.0]] * 3] * contacts] * count,
        "null_inside": [[[None] * 3] * contacts] * count,
        "null_contact": [[None] * contacts] * count,
        "truth": [[[True] * 3] * contacts] * count,
        "huge": [[[1e308] * 3] * contacts] * count,
        "inf": [[[float("inf")] * 3] * contacts] * count,
        "many_contacts": [[[0.0, 0.0, 0.0]] * 100] * count,
        "absent": None,
    }.items():
        yield f"positions_{label}", _table(positions=value)
    for field in ("friction", "max_force", "mass", "active", "outward_normals", "frames", "torsional_friction"):
        for label, value in {
            "null": [None] * count,
            "text": ["x"] * count,
            "negative": [-1.0] * count,
            "nan": [float("nan")] * count,
            "ragged": [[0.5] * (1 + n % 4) for n in range(count)],
            "empty": [[]] * count,
            "object": [{"a": 1}] * count,
            "turned": [[[0.5] * contacts] * 3] * count,
            "infinite": [float("inf")] * count,
            "absent": None,
        }.items():
            yield f"{field}_{label}", _table(**{field: value})
    whole = _table()
    for label, column in {
        "map": pa.array([[("a", 1)]] * count, pa.map_(pa.string(), pa.int64())),
        "decimal": pa.array([1] * count, pa.decimal128(20, 3)),
        "binary": pa.array([b"\xff"] * count),
        "time": pa.array([0] * count, pa.timestamp("ns", "Europe/Berlin")),
        "nothing": pa.nulls(count),
        "dictionary": pa.array(["a"] * count).dictionary_encode(),
        "struct": pa.array([{"a": 1}] * count),
        "year_0": pa.array([-(2**62)] * count, pa.timestamp("us")),
        "union": pa.UnionArray.from_sparse(pa.array([0] * count, pa.int8()), [pa.array([1] * count)]),
        "half": pa.array(np.zeros(count, "e")),
        "list_view": pa.array([[1]] * count, pa.list_view(pa.int64())),
        "string_view": pa.array(["a"] * count, pa.string_view()),
        "large": pa.array(["a"] * count, pa.large_string()),
        "duration": pa.array([1] * count, pa.duration("s")),
        "month": pa.array([(1, 1, 1)] * count, pa.month_day_nano_interval()),
        "runs": pa.RunEndEncodedArray.from_arrays(pa.array([count], pa.int32()), pa.array([1.0])),
        "uuid": pa.ExtensionArray.from_storage(pa.uuid(), pa.array([b"0" * 16] * count, pa.binary(16))),
    }.items():
        yield f"column_{label}", whole.append_column("more", column)
    for name in (
        "margin",
        "rank",
        "status",
        "source",
        "index",
        "forces_0",
        "positions",
        "score:x",
        "input:x",
        "",
        "a\nb",
        "\x1b[31m",
        "größe 猫",
        "x" * 100_000,
    ):
        yield f"named_{name.strip()[:8]!r}", whole.append_column(name, pa.array([1.0] * count))
    yield "misspelt", whole.rename_columns(["position" if name == "positions" else name for name in whole.column_names])
    yield "none", whole.slice(0, 0)
    yield "no_columns", pa.table({})
    yield "wide", pa.table({f"c{n}": [1.0] for n in range(20_000)})


def _in_parquet(table: pa.Table, **options: Any) -> bytes:
    stream = io.BytesIO()
    parquet.write_table(table, stream, **options)
    return stream.getvalue()


def _in_arrow(table: pa.Table, **options: Any) -> bytes:
    stream = io.BytesIO()
    with ipc.new_file(stream, table.schema, options=ipc.IpcWriteOptions(**options)) as writer:
        writer.write_table(table)
    return stream.getvalue()


def _written(
    write: Callable[..., bytes], draw: random.Random, codecs: tuple[str, ...], compressed: str
) -> Iterator[tuple[str, Any]]:
    good = write(_table())
    yield from damaged(good, draw, 40, 10)
    # Where the schema and the places of the columns are.
    for name, content in damaged(good, draw, 60, 0, within=min(len(good), 3000)):
        yield f"end_{name}", content
    for name, table in _tables():
        try:
            content = write(table)
        except (pa.ArrowException, NotImplementedError):
            continue
        yield name, content
    # What takes a thousandth of its size on the disk.
    many = pa.table(
        {
            name: pa.repeat(pa.scalar(column[0].as_py(), column.type), 1)
            for name, column in zip(_table().column_names, _table().columns, strict=True)
        }
    )
    for codec in codecs:
        yield f"codec_{codec}", write(_table(), **{compressed: codec})
    text = pa.array(["x" * (1 << 20)]).dictionary_encode()
    repeated = pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(_table()), np.int32)), text.dictionary)
    yield "text_again_and_again", write(pa.concat_tables([_table().append_column("more", repeated)] * 500))
    yield "long_text", write(_table().append_column("more", repeated))
    yield "many_rows", write(pa.concat_tables([many] * 200_000).combine_chunks(), **{compressed: "zstd"})


def parquets(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    yield from _written(_in_parquet, draw, ("snappy", "gzip", "brotli", "lz4", "zstd"), "compression")
    good = _in_parquet(_table())
    length = int.from_bytes(good[-8:-4], "little")
    for number in (0, 1, length - 1, length + 1, len(good), 2**31 - 1, 2**32 - 1):
        yield f"footer_{number}", good[:-8] + number.to_bytes(4, "little") + b"PAR1"
    yield "encrypted", good[:-4] + b"PARE"
    yield "only_ends", b"PAR1PAR1"
    # Zeros that take next to nothing on the disk.
    zeros = pa.FixedSizeListArray.from_arrays(pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(36_000_000)), 3), 3)
    normals = pa.FixedSizeListArray.from_arrays(pa.FixedSizeListArray.from_arrays(pa.array(np.ones(36_000_000)), 3), 3)
    yield "zeros", _in_parquet(pa.table({"positions": zeros, "outward_normals": normals}), compression="zstd")
    wide = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(60_000_000)), 60_000_000)
    yield "one_wide_row", _in_parquet(_table().slice(0, 1).append_column("more", wide), compression="zstd")


def arrows(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    yield from _written(_in_arrow, draw, ("lz4", "zstd"), "compression")
    good, table = _in_arrow(_table()), _table()
    stream = io.BytesIO()
    with ipc.new_stream(stream, table.schema) as writer:
        writer.write_table(table)
    yield "stream", stream.getvalue()
    yield "feather_1", b"FEA1" + good[8:]
    yield "only_ends", b"ARROW1\0\0ARROW1"
    for number in (0, 1, len(good), 2**31 - 1, 2**32 - 1):
        yield f"footer_{number}", good[:-10] + number.to_bytes(4, "little") + b"ARROW1"
    # Offsets and places that lead elsewhere.
    inner = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(12)), 3)
    lists = pa.ListArray.from_arrays(pa.array([0, 4], pa.int32()), inner)
    one = _table().slice(0, 1)
    changed = {
        "offsets": _in_arrow(pa.table({"positions": lists, "outward_normals": lists})),
        "text": _in_arrow(one.append_column("more", pa.array(["abcdabcd"]))),
    }
    for name, (old, new) in {
        "offsets": ((0, 4), (0, 10**9)),
        "offsets_back": ((0, 4), (4, 0)),
        "offsets_negative": ((0, 4), (-5, 4)),
        "text": ((0, 8), (0, 10**9)),
        "text_negative": ((0, 8), (-(10**9), 8)),
    }.items():
        content, before = changed[name.partition("_")[0]], np.array(old, np.int32).tobytes()
        assert before in content, name
        yield f"{name}_changed", content.replace(before, np.array(new, np.int32).tobytes(), 1)
    yield "text_no_unicode", changed["text"].replace(b"abcdabcd", b"\xff\xfe\xff\xfe\xff\xfe\xff\xfe")
    places = pa.DictionaryArray.from_arrays(pa.array([7], pa.int32()), pa.array(["a"]), safe=False)
    yield "places_beyond", _in_arrow(one.append_column("more", places))
    flat = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(144_000_000, "i1")), 3)
    yield "zeros", _in_arrow(pa.table({"positions": pa.FixedSizeListArray.from_arrays(flat, 3)}), compression="zstd")


def runs(draw: random.Random, home: Path) -> Iterator[tuple[str, Any]]:
    """Folders of runs, each a copy of a whole one with one thing changed."""
    whole = _whole_run(home)
    manifest = json.loads((whole / "manifest.json").read_text())

    def copied(change: Callable[[Path], object]) -> Callable[[Path], object]:
        def make(path: Path) -> None:
            shutil.copytree(whole, path)
            change(path)

        return make

    def with_manifest(content: bytes) -> Callable[[Path], object]:
        return copied(lambda path: (path / "manifest.json").write_bytes(content))

    yield "as_it_is", copied(lambda path: None)
    for name, content in damaged((whole / "manifest.json").read_bytes(), draw, 40, 10):
        yield f"manifest_{name}", with_manifest(content)
    for key in manifest:
        for number, value in enumerate((None, -1, {"a": [1]})):
            yield f"{key}_{number}", with_manifest(json.dumps(manifest | {key: value}).encode())
        yield f"{key}_absent", with_manifest(json.dumps({k: v for k, v in manifest.items() if k != key}).encode())
    for part in ("options", "inputs"):
        own = manifest[part] if part == "options" else manifest[part][0]
        for key in own:
            for number, value in enumerate(("x", 10**30)):
                changed = own | {key: value}
                content = manifest | {part: changed if part == "options" else [changed]}
                yield f"{part}_{key}_{number}", with_manifest(json.dumps(content).encode())
    yield "more", with_manifest(json.dumps(manifest | {"more": 1}).encode())
    yield "manifest_list", with_manifest(b"[]")
    yield "manifest_deep", with_manifest(b"[" * 100_000)
    yield "manifest_large", with_manifest(b'{"format": [' + b"{}," * 10_000_000 + b"{}]}")
    files = (
        "manifest.json",
        "parts/part-000000.parquet",
        "summaries/part-000001.arrow",
        "top.parquet",
        "ranking.png",
        ".lock",
    )
    for file in files:
        kinds: dict[str, Callable[[Path], object]] = {
            "absent": lambda path: None,
            "fifo": os.mkfifo,
            "folder": os.mkdir,
            "empty": lambda path: path.write_bytes(b""),
            "loop": lambda path: path.symlink_to(path),
            "zero": lambda path: path.symlink_to("/dev/zero"),
            "noise": lambda path: path.write_bytes(draw.randbytes(3000)),
        }
        for kind, make in kinds.items():
            yield (
                f"{Path(file).name}_{kind}",
                copied(lambda path, file=file, make=make: ((path / file).unlink(missing_ok=True), make(path / file))),
            )
    for file in files[1:3]:
        for name, content in damaged((whole / file).read_bytes(), draw, 25, 5):
            yield (
                f"{Path(file).name}_{name}",
                copied(lambda path, file=file, content=content: (path / file).write_bytes(content)),
            )
    for folder in ("parts", "summaries"):
        yield f"{folder}_absent", copied(lambda path, folder=folder: shutil.rmtree(path / folder))
        yield (
            f"{folder}_file",
            copied(lambda path, folder=folder: (shutil.rmtree(path / folder), (path / folder).write_text(""))),
        )
    swap = lambda path: shutil.copy(path / "parts/part-000001.parquet", path / "parts/part-000000.parquet")
    yield "another_part", copied(swap)
    yield (
        "another_summary",
        copied(lambda path: shutil.copy(path / "summaries/part-000001.arrow", path / "summaries/part-000000.arrow")),
    )
    yield "sorting", copied(lambda path: (path / ".sorting").write_text(""))


def _whole_run(home: Path) -> Path:
    """A finished run of a few candidates whose margins are made up, in `home`."""
    file, folder = home / "few.npz", home / "whole"
    np.savez(file, **grasps())
    child = os.fork()
    if child == 0:
        try:
            leave_out_computation()
            from jaxgrasp.cli import main

            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 1)
            os._exit(main(["rank", os.fspath(file), "--run", os.fspath(folder), "--part-size", "3", "--top", "2"]))
        finally:
            os._exit(70)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    return folder
