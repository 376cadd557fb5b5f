"""Figures of simulated hands that are pushed, like figures 3 to 5 of the paper."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgrasp.viewer.grasp import CONTACT_COLOURS

if TYPE_CHECKING:
    from jaxgrasp.simulation import Run

# mm; what is farther away was lost.
_FARTHEST = 12.0


def figure_of_pushes(runs: "Mapping[str, Run]", labels: Sequence[str]) -> Figure:
    """How far each push moves the object, and how hard the weakest finger still presses; one column a run.

    Args:
        runs: By title; all with the same lanes.
        labels: Of the lanes.
    """
    figure = Figure(figsize=(3.4 * len(runs) + 0.6, 5.2), layout="constrained", dpi=150)
    panels = figure.subplots(2, len(runs), sharex=True, sharey="row", squeeze=False)
    for column, (title, run) in enumerate(runs.items()):
        away = 1e3 * run.error[0]
        weakest = np.where(run.engaged, run.normal_force, np.inf).min(-1)
        for axes, values in zip(panels[:, column], (np.minimum(away, _FARTHEST), weakest), strict=True):
            for lane, label in enumerate(labels):
                axes.plot(run.time, values[:, lane], label=label, lw=1.1, color=f"C{lane}", ls=("-", "--")[lane % 2])
            _mark(axes, run)
        panels[0, column].set_title(f"{title}: {int((~run.lost).sum())} of {len(run.lost)} held", fontsize=9)
        panels[1, column].set_xlabel("s")
    panels[0, 0].set(ylabel="object off its place, mm", ylim=(0, _FARTHEST))
    panels[1, 0].set(ylabel="weakest finger presses, N", ylim=(0, None))
    panels[0, -1].legend(fontsize=7, title="push along", title_fontsize=7)
    return figure


def figure_of_motions(runs: "Mapping[str, Run]", labels: Sequence[str]) -> Figure:
    """The object's path and the normal forces of all fingers in the first lane; one column a run.

    Args:
        runs: By title; all with the same lanes.
        labels: Of the lanes.
    """
    figure = Figure(figsize=(4.2 * len(runs) + 0.6, 7.0), layout="constrained", dpi=150)
    panels = figure.subplots(3, len(runs), sharex=True, sharey="row", squeeze=False)
    for column, (title, run) in enumerate(runs.items()):
        for axes, coordinate in zip(panels[:2, column], (0, 1), strict=True):
            axes.plot(run.time, 1e3 * run.wanted[:, 0, coordinate], color="k", lw=2.2, alpha=0.3, label="desired")
            for lane, label in enumerate(labels):
                axes.plot(run.time, 1e3 * run.position[:, lane, coordinate], lw=1.1, color=f"C{lane}", label=label)
        for finger, colour in enumerate(CONTACT_COLOURS[: run.normal_force.shape[-1]]):
            panels[2, column].plot(run.time, run.normal_force[:, 0, finger], lw=1, color=colour, label=str(finger + 1))
        for axes in panels[:, column]:
            _mark(axes, run)
        panels[0, column].set_title(title, fontsize=10)
        panels[2, column].set_xlabel("s")
    for axes, label in zip(panels[:, 0], ("x, mm", "y, mm", f"fingers press, N ({labels[0]})"), strict=True):
        axes.set_ylabel(label)
    panels[2, 0].set_ylim(0, None)
    panels[0, -1].legend(fontsize=8)
    panels[2, -1].legend(fontsize=8, title="finger", ncols=4, title_fontsize=8)
    return figure


def _mark(axes: Axes, run: "Run") -> None:
    axes.axvspan(run.push.begin, run.push.begin + run.push.duration, color="0.9", zorder=0)
    axes.grid(alpha=0.25)
    axes.tick_params(labelsize=8)
