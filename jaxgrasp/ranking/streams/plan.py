"""Parts: how the candidates of many files are divided, read in order, and laid out in tables of one schema."""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from jaxgrasp.candidates import Candidates, concatenate
from jaxgrasp.ranking.streams.scored import Scored, status_names
from jaxgrasp.ranking.streams.sources import Given, Rows, Source, rows_from
from jaxgrasp.storage import FileError

# Names that tables of rankings have themselves; what travels along under one of them is `input_` and the name.
_RESERVED = ("rank", "source", "index", "margin", "upper_bound", "status", "effort", "forces", "mass")


@dataclass(frozen=True)
class Segment:
    """Some candidates of a file."""

    source: int
    """The file's number."""
    start: int
    """The first of them."""
    stop: int
    """The one after the last."""


Part = tuple[Segment, ...]


def parts_of(sources: Sequence[Source], rows: int, size: int) -> list[Part]:
    """Divides the candidates of all files, in their order.

    Args:
        sources: The files.
        rows: Candidates a part, at most.
        size: Bytes a part, at most, but for a single candidate that is larger.
    """
    parts: list[Part] = []
    segments: list[Segment] = []
    left, room = rows, size
    for number, source in enumerate(sources):
        start = 0
        while start < source.rows:
            count = min(source.rows - start, left, room // source.row_size)
            if count <= 0 and segments:
                parts.append(tuple(segments))
                segments, left, room = [], rows, size
                continue
            count = max(count, 1)
            segments.append(Segment(number, start, start + count))
            start, left, room = start + count, left - count, room - count * source.row_size
    return [*parts, tuple(segments)] if segments else parts


def schema_of(sources: Sequence[Source]) -> pa.Schema:
    """The columns that travel along from any of the files.

    Raises:
        FileError: They do not go together.
    """
    first = sources[0]
    for source in sources:
        if source.framed != first.framed:
            raise FileError(
                f"{first.name}, {source.name}",
                None,
                "some sources give outward_normals and others frames",
                "the same for all",
            )
    try:
        return pa.unify_schemas([source.travelling for source in sources], promote_options="permissive")
    except pa.ArrowException:
        pass
    found = first.travelling
    for source in sources:
        try:
            found = pa.unify_schemas([found, source.travelling], promote_options="permissive")
        except pa.ArrowException as error:
            wanted = "files that go together"
            raise FileError(
                source.name, None, f"columns of other types ({' '.join(str(error).split())})", wanted
            ) from error
    return found


class PartReader:
    """Reads parts, and what follows the last one read without opening its file anew."""

    def __init__(self, sources: Sequence[Source], schema: pa.Schema, given: Given):
        """Takes the files, the columns that travel along, and what files without some fields get."""
        self._sources, self._schema, self._given = sources, schema, given
        self._open = contextlib.ExitStack()
        self._rows: Rows | None = None
        self._next: tuple[int, int] | None = None

    def read(
        self, part: Part, skipped: Callable[[FileError], None] | None = None
    ) -> tuple[Candidates, pa.Table] | None:
        """Reads a part.

        Args:
            part: Which.
            skipped: Told of what cannot be read; None lets the error out.

        Returns:
            Candidates without columns, and a table of these; None where nothing of the part can be read.

        Raises:
            FileError: A file cannot be read.
        """
        found = []
        for segment in part:
            try:
                found.append(self._read(segment))
            except FileError as error:
                self.close()
                if skipped is None:
                    raise
                skipped(error)
        if not found:
            return None
        candidates, tables = zip(*found, strict=True)
        return concatenate(candidates), pa.concat_tables(tables)

    def close(self) -> None:
        """Closes what is open."""
        self._open.close()
        self._next = None

    def _read(self, segment: Segment) -> tuple[Candidates, pa.Table]:
        source = self._sources[segment.source]
        if self._next != (segment.source, segment.start) or self._rows is None:
            self.close()
            self._rows = self._open.enter_context(rows_from(source, segment.start, self._given))
        candidates, travelling = self._rows.read(segment.stop - segment.start)
        self._next = (segment.source, segment.stop)
        columns = dict(zip(travelling.column_names, travelling.columns, strict=True))
        # A table without columns has no rows, whatever is appended.
        travelling = pa.table(columns | {key: pa.repeat(value, len(candidates)) for key, value in source.keys})
        candidates = replace(
            candidates, sources=(source.name,), index=np.arange(segment.start, segment.stop, dtype=np.int64)
        )
        return candidates, laid_out(travelling, self._schema, source.name, len(candidates))


def laid_out(table: pa.Table, schema: pa.Schema, name: str, rows: int) -> pa.Table:
    """The same columns with those that a schema has; what is missing is null.

    Raises:
        FileError: A column has values that the schema's type has not.
    """
    columns = []
    for field in schema:
        try:
            there = field.name in table.column_names
            columns.append(table.column(field.name).cast(field.type) if there else pa.nulls(rows, field.type))
        except pa.ArrowException as error:
            raise FileError(name, field.name, " ".join(str(error).split()), f"{field.type}") from error
    return pa.table(columns, schema=schema)


def nothing(framed: bool, schema: pa.Schema, metrics: Sequence[str]) -> Scored:
    """A part without candidates: where none can be read.

    Args:
        framed: Whether the files give frames, and not normals.
        schema: The columns that travel along.
        metrics: Names of those that are asked for.
    """
    none = np.empty((0, 1, 3, 3))
    candidates = Candidates(
        positions=none[..., 0],
        outward_normals=None if framed else none[..., 0],
        frames=none if framed else None,
        friction=none[..., 0, 0],
        max_force=none[..., 0, 0],
        active=np.empty((0, 1), dtype=bool),
        mass=np.empty(0),
        sources=(),
        source=np.empty(0, dtype=np.int32),
        index=np.empty(0, dtype=np.int64),
    )
    number = np.empty(0)
    return Scored(
        candidates=candidates,
        travelling=schema.empty_table(),
        margin=number,
        upper_bound=number,
        status=np.empty(0, dtype=int),
        metrics=dict.fromkeys(metrics, number),
    )


def part_table(part: Scored, massive: bool) -> pa.Table:
    """The rows of a part, in the order of the inputs.

    Args:
        part: The candidates with what was found.
        massive: Whether any file of the run gives masses.
    """
    candidates = part.candidates
    columns = {
        "source": pa.DictionaryArray.from_arrays(
            pa.array(candidates.source.astype(np.int32)), pa.array(candidates.sources, pa.string())
        ),
        "index": pa.array(candidates.index),
        "margin": pa.array(part.margin),
        "upper_bound": pa.array(part.upper_bound),
        "status": status_names(part.status),
        **{name: pa.array(value) for name, value in part.metrics.items() if name != "margin"},
    }
    if massive:
        columns["mass"] = pa.array(candidates.mass)
    own = {*columns, *_RESERVED}
    for name, column in zip(part.travelling.column_names, part.travelling.columns, strict=True):
        columns[f"input_{name}" if name in own or name.startswith("forces_") else name] = column
    return pa.table(columns)
