"""The figure of a synthesis: how the margins grew, and what the best grasps look like."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from jaxgrasp.viewer.grasp import common_scale, draw_grasp

if TYPE_CHECKING:
    from jaxgrasp.synthesis import Synthesis


def figure_of_synthesis(
    found: "Synthesis",
    surface: Float[np.ndarray, "points 3"],
    *,
    friction: float,
    name: str = "",
    unit: str = "N",
    grasps: int = 4,
) -> Figure:
    """Draws how the margins grew with the steps, their distribution before and after, and the best grasps.

    Args:
        found: The synthesis.
        surface: Points on the object, m, about the centre of mass.
        friction: Coulomb's coefficient.
        name: The object's name.
        unit: Unit of the margin.
        grasps: How many of the best to draw, at most.

    Returns:
        The figure; `write_figure` writes it.
    """
    figure = Figure(figsize=(13.0, 7.6), layout=ConstrainedLayoutEngine(hspace=0.06), dpi=150)
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.9), squeeze=False).flat
    ascent, histogram = left.subplots(2, 1)
    _draw_ascent(ascent, found, unit)
    _draw_distribution(histogram, found, unit)
    shown = min(grasps, len(found.margin))
    columns = min(shown, 2)
    scale = common_scale(found.positions[:shown], found.forces[:shown])
    for number in range(shown):
        panel = right.add_subplot(-(-shown // columns), columns, number + 1, projection="3d", proj_type="ortho")
        draw_grasp(
            panel,
            found.positions[number],
            found.outward_normals[number],
            found.forces[number],
            friction=np.full(found.positions.shape[1], friction),
            surface=surface,
            scale=scale,
        )
        panel.set_title(f"{name} #{number + 1}: $\\lambda = {found.margin[number]:.3g}$ {unit}", fontsize=9, y=1.02)
    if np.isfinite(scale):
        right.supxlabel(f"arrows: forces of the fingers on the object, 1 mm = {scale:.2g} N", fontsize=8)
    for axes in (ascent, histogram):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_ascent(axes: Axes, found: "Synthesis", unit: str) -> None:
    record = found.record
    steps = np.arange(1, len(record.best) + 1)
    finite = [np.where(np.isfinite(row), row, np.nan) for row in (record.best, record.median, record.lowest_tenth)]
    for row, colour, label in zip(
        finite, ("#cc3311", "#4477aa", "0.5"), ("best", "median", "lowest tenth"), strict=True
    ):
        axes.plot(steps, row, color=colour, label=label)
    axes.axhline(0.0, color="0.8", linewidth=0.8)
    top = np.nanmax(finite[0])
    axes.set(xlabel="step", ylabel=f"best margin so far [{unit}]", ylim=(-0.25 * top, 1.1 * top) if top > 0 else None)
    axes.set_title("Ascent of all starts", fontsize=10)
    axes.legend(frameon=False, fontsize=8, loc="lower right")


def _draw_distribution(axes: Axes, found: "Synthesis", unit: str) -> None:
    before, after = (np.maximum(np.nan_to_num(margin, nan=0.0), 0.0) for margin in (found.first_margin, found.margin))
    edges = np.linspace(0.0, max(float(after.max()), float(before.max()), 1e-9), 41).tolist()
    axes.hist(before, bins=edges, color="0.75", label="random starts")
    axes.hist(after, bins=edges, color="#4477aa", alpha=0.8, label="synthesised")
    axes.set(xlabel=f"robustness margin $\\lambda$ [{unit}]", ylabel="grasps", yscale="log")
    axes.set_title("Before and after", fontsize=10)
    axes.legend(frameon=False, fontsize=8)
