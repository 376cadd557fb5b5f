"""Files of candidates that may be larger than memory: what each declares, and its rows from any one on."""

import contextlib
import hashlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Protocol, cast
from urllib.parse import unquote

import numpy as np
import pyarrow as pa
from pyarrow import ipc, parquet

from jaxgrasp.candidates import Candidates
from jaxgrasp.candidates.arrow import candidates_of_table
from jaxgrasp.candidates.reader import FIELDS, candidates_of_arrays, fields_of
from jaxgrasp.ranking.streams.arrow_files import declared, whole_batch
from jaxgrasp.ranking.table import arrow_column
from jaxgrasp.storage import (
    Archive,
    ArchiveRows,
    FileError,
    allowance,
    archive_in,
    check_inflation,
    open_regular,
    printable,
    reason_of,
)

_WANTED = "a file of candidates, .npz, Parquet or Arrow"
_KINDS = {b"PK": "npz", b"\x93NUMPY": "npz", b"PAR1": "parquet", b"ARROW1": "arrow"}
# Of large files so many pieces, of so many bytes, evenly spread and with both ends, stand for the whole. Archives have
# checksums of all their arrays at the end, and Parquet and Arrow files the places of all their columns.
_PIECES, _PIECE = 16, 1 << 14
# What declares more rows than this is checked as if it had so many.
_CHECKED = 1 << 20
_ROWS_AT_ONCE = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Given:
    """What files without some fields get."""

    friction: float | None = None
    """Coulomb's coefficient."""
    max_force: float | None = None
    """Largest normal force, N."""
    with_mass: bool = False
    """Whether every file must have masses."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A file of candidates by what it declares."""

    name: str
    """What tables call it."""
    path: str
    """Where it is: an absolute path, or a URL."""
    kind: str
    """npz, parquet or arrow."""
    rows: int
    """Number of candidates."""
    size: int
    """Bytes of the file."""
    digest: str
    """Of pieces of the file, both ends among them."""
    framed: bool
    """Whether it gives frames, and not normals."""
    massive: bool
    """Whether it gives masses."""
    travelling: pa.Schema
    """Columns that travel along."""
    row_size: int
    """Bytes that a candidate takes in memory."""
    keys: tuple[tuple[str, str], ...] = ()
    """Columns of one value, text, that folders called NAME=VALUE above the file stand for, as datasets of Hive have."""


class Rows(Protocol):
    """A file's candidates from some row on."""

    def read(self, count: int) -> tuple[Candidates, pa.Table]:
        """Reads the next candidates, without columns, and a table of these."""
        ...


@contextlib.contextmanager
def opened(path: str) -> Iterator[BinaryIO]:
    """Opens a file for reading, of which only parts come into memory.

    Args:
        path: A path of a regular file, or a URL that pyarrow or fsspec know.

    Raises:
        FileError: It cannot be opened or read.
    """
    if not is_url(path):
        with open_regular(path, _WANTED, cost=0) as stream:
            yield stream
        return
    with reading(path):
        system, inner = file_system(path)
        stream = system.open_input_file(inner)
    with stream:
        yield cast(BinaryIO, stream)


@contextlib.contextmanager
def reading(path: str) -> Iterator[None]:
    """Turns whatever Arrow raises for a file into the one error of files."""
    try:
        yield
    except FileError:
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, EOFError, ImportError) as error:
        raise FileError(path, None, reason_of(error), _WANTED) from error


def is_url(path: str) -> bool:
    """Whether this names no file of this machine's own."""
    return "://" in path


def file_system(url: str):
    """The file system that a URL is in, and its path there; pyarrow's own ones first, then those of fsspec."""
    from pyarrow import fs

    try:
        return fs.FileSystem.from_uri(url)
    except pa.ArrowInvalid as error:
        try:
            import fsspec
        except ImportError:
            raise ValueError(f"{reason_of(error)}; other URLs need the package fsspec") from error
        system, inner = fsspec.core.url_to_fs(url)
        return fs.PyFileSystem(fs.FSSpecHandler(system)), inner


def source_of(name: str, given: Given) -> Source:
    """Looks at what a file declares.

    Args:
        name: A path, or a URL.
        given: What it gets where it lacks fields.

    Raises:
        FileError: It cannot be used.
    """
    with opened(name) as stream, reading(name):
        size = stream.seek(0, 2)
        digest = _digest(stream, size)
        stream.seek(0)
        start = stream.read(8)
        stream.seek(0)
        kind = next((kind for magic, kind in _KINDS.items() if start.startswith(magic)), None)
        if kind is None:
            raise FileError(name, None, "a file of another kind" if size else "an empty file", _WANTED)
        if kind == "npz":
            with archive_in(stream, name) as archive:
                rows, sample, travelling = _declared(archive, name, given)
            names = tuple(archive.headers)
        else:
            schema, rows = _schema(stream, name, kind, size)
            sample, travelling = candidates_of_table(schema.empty_table(), name, **vars(given))
            names, travelling = schema.names, travelling.schema
            if rows < 1:
                raise FileError(name, "positions", "no candidates", "at least one")
    keys = _keys(name, {*names, *FIELDS})
    travelling = pa.schema([*travelling, *((key, pa.string()) for key, _ in keys)])
    contact = 8 * (3 + (9 if sample.frames is not None else 3) + 3)
    # Lists of variable size tell of no number of contacts before they are read.
    contacts = sample.num_contacts if sample.num_contacts > 1 else 4
    return Source(
        name=printable(name),
        path=absolute(name),
        kind=kind,
        rows=rows,
        size=size,
        digest=digest,
        framed=sample.frames is not None,
        massive="mass" in names,
        travelling=travelling,
        row_size=contacts * contact + sum(_width(field.type) for field in travelling),
        keys=keys,
    )


@contextlib.contextmanager
def rows_from(source: Source, start: int, given: Given) -> Iterator[Rows]:
    """Opens a file at one of its candidates.

    Args:
        source: The file.
        start: The first candidate to be read.
        given: What it gets where it lacks fields.

    Raises:
        FileError: It cannot be read.
    """
    with opened(source.path) as stream:
        if source.kind == "npz":
            with archive_in(stream, source.name) as archive:
                yield _ArchiveRows(source, archive, start, given)
        else:
            with reading(source.name):
                found = _batches(stream, source.kind, start)
            yield _TableRows(source, *found, given)


class _ArchiveRows:
    def __init__(self, source: Source, archive: Archive, start: int, given: Given):
        names = fields_of(source.name, archive)
        if archive.headers["positions"].shape[0] != source.rows:
            raise FileError(source.name, None, "a file that has changed", "the one that the run began with")
        self._source, self._given, self._there = source, given, tuple(archive.headers)
        self._rows = ArchiveRows(source.name, archive, names, source.rows)
        self._rows.skip(start)

    def read(self, count: int) -> tuple[Candidates, pa.Table]:
        arrays = self._rows.read(count)
        found = candidates_of_arrays(self._source.name, arrays, there=self._there, **vars(self._given))
        columns = {name: arrow_column(name, column) for name, column in found.columns.items()}
        return replace(found, columns={}), pa.table(columns)


class _TableRows:
    def __init__(self, source: Source, batches: Iterator[pa.RecordBatch], skip: int, given: Given):
        self._source, self._batches, self._given = source, batches, given
        self._left: pa.RecordBatch | None = None
        self._inflated = 0
        while skip > 0:
            skip -= self._next(skip).num_rows

    def read(self, count: int) -> tuple[Candidates, pa.Table]:
        pieces, wanted = [], count
        while wanted > 0:
            pieces.append(self._next(wanted))
            wanted -= pieces[-1].num_rows
        table = pa.Table.from_batches(pieces)
        if table.nbytes > allowance():
            raise FileError(self._source.name, None, f"{count:,} rows that take {table.nbytes:,} bytes", "fewer bytes")
        return candidates_of_table(table, self._source.name, **vars(self._given))

    def _next(self, most: int) -> pa.RecordBatch:
        """The next rows, at most so many."""
        if self._left is None or not self._left.num_rows:
            with reading(self._source.name):
                self._left = next(self._batches, None)
            if self._left is None:
                raise FileError(self._source.name, None, "fewer rows than before", f"{self._source.rows:,}")
            # Numbers that repeat take hardly any bytes of Parquet, and nothing tells how many they are.
            self._inflated += self._left.nbytes
            check_inflation(self._source.name, None, self._source.size, self._inflated)
        found, self._left = self._left.slice(0, most), self._left.slice(most)
        return found


def _declared(archive: Archive, name: str, given: Given) -> tuple[int, Candidates, pa.Schema]:
    """Rows, candidates with the shapes and kinds that an archive's headers declare, and its other columns."""
    fields = fields_of(name, archive)
    rows = archive.headers["positions"].shape[0]
    arrays = {}
    for field in fields:
        header = archive.headers[field]
        if header.dtype.hasobject:
            archive.read([field])  # refuses it
        shape = (min(rows, _CHECKED), *header.shape[1:]) if header.shape[:1] == (rows,) else header.shape
        dtype = {"S": np.dtype("U1"), "U": np.dtype("U1")}.get(header.dtype.kind, header.dtype)
        dtype = np.dtype(np.float64) if field in _NUMBERS and dtype.kind in "iuf" else dtype
        # One number that is everywhere: nothing is allocated.
        arrays[field] = np.broadcast_to(np.zeros((), dtype), shape)
    sample = candidates_of_arrays(name, arrays, there=tuple(archive.headers), **vars(given))
    columns = [
        (key, arrow_column(key, np.ascontiguousarray(column[:0])).type) for key, column in sample.columns.items()
    ]
    return rows, sample, pa.schema(columns)


_NUMBERS = ("positions", "outward_normals", "frames", "friction", "torsional_friction", "max_force", "mass")


def _schema(stream: BinaryIO, name: str, kind: str, size: int) -> tuple[pa.Schema, int]:
    if kind == "parquet":
        file = parquet.ParquetFile(stream)
        return file.schema_arrow.remove_metadata(), file.metadata.num_rows
    found = declared(stream)
    check_inflation(name, None, size, found.inflated)
    return found.schema, found.rows


def _batches(stream: BinaryIO, kind: str, start: int) -> tuple[Iterator[pa.RecordBatch], int]:
    """Batches of rows, and how many of the first to pass over."""
    if kind == "arrow":
        reader = ipc.open_file(stream)
        return (whole_batch(reader, number) for number in range(reader.num_record_batches)), start
    # A group of rows may be larger than memory: its columns are read piece by piece.
    file = parquet.ParquetFile(stream, pre_buffer=False, buffer_size=1 << 20)
    first = 0
    while first < file.num_row_groups - 1 and start >= file.metadata.row_group(first).num_rows:
        start -= file.metadata.row_group(first).num_rows
        first += 1
    groups = list(range(first, file.num_row_groups))
    return file.iter_batches(_ROWS_AT_ONCE, row_groups=groups, use_threads=False), start


def _keys(name: str, there: Collection[str]) -> tuple[tuple[str, str], ...]:
    """What the folders above a file say of its rows, but for what the file has itself."""
    pairs = (piece.partition("=") for piece in name.split("/")[:-1])
    found = {key: unquote(value) for key, sign, value in pairs if key and sign}
    return tuple((key, value) for key, value in found.items() if key not in there)


def _digest(stream: BinaryIO, size: int) -> str:
    places = {0} if size <= _PIECES * _PIECE else {n * (size - _PIECE) // (_PIECES - 1) for n in range(_PIECES)}
    found = hashlib.blake2b(str(size).encode(), digest_size=16)
    for place in sorted(places):
        stream.seek(place)
        found.update(stream.read(_PIECES * _PIECE if len(places) == 1 else _PIECE))
    return found.hexdigest()


def _width(kind: pa.DataType) -> int:
    """Bytes of a value, roughly where it has no fixed size."""
    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _width(kind.value_type)
    try:
        return max(1, kind.bit_width // 8)
    except ValueError:
        return 32


def digest_of(path: Path | str) -> str:
    """Tells a file from others, as `Source.digest` does."""
    with opened(str(path)) as stream:
        return _digest(stream, stream.seek(0, 2))


def absolute(path: Path | str) -> str:
    """A path that means the same in other folders; URLs as they are."""
    return str(path) if is_url(str(path)) else str(Path(path).absolute())
