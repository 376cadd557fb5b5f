"""Prints the summary of `jaxgrasp evaluate`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxgrasp.evaluation import Evaluation, summaries

if TYPE_CHECKING:
    from jaxgrasp.ranking import MetricComparison, Prediction

_PLAIN_WIDTH = 160
_ROWS = 30


def print_evaluation(found: Evaluation, metrics: "MetricComparison | None", written: Sequence[Path]) -> None:
    """Prints an evaluation to standard output.

    Shares are of what says something: all grasps but those that diverged or are no configurations. Penetration,
    contacts within 2 mm, distance and spread of the fingers are means; the variance is that which the first one, three
    and five principal components of the grasps explain.

    Args:
        found: The evaluation.
        metrics: Metrics of the same grasps; None for none.
        written: The files that were written.
    """
    console = Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH, highlight=False)
    parts = summaries(found)
    table = Table(title=f"{len(found):,} grasps tried by {found.protocol.name}, version {found.protocol.version}")
    numbers = ("grasps", "held", "share", "95 %", "penetration", "self", "contacts", "distance", "spread", "variance")
    for name in ("object", *numbers):
        table.add_column(escape(name), justify="left" if name == "object" else "right")
    for part in [*parts[: _ROWS - 1], parts[-1]] if len(parts) > _ROWS else parts:
        lengths = (part.penetration, part.self_penetration)
        table.add_row(
            escape(part.name),
            f"{part.grasps:,}",
            f"{part.held:,}",
            f"{part.held / part.tried:.1%}" if part.tried else "",
            f"{part.interval[0]:.1%} .. {part.interval[1]:.1%}",
            *(f"{1e3 * value:.2f} mm" for value in lengths),
            f"{part.contact_number:.1f}",
            *(f"{1e3 * value:.2f} mm" for value in (part.contact_distance, part.contact_consistency)),
            ", ".join(f"{value:.2f}" for value in part.diversity[::2]),
        )
    console.print(table)
    whole = parts[-1]
    others = {"not held, for they penetrate": whole.inside, "diverged": whole.diverged, "not usable": whole.unusable}
    if any(others.values()):
        console.print(", ".join(f"{count:,} {name}" for name, count in others.items() if count))
    if len(parts) > 1:
        objects = parts[:-1]
        console.print(f"{sum(part.held > 0 for part in objects):,} of {len(objects):,} objects have a grasp that holds")
    if metrics is not None and metrics.prediction is not None:
        console.print(_areas(metrics.names, metrics.prediction))
    if written:
        console.print("written: " + ", ".join(map(str, written)), markup=False)


def _areas(names: Sequence[str], prediction: "Prediction") -> Table:
    table = Table(title="How well metrics tell what holds")
    for name in ("metric", "AUC", "95 %"):
        table.add_column(name, justify="left" if name == "metric" else "right")
    for name, area, (low, high) in zip(names, prediction.auc, prediction.interval, strict=True):
        table.add_row(escape(name), f"{area:.3f}", f"{low:.3f} .. {high:.3f}")
    return table
