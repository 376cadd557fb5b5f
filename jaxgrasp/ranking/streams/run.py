"""A ranking of any number of candidates in bounded memory: part by part into a folder, from which it can go on."""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from jaxgrasp.candidates import Candidates
from jaxgrasp.ranking.rank import Ranking
from jaxgrasp.ranking.streams.folder import Parts
from jaxgrasp.ranking.streams.plan import Part, PartReader, nothing, part_table, parts_of, schema_of
from jaxgrasp.ranking.streams.scored import Setting, Summary, scored
from jaxgrasp.ranking.streams.sources import Source
from jaxgrasp.ranking.table import parquet_writer, top_table
from jaxgrasp.storage import FileError, atomic_write, claimed

PART_ROWS = 131_072
"""Candidates a part, at most."""
TOP = "top.parquet"

Skipped = Callable[[Exception], None]


@dataclass(frozen=True, kw_only=True)
class Job:
    """All that a process needs to do parts of a run: it is small, and can be sent to others."""

    folder: Path
    """The run's folder."""
    run: str
    """The run's own name."""
    sources: tuple[Source, ...]
    """The files."""
    setting: Setting
    """What is asked of every candidate."""
    part_rows: int
    """Candidates a part, at most."""
    part_size: int
    """Bytes a part, at most."""
    keep_going: bool = False
    """Whether what cannot be read is passed over."""

    @functools.cached_property
    def schema(self) -> pa.Schema:
        """The columns that travel along."""
        return schema_of(self.sources)

    @functools.cached_property
    def plan(self) -> list[Part]:
        """The parts."""
        return parts_of(self.sources, self.part_rows, self.part_size)

    @property
    def parts(self) -> Parts:
        """The parts on the disk."""
        return Parts(self.folder, self.run)

    @property
    def rows(self) -> int:
        """Number of candidates."""
        return sum(source.rows for source in self.sources)

    def reader(self) -> PartReader:
        """What reads the parts."""
        return PartReader(self.sources, self.schema, self.setting.given)

    def read(self, reader: PartReader, number: int) -> "Read":
        """Reads a part.

        Raises:
            FileError: A file cannot be read, and nothing is to be passed over.
        """
        errors: list[FileError] = []
        batch = reader.read(self.plan[number], errors.append if self.keep_going else None)
        return Read(number=number, batch=batch, errors=errors)

    def score(
        self,
        read: "Read",
        best: np.ndarray | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> tuple[pa.Table, Summary]:
        """Ranks a part.

        Args:
            read: What was read of it.
            best: With `prune`, margins of the best that are known from other parts.
            progress: Called with the number of candidates done.

        Returns:
            Its rows, and its summary.
        """
        if read.batch is None:
            part = nothing(self.sources[0].framed, self.schema, self.setting.columns)
        else:
            part = scored(*read.batch, self.setting, best=best, progress=progress)
        table = part_table(part, any(source.massive for source in self.sources))
        return table, Summary.of(part, self.setting.top)

    def write(self, read: "Read", table: pa.Table, summary: Summary) -> None:
        """Writes a part.

        Raises:
            OSError: It cannot be written.
        """
        self.parts.write(read.number, table, summary, [str(error) for error in read.errors])


@dataclass(frozen=True, kw_only=True)
class Read:
    """What was read of a part."""

    number: int
    """Of the part."""
    batch: tuple[Candidates, pa.Table] | None
    """Candidates without columns, and a table of these; None where there are none."""
    errors: list[FileError]
    """Why some of it could not be read."""


def run_job(
    job: Job,
    *,
    skipped: Skipped | None = None,
    progress: Callable[[int], None] | None = None,
    look: Callable[[Candidates], None] | None = None,
) -> Summary:
    """Does all parts of a run that are not there yet, each read while the one before it is solved.

    Args:
        job: The run.
        skipped: Told of what could not be read.
        progress: Called after each tile with the number of candidates done.
        look: Called with the candidates of each part that was read.

    Returns:
        The summary of all parts.

    Raises:
        FileError: A file cannot be read.
        OSError: A part cannot be written; those before it are there.
    """
    report, tell = progress or (lambda _: None), skipped or (lambda _: None)
    done, found = 0, Summary.of(nothing(job.sources[0].framed, job.schema, job.setting.columns), job.setting.top)
    with _Steps(job) as steps:
        for number, read in steps.in_order():
            rows = sum(segment.stop - segment.start for segment in job.plan[number])
            if isinstance(read, Read):
                if look is not None and read.batch is not None:
                    look(read.batch[0])
                table, summary = job.score(read, found.known_best(), lambda n, done=done: report(done + n))
                steps.write(read, table, summary)
                errors: Sequence[object] = read.errors
            else:
                summary, errors = read
            for error in errors:
                tell(error if isinstance(error, Exception) else ValueError(error))
            found = Summary.merged([found, summary], job.setting.top)
            done += rows
            report(done)
    return found


def write_top(job: Job, summary: Summary) -> tuple[Ranking, Path]:
    """Finds the tightening forces of a run's best and writes them.

    Args:
        job: The run.
        summary: Of all its parts.

    Returns:
        The ranking of the best, and the file.

    Raises:
        OSError: It cannot be written.
    """
    ranking, path = summary.ranking(job.setting), job.folder / TOP
    table = top_table(ranking, summary.best.travelling)
    with atomic_write(path) as stream, parquet_writer(stream, table.schema) as writer:
        writer.write_table(table)
    return ranking, path


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keeps other processes from working on the same run.

    Raises:
        BlockingIOError: One is at work on it.
    """
    with claimed(folder / ".lock"):
        yield


class _Steps:
    """Reads the next part and writes the last one, each in a thread of its own, while the caller solves."""

    def __init__(self, job: Job):
        self._job, self._reader = job, job.reader()
        self._pools = ThreadPoolExecutor(1, "reader"), ThreadPoolExecutor(1, "writer")
        self._writing: Future[None] | None = None

    def __enter__(self) -> "_Steps":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        reading, writing = self._pools
        reading.shutdown(cancel_futures=True)
        self._reader.close()
        # What is solved is worth the time that writing takes, also where nothing follows.
        writing.shutdown()
        if kind is None and self._writing is not None:
            self._writing.result()

    def in_order(self) -> "Iterator[tuple[int, Read | tuple[Summary, list[str]]]]":
        """What was read of each part; of those that are there, what they left."""
        count = len(self._job.plan)
        ahead = self._submit(0, self._next, 0) if count else None
        for number in range(count):
            assert ahead is not None
            found = ahead.result()
            ahead = self._submit(0, self._next, number + 1) if number + 1 < count else None
            yield number, found

    def write(self, read: Read, table: pa.Table, summary: Summary) -> None:
        """Begins to write a part, once the one before it is written."""
        if self._writing is not None:
            self._writing.result()
        self._writing = self._submit(1, self._job.write, read, table, summary)

    def _next(self, number: int) -> "Read | tuple[Summary, list[str]]":
        return self._job.parts.finished(number) or self._job.read(self._reader, number)

    def _submit(self, pool: int, call: Callable[..., Any], *arguments: Any) -> Future[Any]:
        # Threads do not know the caller's limits by themselves.
        return self._pools[pool].submit(contextvars.copy_context().run, call, *arguments)
