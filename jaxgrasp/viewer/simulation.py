"""Figures of simulated hands that are pushed, like figures 3 to 5 of the paper."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxgrasp.viewer.grasp import CONTACT_COLOURS

if TYPE_CHECKING:
    from jaxgrasp.simulation import Run

# mm; what is farther away was lost, and is shown no further.
_FARTHEST = 12.0
# s; forces of contacts that open and close every few milliseconds are shown by their mean over this time.
_MEAN = 0.01
# Of a dashed line, in its widths.
_DASH = 1.8


def figure_of_pushes(runs: "Mapping[str, Run]", labels: Sequence[str]) -> Figure:
    """How far each push moves the object, and how hard the weakest finger still presses; one column a run.

    Objects that are lost are shown until they are 12 mm from their place, with a cross there.

    Args:
        runs: By title; all with the same lanes.
        labels: Of the lanes.
    """
    figure = Figure(figsize=(4.0 * len(runs) + 0.9, 5.2), layout="constrained", dpi=150)
    panels = figure.subplots(2, len(runs), sharex=True, sharey="row", squeeze=False)
    lanes = range(len(labels))
    for column, (title, run) in enumerate(runs.items()):
        away, near = 1e3 * run.error[0], _near(run)
        pressing = _smooth(run.normal_force, run.time)
        weakest = np.where(run.engaged, pressing, np.inf).min(-1)
        for axes, values in zip(panels[:, column], (away, weakest), strict=True):
            for lane in lanes:
                shown, colour = np.where(near[:, lane], values[:, lane], np.nan), f"C{lane}"
                axes.plot(run.time, shown, lw=1.2, color=colour)
                # Dashes that take turns: one sees every lane also where several go the same way.
                turns = (_DASH * lane, (_DASH, _DASH * (len(labels) - 1)))
                axes.plot(run.time, shown, lw=2.0, color=colour, ls=turns, zorder=3, dash_capstyle="butt")
            _mark(axes, run)
        for lane in np.flatnonzero(~near.all(0)):
            last = np.argmin(near[:, lane])
            panels[0, column].plot(run.time[last], _FARTHEST, "x", color=f"C{lane}", ms=8, mew=2, clip_on=False)
        panels[0, column].set_title(f"{title}: {int((~run.lost).sum())} of {len(run.lost)} held", fontsize=10)
        panels[1, column].set_xlabel("s")
    panels[0, 0].set(ylabel="object off its place, mm", ylim=(0, _FARTHEST))
    panels[1, 0].set(ylabel=f"weakest finger presses, N\n(mean over {1e3 * _MEAN:.0f} ms)", ylim=(0, None))
    handles = [Line2D([], [], lw=2.4, color=f"C{lane}", label=labels[lane]) for lane in lanes]
    figure.legend(handles=handles, loc="outside right center", fontsize=8, title="push along", title_fontsize=8)
    return figure


def figure_of_motions(runs: "Mapping[str, Run]", labels: Sequence[str]) -> Figure:
    """The object's path and the normal forces of all fingers in the first lane; one column a run.

    Objects that are lost are shown until they are 12 mm from where they should be.

    Args:
        runs: By title; all with the same lanes.
        labels: Of the lanes.
    """
    figure = Figure(figsize=(3.9 * len(runs) + 1.6, 8.4), layout="constrained", dpi=150)
    panels = figure.subplots(4, len(runs), sharex=True, sharey="row", squeeze=False)
    for column, (title, run) in enumerate(runs.items()):
        near = _near(run)
        for coordinate, axes in enumerate(panels[:3, column]):
            for lane, (label, width) in enumerate(zip(labels, np.linspace(2.6, 1.2, len(labels)), strict=True)):
                values = np.where(near[:, lane], 1e3 * run.position[:, lane, coordinate], np.nan)
                axes.plot(run.time, values, lw=width, color=f"C{lane}", label=label)
            axes.plot(run.time, 1e3 * run.wanted[:, 0, coordinate], "k:", lw=1.4, label="desired")
        pressing = np.where(near[:, :1], run.normal_force[:, 0], np.nan)
        for finger, colour in enumerate(CONTACT_COLOURS[: pressing.shape[-1]]):
            width = 2.6 - 0.5 * finger
            panels[3, column].plot(run.time, pressing[:, finger], lw=width, color=colour, label=str(finger + 1))
        for axes in panels[:, column]:
            _mark(axes, run)
        panels[0, column].set_title(title, fontsize=10)
        panels[3, column].set_xlabel("s")
    for axes, label in zip(panels[:, 0], ("x, mm", "y, mm", "z, mm", f"fingers press, N ({labels[0]})"), strict=True):
        axes.set_ylabel(label)
    panels[3, 0].set_ylim(0, None)
    panels[0, -1].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    panels[3, -1].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1.0), title="finger", title_fontsize=8)
    return figure


def _near(run: "Run") -> Bool[np.ndarray, "steps lanes"]:
    """Until the object is too far from where it should be."""
    return np.logical_and.accumulate(1e3 * run.error[0] <= _FARTHEST)


def _smooth(
    forces: Float[np.ndarray, "steps lanes contacts"], time: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, "steps lanes contacts"]:
    """The mean over the steps before, over fewer in the beginning."""
    steps = max(1, round(_MEAN / (time[1] - time[0])))
    total = np.concatenate([np.zeros_like(forces[:1]), np.cumsum(forces, 0)])
    begin = np.maximum(np.arange(len(time)) - steps + 1, 0)
    return (total[1:] - total[begin]) / (np.arange(len(time)) + 1 - begin)[:, None, None]


def _mark(axes: Axes, run: "Run") -> None:
    axes.axvspan(run.push.begin, run.push.begin + run.push.duration, color="0.9", zorder=0)
    axes.grid(alpha=0.25)
    axes.tick_params(labelsize=8)
