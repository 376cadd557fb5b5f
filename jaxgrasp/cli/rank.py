"""`jaxgrasp rank`: files of candidates in, a table and a figure out."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import Skipped, check_options, check_output, conclude, warn_of_conventions, write_files
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.metrics import metric_names, scores_of
from jaxgrasp.cli.rank_in_parts import GivenFiles, as_begun, rank_in_parts
from jaxgrasp.cli.rank_options import RankOptions
from jaxgrasp.cli.setting import FIGURE_ENDINGS, configure_jax, named_disturbances
from jaxgrasp.cli.streams import notice, printing
from jaxgrasp.cli.uncertain import uncertain_columns, uncertain_of

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.cli.report import Clock
    from jaxgrasp.disturbance import DisturbanceSet
    from jaxgrasp.hands import HandObject
    from jaxgrasp.ranking import Ranking


@dataclass(frozen=True, kw_only=True)
class Rank(RankOptions):
    """Rank candidate grasps by the largest disturbance that they resist.

    Reads .npz files with positions (N, n_c, 3), in m about the centre of mass, and outward_normals (N, n_c, 3) or
    frames (N, n_c, 3, 3), and where present friction, max_force, mass, center_of_mass and active; other columns travel
    along into the table. Without a file it ranks 10,000 grasps that it samples on a built-in object. With --scene, or
    with --hand, --object and --grasps, the candidates are configurations of a hand.
    """

    def run(self) -> int:
        """Ranks, writes and prints.

        Returns:
            The exit code: 0, or 2 where a file was passed over.

        Raises:
            CommandError: The options or the files cannot be used, or the work came to no good end: 130 after Ctrl-C, 1
                after an error of the computation, 2 where a file could not be written in the end.
        """
        return (as_begun(self) if self.in_parts.resume else self)._answer()

    def _answer(self) -> int:
        names = metric_names(self.metric)
        self._check()
        configure_jax()
        from jaxgrasp.candidates import CandidateError
        from jaxgrasp.cli.report import Clock

        clock = Clock()
        hands: list[HandObject] = []
        skipped = Skipped()
        try:
            disturbances, unit = named_disturbances(self.disturbances)
            uncertain = uncertain_of(self)
            if self.of_hand.given:
                candidates, hands = self.of_hand.candidates(self.friction, self.max_force, skipped)
            elif self.files:
                given = GivenFiles.of(self, disturbances, names, uncertain, skipped)
                folder = given.folder(self)
                if folder is not None:
                    return rank_in_parts(self, folder, given, unit, clock)
                candidates = given.candidates()
            else:
                candidates = self.sampled()
        except CandidateError as error:
            raise CommandError(str(error)) from error
        if not self.of_hand.given:
            warn_of_conventions(candidates)
        clock.lap()
        task: dict[str, Any] = {"gravity": self.gravity, "cone_edges": self.cone_edges}
        metrics = uncertain_columns(candidates, uncertain, disturbances, **task)
        metrics |= scores_of(candidates, names, disturbances, **task)
        clock.lap("metrics" if metrics else "")
        self._rank(candidates, disturbances, unit, hands, metrics, clock)
        return skipped.exit_code()

    def _check(self) -> None:
        from jaxgrasp.ranking import TABLE_ENDINGS

        self.check_candidates()
        check_options(
            ("--top", self.top, self.top >= 0, "a number >= 0"),
            ("--explain", self.explain, self.explain >= 0, "a number >= 0"),
        )
        if self.prune and self.metric:
            raise CommandError("--prune: got --metric, too; wanted a ranking by the margin alone")
        self.of_hand.check()
        if self.of_hand.given and (self.files or self.gravity):
            what = "files of contacts" if self.files else "--gravity"
            option = "--scene" if self.of_hand.scene else "--hand"
            raise CommandError(f"{option}: got {what}, too; wanted the scene's own contacts and gravity alone")
        inputs = [
            *map(Path, self.files),
            Path(self.disturbances),
            Path(self.uncertainty or ""),
            Path(self.of_hand.name),
            self.of_hand.qpos or Path(),
            *self.of_hand.grasps,
        ]
        self.in_parts.check(self)
        for option, path, endings in (
            ("--output", None if self.in_parts.folder else self.output, TABLE_ENDINGS),
            ("--figure", self.in_parts.figure(self.figure), FIGURE_ENDINGS),
            ("--picture", self.of_hand.picture if self.of_hand.given else None, FIGURE_ENDINGS),
        ):
            if path is not None:
                check_output(path, option, endings, inputs)

    def _rank(
        self,
        candidates: "Candidates",
        disturbances: "DisturbanceSet",
        unit: str,
        hands: "list[HandObject]",
        metrics: dict[str, np.ndarray],
        clock: "Clock",
    ) -> None:
        from jaxgrasp.cli.report import print_ranking, progress_bar
        from jaxgrasp.ranking import RankingInterrupted, rank
        from jaxgrasp.ranking.sketch import Sketch

        code, complaint = 0, ""
        try:
            with progress_bar(len(candidates), clock) as progress:
                ranking = rank(
                    candidates,
                    disturbances,
                    gravity=self.gravity,
                    cone_edges=self.cone_edges,
                    share=self.share,
                    top=self.top,
                    prune=self.prune,
                    metrics=metrics,
                    progress=progress,
                )
        except RankingInterrupted as interruption:
            ranking, reason = interruption.ranking, interruption.__cause__
            code = 130 if isinstance(reason, KeyboardInterrupt) else 1
            what = signals.word() if code == 130 else str(reason) or type(reason).__name__
            complaint = f"{what}: ranked {len(ranking.margin):,} of {len(candidates):,}"
            if len(ranking.margin) == 0:
                raise CommandError(complaint, code) from interruption
        clock.lap()
        written, unwritten = self._write(ranking, unit, hands)
        zeros = self._why_zero(ranking, disturbances)
        explained = self._explained(ranking, disturbances)
        with printing():
            print_ranking(ranking, Sketch.of(ranking.margin, ranking.status), unit, clock, zeros, written)
            for line in explained:
                print(line)
        conclude(complaint, unwritten, code)

    def _why_zero(self, ranking: "Ranking", disturbances: "DisturbanceSet") -> list[str]:
        from jaxgrasp.explanation import is_zero, why_zero
        from jaxgrasp.ranking.tiles import columns_of, contacts_of

        return why_zero(
            lambda rows: contacts_of(columns_of(ranking.candidates.take(rows))),
            is_zero(ranking.margin, ranking.status),
            disturbances,
            cone_edges=self.cone_edges,
        )

    def _explained(self, ranking: "Ranking", disturbances: "DisturbanceSet") -> list[str]:
        from jaxgrasp.explanation import explain
        from jaxgrasp.ranking.tiles import columns_of, contacts_of, task_of

        best = ranking.order[: self.explain]
        if not len(best):
            return []
        candidates = ranking.candidates.take(best)
        columns = columns_of(candidates)
        found = explain(contacts_of(columns), disturbances, **task_of(columns, self.gravity, self.cone_edges))
        names = [
            f"{Path(candidates.sources[s]).name}:{i}" for s, i in zip(candidates.source, candidates.index, strict=True)
        ]
        return [f"{name}: {'. '.join(found.words(row))}" for row, name in enumerate(names)]

    def _write(self, ranking: "Ranking", unit: str, hands: "list[HandObject]") -> tuple[list[Path], list[str]]:
        from jaxgrasp.ranking import write_table
        from jaxgrasp.viewer import figure_of_ranking, write_figure

        def write_picture(path: Path) -> None:
            held = self.of_hand.held(hands, ranking) if hands else None
            write_figure(figure_of_ranking(ranking, unit=unit, loaded=bool(self.gravity), held=held), path)

        written, unwritten = write_files(
            (self.output, lambda path: write_table(ranking, path)), (self.figure, write_picture)
        )
        if hands and np.isfinite(ranking.effort).any():
            # Many machines have nothing to render with: that is told, and no failure.
            drawn, undrawn = write_files(
                (self.of_hand.picture, lambda path: self.of_hand.draw(hands, ranking, unit, path))
            )
            written += drawn
            for line in undrawn:
                notice(line)
        return written, unwritten
