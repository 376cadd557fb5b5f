"""The figure of a comparison of metrics: rank correlations, and ROC curves where the outcome is known."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgrasp.ranking import MetricComparison


def figure_of_comparison(comparison: MetricComparison, *, outcome: str = "success") -> Figure:
    """Draws the matrix of rank correlations, ROC curves, and areas under them with their intervals.

    Args:
        comparison: What to draw.
        outcome: What a success is called.

    Returns:
        The figure; `write_figure` writes it.
    """
    count, prediction = len(comparison.names), comparison.prediction
    side = max(4.5, 0.55 * count + 2.5)
    if prediction is None:
        figure = Figure(figsize=(side + 0.5, side), layout="constrained", dpi=150)
        _draw_correlation(figure.subplots(), comparison)
        return figure
    figure = Figure(figsize=(2 * side + 2.5, side), layout="constrained", dpi=150)
    matrix, right = figure.subfigures(1, 2, width_ratios=(side, side + 2.5), squeeze=False).flat
    _draw_correlation(matrix.subplots(), comparison)
    curves, areas = right.subplots(1, 2, width_ratios=(1.25, 1))
    colours = colormaps["tab20"](np.arange(count) % 20)
    for number, (name, curve) in enumerate(zip(comparison.names, prediction.curves, strict=True)):
        curves.plot(*curve.T, color=colours[number], linewidth=1.4, label=name)
    curves.plot([0, 1], [0, 1], color="0.7", linewidth=0.8)
    curves.set(xlabel="share of the failures kept", ylabel="share of the successes kept", xlim=(0, 1), ylim=(0, 1.01))
    curves.set_aspect("equal")
    curves.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, fontsize=7, frameon=False)
    good = int(prediction.success.sum())
    curves.set_title(f"ROC: {outcome}, {good:,} of {len(prediction.success):,}", fontsize=10)
    places = np.arange(count)[::-1]
    errors = np.abs(prediction.interval - prediction.auc[:, None]).T
    areas.errorbar(prediction.auc, places, xerr=errors, fmt="none", ecolor="0.4", capsize=2)
    areas.scatter(prediction.auc, places, c=colours, zorder=3)
    areas.axvline(0.5, color="0.7", linewidth=0.8)
    areas.set_yticks(places, comparison.names, fontsize=8)
    areas.set(xlabel="area under the curve, 95 % interval")
    areas.set_title("0.5: no better than chance", fontsize=10)
    for axes in (curves, areas):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_correlation(axes: Axes, comparison: MetricComparison) -> None:
    count = len(comparison.names)
    axes.imshow(comparison.correlation, cmap="RdBu", vmin=-1, vmax=1)
    for row, column in np.ndindex(count, count):
        value = comparison.correlation[row, column]
        text = f"{value:z.2f}" if np.isfinite(value) else "-"
        colour = "white" if abs(value) > 0.7 else "black"
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
    axes.set_xticks(range(count), comparison.names, rotation=90, fontsize=8)
    axes.set_yticks(range(count), comparison.names, fontsize=8)
    axes.set_title("Spearman's rank correlation, all turned so that larger is better", fontsize=10)
