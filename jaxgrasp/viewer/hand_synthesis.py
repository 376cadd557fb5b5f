"""The figure of a synthesis with a hand: how the energy fell, and what became of the starts."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from jaxgrasp.synthesis import HandSynthesis

_COLOURS = {"distance": "#4477aa", "penetration": "#cc3311", "self_penetration": "#ee9933", "margin": "#228833"}
_LABELS = {
    "distance": "distance of the links",
    "penetration": "penetration of hand and object",
    "self_penetration": "penetration of the hand with itself",
    "margin": "margin, which counts against the others",
}


def figure_of_hand_synthesis(found: "HandSynthesis", *, name: str = "", unit: str = "N") -> Figure:
    """Draws the terms of the energy over the steps, the verdicts and the margins before and after.

    Args:
        found: The synthesis.
        name: What the hand and the object are called.
        unit: Unit of the margin.

    Returns:
        The figure; `write_figure` writes it.
    """
    figure = Figure(figsize=(13.0, 4.2), layout="constrained", dpi=150)
    descent, verdicts, margins = figure.subplots(1, 3, width_ratios=(1.25, 1.0, 1.0))
    _draw_descent(descent, found)
    _draw_verdicts(verdicts, found)
    _draw_margins(margins, found, unit)
    for axes in (descent, verdicts, margins):
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{len(found.margin):,} grasps of {name}" if name else f"{len(found.margin):,} grasps", fontsize=11)
    return figure


def _draw_descent(axes: Axes, found: "HandSynthesis") -> None:
    for term, quantiles in found.record.items():
        low, middle, high = quantiles.T
        steps = np.arange(len(middle))
        axes.plot(steps, middle, color=_COLOURS[term], label=_LABELS[term])
        axes.fill_between(steps, low, high, color=_COLOURS[term], alpha=0.15, linewidth=0)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.set(xlabel="step", ylabel="weighted terms of the energy")
    axes.set_title("Median and 10 % to 90 % of all starts", fontsize=10)
    axes.legend(frameon=False, fontsize=8)


def _draw_verdicts(axes: Axes, found: "HandSynthesis") -> None:
    from jaxgrasp.synthesis import Verdict

    names = [verdict.name.lower().replace("_", " ") for verdict in Verdict]
    place = np.arange(len(names))
    for shift, verdict, colour, label in (
        (-0.2, found.first_verdict, "0.75", "random starts, closed"),
        (0.2, found.verdict, "#4477aa", "synthesised"),
    ):
        shares = np.array([(verdict == each).mean() for each in Verdict])
        bars = axes.barh(place + shift, 100 * shares, height=0.4, color=colour, label=label)
        axes.bar_label(bars, [f"{100 * share:.0f}" if share else "" for share in shares], fontsize=8, padding=2)
    axes.set_yticks(place, names)
    axes.invert_yaxis()
    axes.set(xlabel="% of the starts", xlim=(0, 108))
    axes.set_title("What became of them", fontsize=10)
    axes.legend(frameon=False, fontsize=8, loc="lower right")


def _draw_margins(axes: Axes, found: "HandSynthesis", unit: str) -> None:
    after = found.margin[found.good]
    before = found.first_margin[found.first_good]
    edges = np.linspace(0.0, max(*after, *before, 1e-9), 31)
    axes.hist(before, bins=edges, color="0.75", label="random starts, closed")
    axes.hist(after, bins=edges, color="#4477aa", alpha=0.8, label="synthesised")
    axes.set(xlabel=f"robustness margin $\\lambda$ [{unit}]", ylabel="good grasps")
    axes.set_title("Margins that the actuators can produce", fontsize=10)
    axes.legend(frameon=False, fontsize=8)
