"""The figure of an evaluation: which grasps hold, how far objects went, and how well metrics tell."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgrasp.evaluation import Evaluation, summaries
from jaxgrasp.ranking import MetricComparison, Prediction

_COLOURS = {
    "held": "#228833",
    "lost": "#cc6677",
    "penetration": "#aa3377",
    "diverged": "#bbbbbb",
    "not usable": "#dddddd",
}
_BARS = 12
# mm; what is farther away was lost.
_FARTHEST = 100.0


def figure_of_evaluation(found: Evaluation, metrics: MetricComparison | None = None) -> Figure:
    """Draws shares that hold with their intervals, outcomes, motions and penetration, and areas under ROC curves.

    Args:
        found: The evaluation of at least one grasp.
        metrics: Metrics of the same grasps with their success; None for none.

    Returns:
        The figure; `write_figure` writes it.
    """
    prediction = None if metrics is None else metrics.prediction
    tell = metrics is not None and prediction is not None
    figure = Figure(figsize=(12.5, 6.6 + 2.6 * tell), layout="constrained", dpi=150)
    panels = figure.subplots(2 + tell, 2, height_ratios=[1.0, 1.0] + [0.9] * tell)
    _draw_shares(panels[0, 0], found)
    _draw_outcomes(panels[0, 1], found)
    _draw_motion(panels[1, 0], found)
    _draw_penetration(panels[1, 1], found)
    if metrics is not None and prediction is not None:
        _draw_curves(panels[2, 0], metrics.names, prediction)
        _draw_areas(panels[2, 1], metrics.names, prediction)
    for axes in panels.flat:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    figure.suptitle(f"{found.protocol.name}, version {found.protocol.version}: {len(found):,} grasps", fontsize=11)
    return figure


def _draw_shares(axes: Axes, found: Evaluation) -> None:
    parts = summaries(found)
    if len(parts) > _BARS:
        parts = [*parts[: _BARS - 1], parts[-1]]
    places = np.arange(len(parts))[::-1]
    share = np.array([part.held / part.tried if part.tried else np.nan for part in parts])
    ends = np.array([part.interval for part in parts]).T
    error = np.abs(ends - share).clip(0)
    axes.errorbar(share, places, xerr=error, fmt="o", color="#4477aa", ecolor="0.4", capsize=3)
    axes.set_yticks(places, [f"{part.name}  {part.held} of {part.tried}" for part in parts])
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.7, len(parts) - 0.3), xlabel="share that holds, 95 % interval (Wilson)")
    axes.set_title("Objects" if len(parts) > 1 else "The object", fontsize=10)


def _draw_outcomes(axes: Axes, found: Evaluation) -> None:
    counts = {name: int((found.outcome == name).sum()) for name in _COLOURS}
    counts = {name: count for name, count in counts.items() if count}
    names = list(counts)[::-1]
    bars = axes.barh(names, [counts[name] for name in names], color=[_COLOURS[name] for name in names], height=0.6)
    axes.bar_label(bars, labels=[f"{counts[name]:,}" for name in names], padding=3, fontsize=8)
    axes.set(xlabel="grasps", xlim=(0, 1.15 * max(counts.values())))
    axes.set_title("Outcomes", fontsize=10)


def _draw_motion(axes: Axes, found: Evaluation) -> None:
    known = np.isfinite(found.delta_pos)
    far = 1e3 * np.minimum(found.delta_pos, 1e-3 * _FARTHEST)
    for name in ("held", "lost"):
        rows = known & (found.outcome == name)
        axes.scatter(far[rows], found.delta_angle[rows], s=9, color=_COLOURS[name], label=name, alpha=0.7, linewidths=0)
    course = found.protocol.course
    displacement, rotation = (getattr(course, name, None) for name in ("max_displacement", "max_rotation"))
    if displacement is not None:
        axes.axvline(1e3 * displacement, color="0.5", linewidth=0.8, linestyle="--")
    if rotation is not None:
        axes.axhline(rotation, color="0.5", linewidth=0.8, linestyle="--")
    axes.set(xlabel=f"the object moved, mm ({_FARTHEST:g} and more at the edge)", ylabel="turned, degrees")
    axes.set_title("How far objects went when they were last looked at; limits dashed", fontsize=10)
    if known.any():
        axes.legend(frameon=False, fontsize=8)


def _draw_penetration(axes: Axes, found: Evaluation) -> None:
    depths = {"hand and object": found.penetration, "hand and itself": found.self_penetration}
    values = [1e3 * depth[np.isfinite(depth)] for depth in depths.values()]
    if any(map(len, values)):
        most = max(float(value.max(initial=0)) for value in values)
        edges = np.linspace(0, most if most > 0 else 1.0, 25)
        for (name, value), colour in zip(zip(depths, values, strict=True), ("#4477aa", "#ccbb44"), strict=True):
            label = f"{name}: mean {value.mean() if len(value) else 0:.2g} mm"
            axes.hist(value, bins=edges.tolist(), color=colour, alpha=0.6, label=label)
        axes.legend(frameon=False, fontsize=8)
    axes.set(xlabel="penetration in the grasp, mm", ylabel="grasps")
    axes.set_title("Penetration", fontsize=10)


def _draw_curves(axes: Axes, names: Sequence[str], prediction: Prediction) -> None:
    for number, (name, curve) in enumerate(zip(names, prediction.curves, strict=True)):
        axes.plot(*curve.T, color=f"C{number % 10}", linewidth=1.3, label=name)
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=0.8)
    axes.set(xlabel="share of the failures kept", ylabel="share of the successes kept", xlim=(0, 1), ylim=(0, 1.01))
    axes.legend(frameon=False, fontsize=7, loc="lower right")
    axes.set_title("How well metrics tell what holds", fontsize=10)


def _draw_areas(axes: Axes, names: Sequence[str], prediction: Prediction) -> None:
    places = np.arange(len(names))[::-1]
    error = np.abs(prediction.interval - prediction.auc[:, None]).T
    axes.errorbar(prediction.auc, places, xerr=error, fmt="none", ecolor="0.4", capsize=3)
    axes.scatter(prediction.auc, places, c=[f"C{k % 10}" for k in range(len(places))], zorder=3)
    axes.axvline(0.5, color="0.7", linewidth=0.8)
    axes.set_yticks(places, names)
    axes.set(xlabel="area under the curve, 95 % interval", ylim=(-0.7, len(places) - 0.3))
    axes.set_title("0.5: no better than chance", fontsize=10)
