"""The options of `jaxgrasp rank`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxgrasp.cli.candidate_options import CandidateOptions
from jaxgrasp.cli.checks import check_options
from jaxgrasp.cli.clusters import check_ray
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.scene import Scene

OUTPUT, FIGURE = Path("ranking.parquet"), Path("ranking.png")
"""What is written where nothing else is said."""


@dataclass(frozen=True, kw_only=True)
class InParts:
    """How more candidates than memory holds are ranked."""

    run: Path | None = None
    """A new folder to rank into part by part, in bounded memory: tables of all candidates in the order of the files,
    the best with their forces, and the figure. More than 2,000,000 candidates always get one, named like --output."""

    resume: Path | None = None
    """The folder of a run that was interrupted, to go on with; files and options are those that it began with."""

    sorted: bool = False
    """With a folder: write all candidates once more, the best first."""

    ray: str | None = None
    """With a folder that all nodes see: rank on a cluster of Ray, by its ADDRESS, or "local" for one of this machine's
    own. Needs the extra ray."""

    ray_workers: int | None = None
    """With --ray: processes at work; None is one a GPU, and without GPUs one a processor."""

    part_size: int = 131_072
    """With a folder: candidates a part, at most."""

    @property
    def folder(self) -> Path | None:
        """The folder that is named."""
        return self.run or self.resume

    def check(self, command: "RankOptions") -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        check_options(("--part-size", self.part_size, self.part_size >= 1, "at least 1"))
        if self.ray_workers is not None:
            check_options(("--ray-workers", self.ray_workers, self.ray_workers >= 1, "at least 1"))
        check_ray(self.ray)
        if self.folder is None:
            if self.ray is not None or self.sorted:
                option = "--ray" if self.ray is not None else "--sorted"
                raise CommandError(f"{option}: got neither --run nor --resume; wanted a folder")
            return
        option = "--run" if self.run else "--resume"
        if self.run and self.resume:
            raise CommandError("--run: got --resume, too; wanted one of them")
        if command.explain:
            raise CommandError(f"--explain: got {option}, too; wanted a ranking in one table")
        if command.of_hand.given or not command.files:
            raise CommandError(f"{option}: got no files of candidates; wanted some, and no hand")
        if command.output not in (OUTPUT, None):
            raise CommandError(f"{option}: got --output, too; wanted a folder alone")

    def figure(self, figure: Path | None) -> Path | None:
        """The figure to write outside the folder."""
        return None if self.folder is not None and figure == FIGURE else figure


@dataclass(frozen=True, kw_only=True)
class RankOptions(CandidateOptions):
    """What is ranked, and how."""

    files: tyro.conf.Positional[tuple[str, ...]] = ()
    """Files of candidates, .npz, Parquet or Arrow, folders and patterns of these, or URLs such as s3://bucket/folder;
    none for the built-in object."""

    top: int = 10
    """How many of the best get tightening forces."""

    explain: int = 0
    """Tell of this many of the best what ends their margin, which disturbance they stand least, and what would help."""

    prune: bool = False
    """Give up grasps that cannot be among the best --top as soon as their bounds tell: the best are the same, sooner;
    of the others the table has bounds."""

    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Other metrics to have in the table, NAME[,NAME...]; the first one ranks. A wrong name is answered with all
    names."""

    uncertainty: str | None = None
    """A FILE, .json or .npz, of how friction, contacts, masses and loads are distributed: docs/uncertainty.md. It adds
    columns, and --by says which of them ranks."""

    by: Literal["p_hold", "quantile", "tail_mean"] = "p_hold"
    """With --uncertainty, what ranks: p_hold, the probability that the margin is at least --load; the --quantile of the
    margin; or tail_mean, the mean margin of the worst --quantile of the draws."""

    load: float = 1.0
    """With --uncertainty, the margin that p_hold asks for."""

    quantile: float = 0.1
    """With --uncertainty, the level of the column margin_quantile, and the share of draws behind margin_tail_mean."""

    draws: int | None = None
    """With --uncertainty, how many draws a grasp gets; None is 1,000, or as many as the file gives."""

    output: Path | None = OUTPUT
    """The table to write, .parquet, .csv or .npz; None for no table."""

    figure: Path | None = FIGURE
    """The figure to write, .png, .svg or .pdf; None for no figure."""

    in_parts: Annotated[InParts, tyro.conf.arg(name="")] = field(default_factory=InParts)

    of_hand: Annotated[Scene, tyro.conf.arg(name="")] = field(default_factory=Scene)
