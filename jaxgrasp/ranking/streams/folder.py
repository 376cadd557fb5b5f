"""The folder of a run: a manifest that says what is ranked and how, and parts that are whole or not there.

manifest.json        inputs with sizes and digests, options, version, and a digest of all that
parts/part-*.parquet a row a candidate, in the order of the inputs
summaries/*.arrow    of each part: a sketch of the margins, and its best candidates
top.parquet          the best with their forces
"""

import hashlib
import json
import re
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import ipc, parquet

from jaxgrasp.ranking.streams.scored import Summary
from jaxgrasp.ranking.streams.sources import Source
from jaxgrasp.ranking.table import parquet_writer
from jaxgrasp.storage import FileError, atomic_write, open_regular

MANIFEST = "manifest.json"
_FORMAT = 2
# What comes first in a manifest: the digest of the bytes behind it.
_DIGEST = re.compile(rb'\{"digest": "([0-9a-f]{32})",')
# Where a reader of the file finds which run and which part it is of.
_KEY = b"jaxgrasp"
_OF_SOURCES = ("path", "rows", "size", "digest")


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a run ranks, and how."""

    version: str
    """Of the package."""
    run: str
    """The run's own name, which its parts have, too."""
    options: dict[str, Any]
    """What was asked, by the options' names; values are JSON's."""
    part_bytes: int
    """Bytes a part, at most, in memory."""
    inputs: list[dict[str, Any]]
    """Name, path, number of candidates, size and digest of every file."""

    @classmethod
    def new(cls, version: str, options: dict[str, Any], part_bytes: int, sources: Sequence[Source]) -> "Manifest":
        """The manifest of a run that begins."""
        name = secrets.token_hex(8)
        return cls(version=version, run=name, options=options, part_bytes=part_bytes, inputs=_inputs(sources))

    @classmethod
    def read(cls, folder: Path) -> "Manifest":
        """Reads that of a folder.

        Raises:
            FileError: There is none, or it is no manifest, or not what `write` wrote.
        """
        path = folder / MANIFEST
        with open_regular(path, "the manifest of a run (jaxgrasp rank --run)") as stream:
            content = stream.read()
        start = _DIGEST.match(content)
        body = content[start.end() :] if start else b""
        if start is None or start[1] != _digest(body):
            raise FileError(path, None, "no manifest, or a damaged one", "that of a run")
        found = json.loads(b"{" + body)
        if found.pop("format") != _FORMAT:
            raise FileError(path, None, "a manifest of another format", f"format {_FORMAT}")
        return cls(**found)

    def write(self, folder: Path) -> None:
        """Writes it into a folder.

        Raises:
            OSError: It cannot be written.
        """
        body = json.dumps({"format": _FORMAT, **asdict(self)}, indent=1).encode()[1:]
        with atomic_write(folder / MANIFEST) as stream:
            stream.write(b'{"digest": "' + _digest(body) + b'",' + body)

    def other_options(self, version: str, options: dict[str, Any]) -> str:
        """What is asked otherwise than when the run began, in words; empty where nothing is.

        Args:
            version: Of the package.
            options: What is asked now.
        """
        if version != self.version:
            return f"version: got jaxgrasp {version}; the run was begun by {self.version}"
        for name, value in self.options.items():
            if options.get(name) != value:
                return f"--{name.replace('_', '-')}: got {options.get(name)}; the run has {value}"
        return ""

    def other_inputs(self, sources: Sequence[Source]) -> str:
        """Which file is not as it was when the run began, in words; empty where all are.

        Args:
            sources: The files as they are now.
        """
        now = _inputs(sources)
        for before, after in zip(self.inputs, now, strict=False):
            for key in _OF_SOURCES:
                if before[key] != after[key]:
                    what = "another file" if key == "path" else f"a file that has changed ({key})"
                    return f"{after['name']}: got {what}; the run has {before['name']}, {before['rows']:,} candidates"
        if len(now) != len(self.inputs):
            return f"inputs: got {len(now):,} files; the run has {len(self.inputs):,}"
        return ""


class Parts:
    """The parts of a run on the disk."""

    def __init__(self, folder: Path, run: str):
        """Takes the folder, and the run's own name."""
        self._folder, self._run = folder, run

    def path(self, number: int) -> Path:
        """Where a part's rows are."""
        return self._folder / "parts" / f"part-{number:06d}.parquet"

    def write(self, number: int, table: pa.Table, summary: Summary, skipped: Sequence[str]) -> None:
        """Writes a part: its summary first, so that who finds the rows finds both.

        Args:
            number: Of the part.
            table: Its rows, those that could be read.
            summary: Its summary.
            skipped: What could not be read.

        Raises:
            OSError: It cannot be written.
        """
        for path in (self.path(number), self._summary(number)):
            path.parent.mkdir(exist_ok=True)
        best = summary.to_table()
        with atomic_write(self._summary(number)) as stream, ipc.new_file(stream, best.schema) as writer:
            writer.write_table(best)
        about = {"run": self._run, "part": number, "rows": table.num_rows, "skipped": list(skipped)}
        table = table.replace_schema_metadata({_KEY: json.dumps(about)})
        with atomic_write(self.path(number)) as stream, parquet_writer(stream, table.schema) as writer:
            writer.write_table(table)

    def finished(self, number: int) -> tuple[Summary, list[str]] | None:
        """The summary of a part that is there and whole, and what could not be read of it; None where it is not."""
        try:
            with open_regular(self.path(number), cost=0) as stream:
                file = parquet.ParquetFile(stream)
                about = json.loads(file.schema_arrow.metadata[_KEY])
                rows = file.metadata.num_rows
            if (about["run"], about["part"], about["rows"]) != (self._run, number, rows):
                return None
            with open_regular(self._summary(number)) as stream:
                table = ipc.open_file(stream).read_all()
            table.validate(full=True)
            return Summary.from_table(table), about["skipped"]
        except (FileError, pa.ArrowException, OSError, ValueError, KeyError, TypeError):
            return None

    def _summary(self, number: int) -> Path:
        return self._folder / "summaries" / f"part-{number:06d}.arrow"


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=16).hexdigest().encode()


def _inputs(sources: Sequence[Source]) -> list[dict[str, Any]]:
    return [{key: getattr(source, key) for key in ("name", *_OF_SOURCES)} for source in sources]
