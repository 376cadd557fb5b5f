"""`jaxgrasp rank` of more candidates than one table is for: part by part into a folder, and on from there."""

import importlib.metadata
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import Skipped, conclude, write_files
from jaxgrasp.cli.clusters import cluster_of
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.metrics import metric_names
from jaxgrasp.cli.rank_options import FIGURE, OUTPUT, InParts, RankOptions
from jaxgrasp.cli.streams import notice, printing
from jaxgrasp.storage import allowance, made_folder, reason_of

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.cli.report import Clock
    from jaxgrasp.disturbance import DisturbanceSet
    from jaxgrasp.ranking import Uncertain
    from jaxgrasp.ranking.streams.folder import Manifest
    from jaxgrasp.ranking.streams.run import Job
    from jaxgrasp.ranking.streams.scored import Setting, Summary
    from jaxgrasp.ranking.streams.sources import Source

R = TypeVar("R", bound=RankOptions)

MOST_IN_A_TABLE = 2_000_000
"""The most candidates in one table; of more the result is a folder."""
# Options that a run has from its beginning on.
_OPTIONS = ("friction", "max_force", "gravity", "disturbances", "cone_edges", "share", "top", "prune", "metric")
_OF_UNCERTAINTY = ("uncertainty", "by", "load", "quantile", "draws")
# The part that is read, that which is solved and that which is written are in memory at once, and copies of each.
_SHARES = 8
_TOLD = 3


class GivenFiles:
    """The files on the command line, by what they declare."""

    def __init__(
        self,
        setting: "Setting",
        sources: "Sequence[Source]",
        skipped: Skipped,
        keep_going: bool,
        files: Sequence[str],
    ):
        """Takes what is asked, what the files declare, who is told of those that are passed over, and their names."""
        self.setting, self.sources, self.skipped, self.keep_going = setting, tuple(sources), skipped, keep_going
        self.files = files
        self.rows = sum(source.rows for source in sources)

    @classmethod
    def of(
        cls,
        command: RankOptions,
        disturbances: "DisturbanceSet",
        names: Sequence[str],
        uncertain: "Uncertain | None",
        skipped: Skipped,
    ) -> "GivenFiles":
        """Looks at the files of a command.

        Raises:
            FileError: One cannot be used.
        """
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.ranking.streams.inputs import names_of, sources_of
        from jaxgrasp.ranking.streams.scored import Setting

        own = {name: getattr(command, name) for name in _OPTIONS if name not in ("disturbances", "metric")}
        setting = Setting(disturbances=disturbances, metrics=tuple(names), uncertain=uncertain, **own)
        going = command.of_hand.keep_going
        files = names_of(command.files)
        with counting_bar("looking at files", len(files)) as progress:
            sources = sources_of(files, setting.given, skipped if going else None, progress)
        if not sources:
            raise CommandError(f"{', '.join(command.files)}: none of {len(files):,} files can be used")
        return cls(setting, sources, skipped, going, files)

    def folder(self, command: RankOptions) -> Path | None:
        """The folder that the ranking goes to; None where it is a table.

        Raises:
            CommandError: There must be one, and none is named.
        """
        named = command.in_parts.folder
        if named is not None or self.rows <= MOST_IN_A_TABLE:
            return named
        if command.output is None:
            raise CommandError(
                f"{', '.join(command.files)}: got {self.rows:,} candidates; wanted --run FOLDER for more than "
                f"{MOST_IN_A_TABLE:,}"
            )
        folder = command.output.with_suffix("")
        notice(f"{self.rows:,} candidates: the result is a folder, {folder}")
        return folder

    def candidates(self) -> "Candidates":
        """All of them, in memory.

        Raises:
            FileError: A file cannot be used.
        """
        from jaxgrasp.candidates import read_candidates
        from jaxgrasp.candidates.arrow import columns_of_table
        from jaxgrasp.ranking.streams.plan import PartReader, parts_of, schema_of
        from jaxgrasp.ranking.streams.sources import is_url

        if not self.keep_going and all(s.kind == "npz" and not s.keys and not is_url(s.path) for s in self.sources):
            return read_candidates(self.files, **vars(self.setting.given))
        size = sum(source.rows * source.row_size for source in self.sources)
        if size > allowance():
            raise CommandError(f"{self.rows:,} candidates: take {size / 2**30:.3g} GiB; wanted --run FOLDER")
        schema = schema_of(self.sources)
        reader = PartReader(self.sources, schema, self.setting.given)
        (everything,) = parts_of(self.sources, self.rows, size)
        found = reader.read(everything, self.skipped if self.keep_going else None)
        reader.close()
        if found is None:
            raise CommandError("none of the files can be read")
        candidates, travelling = found
        columns = columns_of_table(travelling)
        left_out = [name for name in travelling.column_names if name not in columns]
        if left_out:
            notice(f"columns that are no numbers, truth values or text are left out: {', '.join(left_out)}")
        return replace(candidates, columns=columns)


def as_begun(command: R) -> R:
    """The command with the files and options that the run of --resume began with, where it has none of its own.

    Raises:
        CommandError: The folder has no run.
    """
    from jaxgrasp.ranking.streams.folder import Manifest
    from jaxgrasp.storage import FileError

    assert command.in_parts.resume is not None
    try:
        manifest = Manifest.read(command.in_parts.resume)
    except FileError as error:
        raise CommandError(f"--resume: {error}") from error
    plain = {field.name: field.default for field in fields(command)}
    own = {
        name: manifest.options[name]
        for name in _OPTIONS + _OF_UNCERTAINTY
        if name in manifest.options and getattr(command, name) == plain[name]
    }
    if "metric" in own:
        own["metric"] = tuple(own["metric"])
    in_parts = command.in_parts
    if in_parts.part_size == InParts.part_size:
        in_parts = replace(in_parts, part_size=manifest.options.get("part_size", in_parts.part_size))
    files = command.files or tuple(str(given["path"]) for given in manifest.inputs)
    found = replace(command, files=files, in_parts=in_parts, **own)
    _refuse(command.in_parts.resume, manifest.other_options(_version(), _options(found)))
    return found


def _options(command: RankOptions) -> dict[str, Any]:
    """The options of a run, as its manifest has them."""
    from jaxgrasp.ranking.streams.sources import absolute, digest_of

    options: dict[str, Any] = {name: getattr(command, name) for name in _OPTIONS}
    options |= {"metric": metric_names(command.metric), "part_size": command.in_parts.part_size}
    if Path(command.disturbances).is_file():
        options |= {"disturbances": absolute(command.disturbances), "wrenches": digest_of(command.disturbances)}
    if command.uncertainty is not None:
        options |= {name: getattr(command, name) for name in _OF_UNCERTAINTY}
        options |= {"uncertainty": absolute(command.uncertainty), "distributions": digest_of(command.uncertainty)}
    return options


def _refuse(folder: Path, difference: str) -> None:
    if difference:
        raise CommandError(f"--resume {folder}: {difference}; wanted the same, or a new folder by --run")


def rank_in_parts(command: RankOptions, folder: Path, given: GivenFiles, unit: str, clock: "Clock") -> int:
    """Ranks into a folder, and prints.

    Args:
        command: The options.
        folder: Where to.
        given: The files.
        unit: Unit of the margin.
        clock: Runs since the files were looked at.

    Returns:
        The exit code: 0, or 2 where a file was passed over.

    Raises:
        CommandError: The folder cannot be used, or the work came to no good end.
    """
    from jaxgrasp.ranking.streams.run import held

    try:
        with made_folder(folder):
            # A process that was killed at once leaves no more than hidden files.
            there = [path for path in folder.iterdir() if not path.name.startswith(".")]
            if command.in_parts.resume is None and there:
                got = "the folder of a run" if (folder / "manifest.json").exists() else "a folder with files in it"
                raise CommandError(f"{folder}: got {got}; wanted a new one, or --resume {folder}")
            with held(folder):
                job = _job(command, folder, given)
                _rank(command, job, given, unit, clock)
    except (OSError, ValueError) as error:
        hint = f"; jaxgrasp rank --resume {folder} goes on" if (folder / "manifest.json").exists() else ""
        what = "cannot be used" if isinstance(error, BlockingIOError) else "cannot be written"
        line = f"{folder}: {what} ({reason_of(error)})" if isinstance(error, OSError) else str(error)
        raise CommandError(line + hint) from error
    return given.skipped.exit_code()


def _job(command: RankOptions, folder: Path, given: GivenFiles) -> "Job":
    """The job to do: that of a new run, or of one that goes on.

    Raises:
        CommandError: The run began with other options or files.
    """
    from jaxgrasp.ranking.streams.folder import Manifest
    from jaxgrasp.ranking.streams.run import Job

    if command.in_parts.resume is None:
        manifest = Manifest.new(_version(), _options(command), allowance() // _SHARES, given.sources)
        manifest.write(folder)
        signals.note_written(folder / "manifest.json")
    else:
        manifest = Manifest.read(folder)
        _refuse(folder, manifest.other_inputs(given.sources))
    return Job(
        folder=folder,
        run=manifest.run,
        sources=_named_as_begun(given.sources, manifest),
        setting=given.setting,
        part_rows=manifest.options["part_size"],
        part_size=manifest.part_bytes,
        keep_going=given.keep_going,
    )


def _rank(command: RankOptions, job: "Job", given: GivenFiles, unit: str, clock: "Clock") -> None:
    from jaxgrasp.cli.report import print_ranking, progress_bar, stoppable_bar
    from jaxgrasp.ranking.streams.run import run_job, write_top
    from jaxgrasp.ranking.streams.sorting import write_sorted
    from jaxgrasp.viewer import figure_of_ranking, write_figure

    look = _Conventions()
    clock.lap()
    try:
        with progress_bar(job.rows, clock) as progress:
            if command.in_parts.ray is None:
                summary = run_job(job, skipped=given.skipped, progress=progress, look=look)
            else:
                summary = _on_ray(command, job, given, progress)
    except KeyboardInterrupt as reason:
        done = clock.ticks[-1][1] if clock.ticks else 0
        line = f"{signals.word()}: ranked {done:,} of {job.rows:,}; jaxgrasp rank --resume {_shown(command)} goes on"
        raise CommandError(line, 130) from reason
    except (RuntimeError, MemoryError) as reason:
        line = f"{str(reason) or type(reason).__name__}; jaxgrasp rank --resume {_shown(command)} goes on"
        raise CommandError(" ".join(line.split()), 1) from reason
    look.tell()
    clock.lap()
    ranking, path = write_top(job, summary)
    written, folder = [path], job.folder
    if command.in_parts.sorted:
        with stoppable_bar("sorting", summary.sketch.count) as progress:
            written.append(write_sorted(job, progress))
        signals.note_written(written[-1])
    figure = folder / FIGURE if command.figure == FIGURE else command.figure
    drawn, unwritten = write_files(
        (
            figure,
            lambda path: write_figure(
                figure_of_ranking(ranking, unit=unit, loaded=bool(command.gravity), sketch=summary.sketch), path
            ),
        ),
    )
    missing = job.rows - summary.sketch.count
    if missing:
        notice(f"{missing:,} of {job.rows:,} candidates could not be read")
    with printing():
        print_ranking(ranking, summary.sketch, unit, clock, (), [folder / "parts", *written, *drawn])
    conclude("", unwritten)


def _on_ray(command: RankOptions, job: "Job", given: GivenFiles, progress: Callable[[int], None]) -> "Summary":
    """Ranks on a cluster.

    Raises:
        CommandError: There is no such cluster.
    """
    from jaxgrasp.ranking.streams.on_ray import on_all_nodes, run_on_ray

    assert command.in_parts.ray is not None
    with cluster_of(command.in_parts.ray, command.in_parts.ray_workers) as cluster:
        return run_on_ray(on_all_nodes(job), cluster, budget=allowance(), skipped=given.skipped, progress=progress)


class _Conventions:
    """Looks for units and directions that can hardly be meant in every part, and tells of a few files."""

    def __init__(self) -> None:
        self._doubts: dict[str, None] = {}

    def __call__(self, candidates: "Candidates") -> None:
        from jaxgrasp.candidates import doubtful_conventions

        self._doubts |= dict.fromkeys(doubtful_conventions(candidates))

    def tell(self) -> None:
        lines = list(self._doubts)
        if lines:
            more = f" | and {len(lines) - _TOLD:,} more" if len(lines) > _TOLD else ""
            notice(f"warning: {' | '.join(lines[:_TOLD])}{more}")


def _named_as_begun(sources: "Sequence[Source]", manifest: "Manifest") -> "tuple[Source, ...]":
    """The files by the names that the run's tables have already."""
    return tuple(replace(source, name=before["name"]) for source, before in zip(sources, manifest.inputs, strict=True))


def _shown(command: RankOptions) -> Path | str:
    return command.in_parts.folder or (command.output or OUTPUT).with_suffix("")


def _version() -> str:
    try:
        return importlib.metadata.version("jaxgrasp")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
