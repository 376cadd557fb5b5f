"""`jaxgrasp evaluate`: grasps tried by a named protocol, a table, a figure and movies out."""

import contextlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import Skipped, check_options, check_output, conclude, write_files
from jaxgrasp.cli.clusters import check_ray, cluster_of
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.metrics import metric_names, scores_of
from jaxgrasp.cli.published import Published, one_line_error
from jaxgrasp.cli.setting import FIGURE_ENDINGS, configure_jax
from jaxgrasp.cli.streams import notice, printing

if TYPE_CHECKING:
    from jaxgrasp.evaluation import Evaluation
    from jaxgrasp.files import GraspSet
    from jaxgrasp.ranking import MetricComparison

# What is told of each load by name.
_TOLD = 5


@dataclass(frozen=True, kw_only=True)
class Evaluate(Published):
    """Try grasps of files in C MuJoCo by a named protocol: approach, squeeze, loads, and does the object stay?

    Reads grasps in any format that is known, tries them on all cores, and writes a table with a row for each in the
    order given, a figure, and movies of some that failed. A simulation that diverges says nothing of its grasp and is
    told apart. See docs/evaluation.md.
    """

    protocol: str = "dexgraspbench-fc"
    """dexgraspbench-fc, jaxgrasp-hold, six-gravities (like DexGraspNet's validator) or six-pulls (like GraspQP's)."""

    show: bool = False
    """Print every parameter of the protocol, and try nothing."""

    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Metrics, NAME[,NAME...], of which the table has values and areas under ROC curves are found. A wrong name is
    answered with all names."""

    columns: tuple[str, ...] = ()
    """Columns of the files that are metrics, too; larger ones count as better. With a minus before the name, smaller
    ones do."""

    max_force: float = 10.0
    """Largest normal force of a contact, N, for metrics."""

    seed: int = 0
    """Seed of the bootstrap for the intervals of areas under ROC curves; the trials have nothing random."""

    workers: int | None = None
    """Number of threads; one for each core without it. With --ray, of processes: one for each processor without it."""

    ray: str | None = None
    """Try on a cluster of Ray whose nodes all see hand and objects, by its ADDRESS, or "local" for one of this
    machine's own. Needs the extra ray."""

    movies: int = 0
    """Number of movies, written beside the table, of the first grasps that failed."""

    output: Path | None = Path("trials.parquet")
    """The table to write, .parquet, .csv or .npz; None for no table."""

    figure: Path | None = Path("trials.png")
    """The figure to write, .png, .svg or .pdf; None for no figure."""

    def run(self) -> int:
        """Tries, writes and prints.

        Returns:
            The exit code: 0, or 2 where a file or an object was passed over.

        Raises:
            CommandError: The options, the files or the hand cannot be used, a file could not be written in the end, or
                Ctrl-C has ended the work early.
        """
        from jaxgrasp.simulation.protocols import protocol_named

        try:
            protocol = protocol_named(self.protocol)
        except ValueError as error:
            raise CommandError(f"--{error}") from error
        if self.show:
            with printing():
                for name, value in protocol.parameters().items():
                    print(f"{name}: {json.dumps(value)}")
            return 0
        names = metric_names(self.metric)
        self._check()
        configure_jax()
        from jaxgrasp.cli.evaluation_report import print_evaluation

        skipped = Skipped()
        grasps = self.grasp_set(skipped)
        self._check_columns(grasps)
        found = self._tried(grasps, skipped)
        scores = self._scores(found, names) if names and len(found) else {}
        compared = self._compared(found, scores)
        written, unwritten = self._write(found, scores, compared)
        with printing():
            print_evaluation(found, compared, written)
        early = f"{signals.word()}: tried {len(found):,} of {len(grasps):,}" if found.interrupted else ""
        conclude(early, unwritten)
        return skipped.exit_code()

    def _check(self) -> None:
        from jaxgrasp.evaluation import TABLE_ENDINGS

        self.check_published()
        check_options(
            ("--max-force", self.max_force, 0.0 < self.max_force < math.inf, "newtons > 0"),
            ("--seed", self.seed, self.seed >= 0, "at least 0"),
            ("--workers", self.workers, self.workers is None or 1 <= self.workers <= 1024, "1 to 1024"),
            ("--movies", self.movies, self.movies >= 0, "at least 0"),
        )
        check_ray(self.ray)
        if self.movies and self.output is None:
            raise CommandError("--movies: got no --output; wanted a table that they are named after")
        for option, path, endings in (
            ("--output", self.output, TABLE_ENDINGS),
            ("--figure", self.figure, FIGURE_ENDINGS),
        ):
            if path is not None:
                check_output(path, option, endings, self.inputs)

    def _check_columns(self, grasps: "GraspSet") -> None:
        for given in self.columns:
            column = grasps.columns.get(given.removeprefix("-"))
            if column is None or column.ndim != 1 or column.dtype.kind not in "biuf":
                fitting = [k for k, c in grasps.columns.items() if c.ndim == 1 and c.dtype.kind in "biuf"]
                there = ", ".join(fitting) or "the files have none"
                raise CommandError(f"--columns {given}: got no such column of numbers; wanted one of: {there}")

    def _tried(self, grasps: "GraspSet", skipped: Skipped) -> "Evaluation":
        from jaxgrasp.cli.report import stoppable_bar

        with one_line_error(self), stoppable_bar("trying grasps", len(grasps)) as progress, self._where() as where:
            found = where(
                grasps,
                hand=self.hand,
                object=self.object,
                protocol=self.protocol,
                servo_gain=self.servo_gain,
                progress=progress,
                skipped=skipped if self.keep_going else None,
            )
        for line in found.said:
            notice(line)
        diverged = np.flatnonzero(found.outcome == "diverged")
        if len(diverged):
            some = ", ".join(found.grasps.source[diverged[:_TOLD]].tolist())
            notice(
                f"the simulations of {len(diverged):,} grasps diverged and say nothing of them: {some}"
                f"{' and others' if len(diverged) > _TOLD else ''}"
            )
        return found

    @contextlib.contextmanager
    def _where(self) -> "Iterator[Callable[..., Evaluation]]":
        """The function that tries grasps, in this process or on a cluster.

        Raises:
            CommandError: There is no such cluster, or it cannot do the work.
        """
        from jaxgrasp.evaluation import evaluate

        if self.ray is None:
            yield partial(evaluate, workers=self.workers)
            return
        from jaxgrasp.evaluation.on_ray import evaluate_on_ray

        try:
            with cluster_of(self.ray, self.workers) as cluster:
                yield partial(evaluate_on_ray, cluster)
        except RuntimeError as error:
            raise CommandError(f"--ray {self.ray}: {' '.join(str(error).split())}", 1) from error

    def _scores(self, found: "Evaluation", names: Sequence[str]) -> dict[str, np.ndarray]:
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.disturbance import DisturbanceSet
        from jaxgrasp.evaluation import candidates_of_grasps

        with one_line_error(self), counting_bar("finding contacts", len(found)) as progress:
            candidates = candidates_of_grasps(
                found.grasps,
                found.protocol,
                hand=self.hand,
                object=self.object,
                servo_gain=self.servo_gain,
                max_force=self.max_force,
                progress=progress,
            )
        return scores_of(candidates, names, DisturbanceSet.forces(1.0), gravity=0.0, cone_edges=8)

    def _compared(self, found: "Evaluation", scores: dict[str, np.ndarray]) -> "MetricComparison | None":
        from jaxgrasp.metrics import METRICS
        from jaxgrasp.ranking import compare_metrics

        values = dict(scores)
        smaller = {name for name in scores if not METRICS[name].larger_is_better}
        for given in self.columns:
            name = given.removeprefix("-")
            label = f"{name} (file)"
            values[label] = found.grasps.columns[name].astype(float)
            smaller |= {label} if given.startswith("-") else set()
        tried = found.tried
        if not values or not len(set(found.held[tried].tolist())) == 2:
            if values:
                notice("no areas under ROC curves: no grasp holds, or all do")
            return None
        values = {name: value[tried] for name, value in values.items()}
        return compare_metrics(values, found.held[tried], smaller_is_better=frozenset(smaller), seed=self.seed)

    def _write(
        self, found: "Evaluation", scores: dict[str, np.ndarray], compared: "MetricComparison | None"
    ) -> tuple[list[Path], list[str]]:
        from jaxgrasp.evaluation import write_evaluation
        from jaxgrasp.viewer import write_figure
        from jaxgrasp.viewer.evaluation import figure_of_evaluation

        if not len(found):
            return [], []
        written, unwritten = write_files(
            (self.output, lambda path: write_evaluation(found, path, scores)),
            (self.figure, lambda path: write_figure(figure_of_evaluation(found, compared), path)),
        )
        if found.interrupted or self.output is None:
            return written, unwritten
        for row in np.flatnonzero(np.isin(found.outcome, ("lost", "diverged")))[: self.movies].tolist():
            path = self.output.with_name(f"{self.output.stem}-{row}.gif")
            # Many machines have nothing to render with: that is told, and no failure.
            filmed, unfilmed = write_files((path, lambda path, row=row: self._film(found, row, path)))
            written += filmed
            for line in unfilmed:
                notice(line)
        return written, unwritten

    def _film(self, found: "Evaluation", row: int, path: Path) -> None:
        from jaxgrasp.evaluation import film
        from jaxgrasp.viewer.movie import write_course_movie

        try:
            scene, frames = film(found, row, hand=self.hand, object=self.object, servo_gain=self.servo_gain)
            title = f"{found.object[row]} {row}: {found.outcome[row]}"
            write_course_movie(path, scene.model, title, frames)
        except (RuntimeError, ValueError) as error:
            raise OSError(str(error)) from error
