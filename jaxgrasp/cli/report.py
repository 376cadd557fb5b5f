"""What the subcommands print: progress, tables, how fast it went and what was written."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from jaxgrasp.cli import signals
from jaxgrasp.ranking import MetricComparison, Ranking
from jaxgrasp.ranking.sketch import Sketch
from jaxgrasp.solvers.status import Status

if TYPE_CHECKING:
    from jaxgrasp.synthesis import HandSynthesis, Record, Synthesis

_ROWS = 20
_TEXT_COLUMNS = 2
_PLAIN_WIDTH = 160
# What bars say until the first batch is done.
_COMPILING = "compiling, which is kept for the next run"


class Clock:
    """Times all work on candidates, and apart from it the tiles of margins after the first, which mostly compiles."""

    def __init__(self) -> None:
        """Starts."""
        self.start = self.end = time.perf_counter()
        self.parts: dict[str, float] = {}
        self.ticks: list[tuple[float, int]] = []

    def tick(self, done: int) -> None:
        """Notes that so many candidates are done, once."""
        if not self.ticks or done > self.ticks[-1][1]:
            self.ticks.append((time.perf_counter(), done))

    def lap(self, what: str = "") -> None:
        """Ends the time so far; what was done since the last lap is told apart where it has a name."""
        now = time.perf_counter()
        if what:
            self.parts[what] = now - self.end
        self.end = now

    def __str__(self) -> str:
        """Returns how long it took and, where more than one tile was solved, how many a second after the first."""
        (first, before), (last, done) = self.ticks[0], self.ticks[-1]
        text = f"{done:,} candidates in {self.end - self.start:.1f} s, compilation included"
        text += "".join(f", {seconds:.1f} s of them for {what}" for what, seconds in self.parts.items())
        if len(self.ticks) > 1:
            text += f"; margins: {(done - before) / (last - first):,.0f} a second once compiled"
        return text


@contextlib.contextmanager
def progress_bar(total: int, clock: Clock) -> Iterator[Callable[[int], None]]:
    """Shows a bar on standard error where that is a terminal.

    Args:
        total: How many candidates there are.
        clock: Ticks with the bar.

    Yields:
        What to call with the number of candidates done.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(_COMPILING, total=total)

        def show(done: int) -> None:
            signals.checkpoint()
            clock.tick(done)
            progress.update(task, completed=done, description="ranking" if done < total else "tightening")

        yield show


@contextlib.contextmanager
def counting_bar(what: str, total: int) -> Iterator[Callable[..., None]]:
    """Shows a bar on standard error where that is a terminal.

    Args:
        what: What is being done.
        total: How often.

    Yields:
        What to call with how often it was done, and with the total where that has become known.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done, total=None: progress.update(task, completed=done, total=total)


@contextlib.contextmanager
def stoppable_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """The same for work of which Ctrl-C leaves what is done.

    Args:
        what: What is being done.
        total: How often.

    Yields:
        What to call often with how often it was done.
    """
    with counting_bar(what, total) as progress:

        def show(done: int) -> None:
            if done:
                signals.checkpoint()
            progress(done)

        yield show


@contextlib.contextmanager
def ascent_bar(steps: int) -> "Iterator[Callable[[int, Record], None]]":
    """Shows a bar on standard error where that is a terminal, with the median and the best margin so far.

    Args:
        steps: How many steps there are.

    Yields:
        What to call with the number of steps done and the record.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(_COMPILING, total=steps)

        def show(done: int, record: "Record") -> None:
            signals.checkpoint()
            text = f"margin: median {record.median[-1]:z.3g}, best {record.best[-1]:z.3g}"
            progress.update(task, completed=done, description=text)

        yield show


@contextlib.contextmanager
def hand_bar(starts: int, steps: int) -> Iterator[Callable[[int, int, dict[str, np.ndarray]], None]]:
    """Shows a bar on standard error where that is a terminal, with the energy's terms in the median.

    Args:
        starts: How many starts there are.
        steps: Of each.

    Yields:
        What to call with the numbers of steps done and to be done, over all batches of starts, and the record.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(_COMPILING, total=steps)

        def show(done: int, total: int, record: dict[str, np.ndarray]) -> None:
            signals.checkpoint()
            middle = ", ".join(f"{name} {rows[-1, rows.shape[1] // 2]:.2f}" for name, rows in record.items())
            text = middle.replace("_", "-") if done < total else f"closing fingers and judging {starts:,} grasps"
            progress.update(task, completed=done, total=total, description=text)

        yield show


def print_hand_synthesis(found: "HandSynthesis", kept: int, name: str, unit: str, written: Sequence[Path]) -> None:
    """Prints what a synthesis with a hand found to standard output.

    Args:
        found: The grasps.
        kept: How many of them were to be written.
        name: What the hand and the object are called.
        unit: Unit of the margin.
        written: The files that were written.
    """
    from jaxgrasp.synthesis import Verdict

    console = Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH, highlight=False)
    verdicts = [
        verdict for verdict in Verdict if (found.verdict == verdict).any() or (found.first_verdict == verdict).any()
    ]
    table = Table(title=f"{len(found.margin):,} grasps of {escape(name)}")
    quantiles = [f"margin of good ones [{unit}]: median", "best"]
    for column in ("", *(verdict.name.lower().replace("_", " ") for verdict in verdicts), *quantiles):
        table.add_column(escape(column), justify="right" if column else "left")
    for label, verdict, margin in (
        ("random starts, closed", found.first_verdict, found.first_margin),
        ("synthesised", found.verdict, found.margin),
    ):
        good = margin[verdict == Verdict.GOOD]
        shares = [f"{(verdict == each).mean():.1%}" for each in verdicts]
        table.add_row(label, *shares, *([f"{np.median(good):z.4g}", f"{good.max():z.4g}"] if len(good) else ["", ""]))
    console.print(table)
    if written:
        console.print(f"written: {', '.join(map(str, written))} ({kept:,} grasps)", markup=False)


def print_synthesis(
    found: "Synthesis", name: str, note: str, unit: str, why_zero: Sequence[str], written: Sequence[Path]
) -> None:
    """Prints what a synthesis found to standard output.

    Args:
        found: The grasps.
        name: The object's name.
        note: What else is to be said of the object; empty for nothing.
        unit: Unit of the margin.
        why_zero: Why margins are zero, of `explanation.why_zero`.
        written: The files that were written.
    """
    console = Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH, highlight=False)
    if note:
        console.print(f"{name}: {note}", markup=False)
    table = Table(title=f"{len(found.margin):,} grasps of {escape(name)} with {found.positions.shape[1]} contacts")
    for column in (f"margin [{unit}]", "lowest tenth", "median", "best", "above zero"):
        table.add_column(escape(column), justify="left" if "margin" in column else "right")
    for label, margin in (("random starts", found.first_margin), ("synthesised", found.margin)):
        known = np.nan_to_num(margin, nan=0.0)
        low, middle, best = np.quantile(known, (0.1, 0.5, 1.0))
        table.add_row(label, f"{low:z.4g}", f"{middle:z.4g}", f"{best:z.4g}", f"{(known > 1e-4).mean():.1%}")
    console.print(table)
    unverified = int((found.status == Status.NOT_VERIFIED).sum())
    if unverified:
        console.print(f"{unverified:,} not confirmed by the audit")
    _print_zeros(console, "synthesised with a margin of zero", why_zero)
    if written:
        console.print("written: " + ", ".join(map(str, written)), markup=False)


def print_ranking(
    ranking: Ranking, sketch: Sketch, unit: str, clock: Clock, why_zero: Sequence[str], written: Sequence[Path]
) -> None:
    """Prints a ranking to standard output.

    Args:
        ranking: The ranking, or that of the best alone.
        sketch: Of all candidates.
        unit: Unit of the margin.
        clock: How long it took.
        why_zero: Why margins are zero, of `explanation.why_zero`.
        written: The files that were written.
    """
    # Without a terminal rich would assume 80 columns and cut names short.
    width = _PLAIN_WIDTH + 26 * len(ranking.metrics)
    console = Console(width=None if sys.stdout.isatty() else width, highlight=False)
    rows = min(len(ranking.forces), _ROWS)
    if rows:
        console.print(_table(ranking, sketch.count, rows, unit))
    if rows < len(ranking.forces):
        console.print(f"... and {len(ranking.forces) - rows} more with forces")
    unanswered = int((ranking.tightening_status != Status.SOLVED).sum())
    if unanswered:
        console.print(f"no tightening forces for {unanswered} of the best {len(ranking.forces)}")
    console.print(_counts(sketch))
    _print_zeros(console, "a margin of zero", why_zero)
    for name, value in list(ranking.metrics.items())[:1]:
        if len(value) == sketch.count > 1 and (value == value[0]).all():
            console.print(f"{name}: {value[0]:z.4g} for all, which leaves them in the order of the files", markup=False)
    console.print(str(clock))
    if written:
        console.print("written: " + ", ".join(map(str, written)), markup=False)


def print_comparison(found: MetricComparison, outcome: str, count: int, written: Sequence[Path]) -> None:
    """Prints a comparison of metrics to standard output.

    Args:
        found: The comparison.
        outcome: What a success is called.
        count: How many grasps there are.
        written: The files that were written.
    """
    console = Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH + 8 * len(found.names), highlight=False)
    prediction = found.prediction
    table = Table(title=f"{len(found.names)} metrics on {count:,} grasps; Spearman's rank correlation by number")
    columns = ["answered"]
    if prediction:
        columns += [f"AUC of {outcome}", "95 %", f"{found.names[0]} leads by", "95 %"]
    for name in ("#", "metric", *columns, *map(str, range(1, len(found.names) + 1))):
        table.add_column(escape(name), justify="left" if name == "metric" else "right")
    for row, name in enumerate(found.names):
        cells = [f"{found.answered[row]:,}"]
        if prediction:
            (low, high), (lead, least, most) = prediction.interval[row], prediction.lead[row]
            cells += [f"{prediction.auc[row]:.3f}", f"{low:.3f} .. {high:.3f}"]
            cells += [f"{lead:+z.3f}", f"{least:+z.3f} .. {most:+z.3f}"] if row else ["", ""]
        table.add_row(str(row + 1), escape(name), *cells, *(f"{value:z.2f}" for value in found.correlation[row]))
    console.print(table)
    if not prediction:
        console.print("no column of success: no ROC curves")
    if written:
        console.print("written: " + ", ".join(map(str, written)), markup=False)


def _print_zeros(console: Console, what: str, why_zero: Sequence[str]) -> None:
    if why_zero:
        console.print(f"{what}: {'; '.join(why_zero)}", markup=False, soft_wrap=True)


def _table(ranking: Ranking, count: int, rows: int, unit: str) -> Table:
    candidates = ranking.candidates
    texts = [name for name, column in candidates.columns.items() if column.dtype.kind == "U" and column.ndim == 1]
    by = f" by {next(iter(ranking.metrics))}" if ranking.metrics else ""
    title = f"The best {rows} of {count:,}{by}; forces for {ranking.share:.0%} of the margin"
    table = Table(title=title)
    texts = texts[:_TEXT_COLUMNS]
    others = [name for name in ranking.metrics if name != "margin"]
    numbers = (f"margin [{unit}]", "upper bound", "largest normal force [N]", "effort [N²]", *others)
    # Named as in the table that is written.
    given = [f"input_{name}" if name == "status" else name for name in texts]
    for name in ("rank", "grasp", *given, *others, *numbers[:2], "status", *numbers[2:4]):
        justify, overflow = "right" if name == "rank" or name in numbers else "left", "fold" if name in others else None
        table.add_column(escape(name), justify=justify, overflow=overflow or "ellipsis")
    for place, row in enumerate(ranking.order[:rows]):
        source = Path(candidates.sources[candidates.source[row]]).name
        normal = -np.where(candidates.active[row], ranking.forces[place, :, 2], 0.0).min()
        table.add_row(
            str(place + 1),
            escape(f"{source}:{candidates.index[row]}"),
            *(escape(str(candidates.columns[name][row])) for name in texts),
            *(f"{ranking.metrics[name][row]:z.4g}" for name in others),
            f"{ranking.margin[row]:z.4g}",
            f"{ranking.upper_bound[row]:z.4g}",
            Status(int(ranking.status[row])).name,
            f"{normal:z.4g}",
            f"{ranking.effort[place]:z.4g}",
        )
    return table


def _counts(sketch: Sketch) -> str:
    parts = {status: f"{sketch.statuses[status]:,} {status.name}" for status in Status}
    parts[Status.SOLVED] += f" ({sketch.positive:,} with a margin above zero)"
    if sketch.statuses[Status.MAX_ITERATIONS]:
        parts[Status.MAX_ITERATIONS] += " (undecided, their margins are lower bounds)"
    return ", ".join(parts.values())
