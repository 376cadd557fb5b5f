"""`jaxgrasp compare`: how metrics agree on the grasps of a file, and with their success."""

import csv
import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from jaxgrasp.cli.checks import Skipped, check_output, conclude, warn_of_conventions, write_files
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.metrics import metric_names, scores_of
from jaxgrasp.cli.scene import ComparedScene
from jaxgrasp.cli.setting import FIGURE_ENDINGS, Reading, configure_jax, named_disturbances
from jaxgrasp.cli.streams import printing
from jaxgrasp.storage import atomic_write

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.ranking import MetricComparison

DEFAULT = (
    "margin",
    "ferrari_canny_bound",
    "ferrari_canny_linf_bound",
    "min_weight",
    "task_wrench",
    "smallest_singular_value",
    "isotropy",
    "closure_residual",
)


@dataclass(frozen=True, kw_only=True)
class Compare(Reading):
    """Compare metrics on the same grasps: how alike they rank them, and how well they predict success.

    Reads the files that `jaxgrasp rank` reads, or takes a hand, an object and grasps as `rank` does, computes metrics,
    and writes a table and a figure of Spearman's rank correlations. Where the files have a column that says which
    grasps succeeded, ROC curves and the areas under them come along, with 95 % bootstrap intervals. A grasp without an
    answer counts as the worst.
    """

    files: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Files of candidates, .npz; none with a hand."""

    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Metrics to compare, NAME[,NAME...]; all that take batches without any. A wrong name is answered with all
    names."""

    columns: tuple[str, ...] = ()
    """Columns of the files that are metrics, too; larger ones count as better."""

    success: str | None = None
    """The column that says which grasps succeeded, of booleans or of 0 and 1. None takes a boolean one whose name has
    "succ" in it, where there is one."""

    within: str | None = None
    """A column of labels, object_name for example: areas then count only pairs of grasps with the same label, so that
    it does not matter which objects are the easy ones."""

    friction: float | None = None
    """Coulomb's friction coefficient for files without any."""

    max_force: float | None = None
    """Largest normal force for files without any, N."""

    gravity: float = 0.0
    """Gravity along the object's -z, m/s^2, under which the margin must bear the masses; other metrics know no load."""

    disturbances: str = "forces"
    """As for rank: forces, ball, box or a FILE of wrenches; of the margin and task_wrench."""

    cone_edges: int = 8
    """Edges of the friction pyramid."""

    resamples: int = 1000
    """Bootstrap resamples that the intervals are made of."""

    seed: int = 0
    """Of the resamples."""

    output: Path | None = Path("comparison.csv")
    """The table to write, .csv; None for none."""

    figure: Path | None = Path("comparison.png")
    """The figure to write, .png, .svg or .pdf; None for no figure."""

    of_hand: Annotated[ComparedScene, tyro.conf.arg(name="")] = field(default_factory=ComparedScene)

    def run(self) -> int:
        """Computes, writes and prints.

        Returns:
            The exit code: 0, or 2 where a file was passed over.

        Raises:
            CommandError: The options or the files cannot be used, or a file could not be written in the end.
        """
        names = metric_names(self.metric) or [
            name for name in DEFAULT if name != "task_wrench" or self.disturbances not in ("ball", "box")
        ]
        self._check()
        configure_jax()
        from jaxgrasp.candidates import CandidateError, read_candidates
        from jaxgrasp.cli.report import print_comparison
        from jaxgrasp.metrics import METRICS
        from jaxgrasp.ranking import compare_metrics
        from jaxgrasp.viewer import figure_of_comparison, write_figure

        try:
            disturbances, _ = named_disturbances(self.disturbances)
            skipped = Skipped()
            if self.of_hand.given:
                candidates, _ = self.of_hand.candidates(self.friction, self.max_force, skipped)
            else:
                candidates = read_candidates(
                    self.files, friction=self.friction, max_force=self.max_force, with_mass=self.gravity != 0.0
                )
        except CandidateError as error:
            raise CommandError(str(error)) from error
        if not self.of_hand.given:
            warn_of_conventions(candidates)
        outcome, success = self._success(candidates)
        stored = {name: self._column(candidates, name, "--columns", "biuf").astype(float) for name in self.columns}
        within = self._column(candidates, self.within, "--within", "biufU") if self.within else None
        values = scores_of(candidates, names, disturbances, gravity=self.gravity, cone_edges=self.cone_edges)
        values |= {f"{name} (file)" if name in METRICS else name: value for name, value in stored.items()}
        smaller = frozenset(name for name in names if not METRICS[name].larger_is_better)
        try:
            found = compare_metrics(
                values, success, smaller_is_better=smaller, within=within, resamples=self.resamples, seed=self.seed
            )
        except ValueError as error:
            raise CommandError(str(error)) from error

        written, unwritten = write_files(
            (self.output, lambda path: _write_table(found, path)),
            (self.figure, lambda path: write_figure(figure_of_comparison(found, outcome=outcome), path)),
        )
        with printing():
            print_comparison(found, outcome, len(candidates), written)
        conclude("", unwritten)
        return skipped.exit_code()

    def _check(self) -> None:
        checks = [
            ("--friction", self.friction, self.friction is None or 0.0 <= self.friction < math.inf, "a number >= 0"),
            ("--max-force", self.max_force, self.max_force is None or 0.0 < self.max_force < math.inf, "newtons > 0"),
            ("--gravity", self.gravity, math.isfinite(self.gravity), "a finite number of m/s^2"),
            ("--cone-edges", self.cone_edges, self.cone_edges >= 3, "at least 3"),
            ("--resamples", self.resamples, self.resamples >= 1, "at least 1"),
            ("--seed", self.seed, self.seed >= 0, "a number >= 0"),
            ("FILES", "none", bool(self.files) or self.of_hand.given, "at least one file of candidates, or a hand"),
        ]
        for option, value, admissible, wanted in checks:
            if not admissible:
                raise CommandError(f"{option}: got {value}; wanted {wanted}")
        self.of_hand.check()
        if self.of_hand.given and (self.files or self.gravity):
            raise CommandError("--hand or --scene: got FILES or --gravity, too; wanted the scene's own alone")
        inputs = [*self.files, Path(self.disturbances), Path(self.of_hand.name), *self.of_hand.grasps]
        for option, path, endings in (("--output", self.output, (".csv",)), ("--figure", self.figure, FIGURE_ENDINGS)):
            if path is not None:
                check_output(path, option, endings, inputs)

    def _success(self, candidates: "Candidates") -> tuple[str, np.ndarray | None]:
        name = self.success
        if name is None:
            fitting = [
                key
                for key, column in candidates.columns.items()
                if "succ" in key and column.dtype == bool and column.ndim == 1
            ]
            if not fitting:
                return "success", None
            name = fitting[0]
        column = self._column(candidates, name, "--success", "biuf")
        if not np.isin(column, (0, 1)).all():
            raise CommandError(f"--success {name}: got other values than 0 and 1; wanted a column of booleans")
        return name, column.astype(bool)

    def _column(self, candidates: "Candidates", name: str, option: str, kinds: str) -> np.ndarray:
        column = candidates.columns.get(name)
        if column is None or column.ndim != 1 or column.dtype.kind not in kinds:
            fitting = [k for k, c in candidates.columns.items() if c.ndim == 1 and c.dtype.kind in kinds]
            there = ", ".join(fitting) or "the files have none"
            raise CommandError(f"{option} {name}: got no such column with one value a grasp; wanted one of: {there}")
        return column


def _write_table(found: "MetricComparison", path: Path) -> None:
    prediction = found.prediction
    areas = ["auc", "auc_low", "auc_high", "first_minus_this", "difference_low", "difference_high"]
    lines = io.StringIO(newline="")
    table = csv.writer(lines)
    table.writerow(["metric", "answered", *(areas if prediction else []), *found.names])
    for row, name in enumerate(found.names):
        predicted = []
        if prediction:
            predicted = [prediction.auc[row], *prediction.interval[row], *prediction.lead[row]]
        table.writerow([name, found.answered[row], *predicted, *found.correlation[row]])
    with atomic_write(path) as stream:
        stream.write(lines.getvalue().encode("utf-8", "backslashreplace"))
