"""The figure of a ranking: how the margins are distributed, and what the best grasps look like."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, FigureBase
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxgrasp.ranking import Ranking
from jaxgrasp.ranking.sketch import NOTHING, Sketch
from jaxgrasp.ranking.uncertain import P_HOLD
from jaxgrasp.solvers.status import Status
from jaxgrasp.storage import atomic_write
from jaxgrasp.viewer.grasp import CONTACT_COLOURS, common_scale, draw_grasp
from jaxgrasp.viewer.held import Held

_SURFACE_POINTS = 1500
_DOTS = 5000


def figure_of_ranking(
    ranking: Ranking,
    *,
    unit: str = "N",
    loaded: bool = False,
    grasps: int = 4,
    held: Callable[[int], Held] | None = None,
    sketch: Sketch | None = None,
) -> Figure:
    """Draws the distribution of the margins and the best grasps with their tightening forces.

    With an uncertainty there is a panel of the probability to hold over the margin.

    Where the candidates have a column `object_name`, the contacts of all candidates on the same object are drawn as
    dots that hint at its surface.

    Args:
        ranking: The ranking.
        unit: Unit of the margin: "N" where the disturbances are forces of 1 N.
        loaded: Whether a weight along -z was to be borne; it is then drawn.
        grasps: How many of the best that have forces to draw, at most.
        held: The hand and the object of a candidate, by its number: they are then drawn around its contacts, and the
            hand's links are named.
        sketch: The distribution of all margins where the ranking is of the best alone.

    Returns:
        The figure; `savefig` writes it.
    """
    shown = np.flatnonzero(np.isfinite(ranking.effort))[:grasps].tolist()
    figure = Figure(figsize=(13.0, 7.6) if shown else (5.0, 6.0), layout=ConstrainedLayoutEngine(hspace=0.06), dpi=150)
    if not shown:
        _draw_left(figure, ranking, unit, sketch)
        return figure
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.9), squeeze=False).flat
    _draw_left(left, ranking, unit, sketch)
    columns = min(len(shown), 2)
    present = [ranking.candidates.active[row] for row in ranking.order[shown]]
    scale = common_scale(
        [ranking.candidates.positions[row][there] for row, there in zip(ranking.order[shown], present, strict=True)],
        [ranking.object_forces[place][there] for place, there in zip(shown, present, strict=True)],
    )
    for number, place in enumerate(shown, start=1):
        # Added one by one: matplotlib cannot lay out a 3D panel that is there and not visible.
        panel = right.add_subplot(-(-len(shown) // columns), columns, number, projection="3d", proj_type="ortho")
        _draw_panel(panel, ranking, place, unit, scale, loaded, held and held(int(ranking.order[place])))
    right.legend(handles=_legend(loaded, scale), loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return figure


def write_figure(figure: Figure, path: Path | str) -> None:
    """Writes a figure, in place of an older file only once it is whole.

    Args:
        figure: The figure.
        path: The file; its ending says the format (png, svg, pdf ...).

    Raises:
        ValueError: The ending says no format that matplotlib knows.
        OSError: The file cannot be written.
    """
    path = Path(path)
    with atomic_write(path) as stream:
        figure.savefig(stream, format=path.suffix.removeprefix("."))


def _draw_left(figure: FigureBase, ranking: Ranking, unit: str, sketch: Sketch | None) -> None:
    if P_HOLD not in ranking.metrics:
        _draw_distribution(figure.subplots(2, 1, height_ratios=(3, 1)), ranking, unit, sketch)
        return
    histogram, certainty, counts = figure.subplots(3, 1, height_ratios=(3, 2, 1))
    _draw_distribution(np.array([histogram, counts]), ranking, unit, sketch)
    _draw_certainty(certainty, ranking, unit)


def _draw_certainty(axes: Axes, ranking: Ranking, unit: str) -> None:
    """Draws how probably candidates hold over their margins."""
    known = np.flatnonzero(np.isfinite(ranking.margin) & np.isfinite(ranking.metrics[P_HOLD]))
    # Of so many dots more tell nothing.
    some = known[:: max(1, len(known) // _DOTS)]
    best = np.intersect1d(ranking.order[: len(ranking.forces)], known)
    for rows, colour, size in ((some, "#4477aa", 4), (best, "#cc3311", 14)):
        axes.scatter(ranking.margin[rows], ranking.metrics[P_HOLD][rows], s=size, color=colour, linewidths=0)
    axes.set(xlabel=f"robustness margin $\\lambda$ [{unit}]", ylabel="P(hold)", ylim=(-0.05, 1.05))
    axes.set_title("How probably candidates hold", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_distribution(axes: np.ndarray, ranking: Ranking, unit: str, sketch: Sketch | None) -> None:
    histogram, counts = axes
    if sketch is None:
        positive = ranking.margin[(ranking.status == Status.SOLVED) & (ranking.margin > NOTHING)]
        weights, median = np.ones(len(positive)), np.median(positive) if len(positive) else np.nan
        sketch = Sketch.of(ranking.margin, ranking.status)
    else:
        filled = np.flatnonzero(sketch.margins)
        positive, weights = np.sqrt(sketch.edges[filled] * sketch.edges[filled + 1]), sketch.margins[filled]
        median = sketch.median
    if len(positive):
        bins = min(60, max(10, int(sketch.positive**0.5)))
        histogram.hist(positive, bins=bins, weights=weights, color="#4477aa", linewidth=0)
        best = ranking.margin[ranking.order[: len(ranking.forces)]]
        best = best[np.isfinite(best)]
        if len(best):
            label = "the best one" if len(best) == 1 else f"the best {len(best)}"
            histogram.plot(best, np.zeros(len(best)), "|", color="#cc3311", markersize=14, label=label)
        histogram.axvline(median, color="0.2", linewidth=1.0, linestyle="--", label="median")
        histogram.legend(frameon=False, fontsize=8)
        histogram.set_xlim(left=0.0)
    else:
        histogram.text(0.5, 0.5, "no candidate resists\nevery disturbance", ha="center", transform=histogram.transAxes)
    histogram.set(xlabel=f"robustness margin $\\lambda$ [{unit}]", ylabel="candidates")
    histogram.set_title("Candidates with a positive margin", fontsize=10)
    _draw_counts(counts, {name: count for name, count in _outcomes(sketch).items() if count})
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)


def _outcomes(sketch: Sketch) -> dict[str, int]:
    solved = int(sketch.statuses[Status.SOLVED])
    outcomes = {"margin > 0": sketch.positive, "margin 0": solved - sketch.positive}
    others = [status for status in Status if status != Status.SOLVED]
    return outcomes | {status.name.lower().replace("_", " "): int(sketch.statuses[status]) for status in others}


def _draw_counts(axes: Axes, counts: dict[str, int]) -> None:
    names = list(counts)[::-1]
    bars = axes.barh(names, [counts[name] for name in names], color="#4477aa", height=0.6)
    axes.bar_label(bars, labels=[f"{counts[name]:,}" for name in names], padding=3, fontsize=8)
    axes.set(xlabel="candidates", xlim=(0.0, 1.25 * max(counts.values())))
    axes.set_title("All candidates by outcome", fontsize=10)
    axes.locator_params(axis="x", nbins=4)
    axes.tick_params(labelsize=8)


def _draw_panel(
    panel: Any, ranking: Ranking, place: int, unit: str, scale: float, loaded: bool, held: Held | None
) -> None:
    candidates, row = ranking.candidates, ranking.order[place]
    draw_grasp(
        panel,
        candidates.positions[row],
        candidates.normals[row],
        ranking.object_forces[place],
        friction=candidates.friction[row],
        active=candidates.active[row],
        load=np.array([0.0, 0.0, -1.0]) if loaded else None,
        surface=_surface(ranking, row),
        held=held,
        scale=scale,
    )
    source = Path(candidates.sources[candidates.source[row]]).stem
    name = candidates.columns["object_name"][row] if "object_name" in candidates.columns else source
    margin = f"{ranking.margin[row]:z.3g}" if np.isfinite(ranking.margin[row]) else r"\infty"
    title = f"#{place + 1}: {name}, candidate {candidates.index[row]}\n$\\lambda = {margin}$ {unit}"
    panel.set_title(title, fontsize=9, y=1.02)


def _surface(ranking: Ranking, row: int) -> np.ndarray | None:
    candidates = ranking.candidates
    if "object_name" not in candidates.columns:
        return None
    same = candidates.columns["object_name"] == candidates.columns["object_name"][row]
    rows = np.flatnonzero(same)[: _SURFACE_POINTS // candidates.num_contacts]
    points = candidates.positions[rows][candidates.active[rows]]
    return points[np.isfinite(points).all(axis=-1)]


def _legend(loaded: bool, scale: float) -> list[Line2D | Patch]:
    colour = CONTACT_COLOURS[0]
    length = f", 1 mm = {scale:.2g} N" if np.isfinite(scale) else ""
    handles: list[Line2D | Patch] = [
        Line2D(
            [],
            [],
            color=colour,
            marker=">",
            linewidth=2.0,
            label=f"tightening force on the object{length}",
        ),
        Patch(facecolor=(*to_rgb(colour), 0.15), edgecolor=colour, label="friction cone"),
        Line2D([], [], color="0.25", linestyle=(0, (3, 2)), label="outward normal"),
        Line2D([], [], color="black", marker="+", linestyle="none", label="centre of mass"),
    ]
    if loaded:
        handles.append(Line2D([], [], color="black", marker=">", linewidth=2.0, label="weight"))
    return handles
