"""One grasp in 3D: contacts, outward normals, friction cones and the forces of the fingers."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from jaxgrasp.viewer.held import Held, draw_held

CONTACT_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_CONE_SIDES = 24
_MILLIMETRES = 1e3
# Half a panel's width, in units of the farthest contact's distance from the centre of mass: alone, and amid a hand.
_LIMIT, _LIMIT_OF_HAND = 1.35, 1.8


def draw_grasp(
    axes: Any,
    positions: Float[np.ndarray, "contacts 3"],
    normals: Float[np.ndarray, "contacts 3"],
    forces: Float[np.ndarray, "contacts 3"],
    *,
    friction: Float[np.ndarray, " contacts"],
    active: Bool[np.ndarray, " contacts"] | None = None,
    load: Float[np.ndarray, "3"] | None = None,
    surface: Float[np.ndarray, "points 3"] | None = None,
    held: Held | None = None,
    scale: float | None = None,
    colours: Sequence[str] = CONTACT_COLOURS,
) -> float:
    """Draws a grasp with equal aspect, each finger pushing from outside with the tip of its force at the contact.

    The friction cones stand outside too, with their apexes at the contacts: an admissible force lies in its cone.

    Args:
        axes: Where to draw, an `Axes3D`; `Any` because matplotlib's own types of these are wrong.
        positions: Contact positions in the object frame, m.
        normals: Outward normals of the object in its frame.
        forces: Forces of the fingers on the object in its frame, N; not drawn where NaN.
        friction: Coulomb's coefficients.
        active: False where a contact is absent; all present where None.
        load: A direction in which a weight pulls at the centre of mass, drawn as an arrow.
        surface: Points on the object that hint at its shape, m.
        held: The hand and the object around the contacts; the names of links are then listed beside the panel.
        scale: Newtons per millimetre of the drawing, see `common_scale`; None is the one for this grasp alone.
        colours: One a contact, in turn.

    Returns:
        The scale of the forces, newtons per millimetre of the drawing; NaN where there are none.
    """
    present = np.ones(len(positions), bool) if active is None else active
    points = positions[present] * _MILLIMETRES
    normals = normals[present] / np.linalg.norm(normals[present], axis=-1, keepdims=True)
    forces, friction = forces[present], friction[present]
    reach = float(np.linalg.norm(points, axis=-1).max())
    strength = np.nan_to_num(np.linalg.norm(forces, axis=-1))
    if scale is None:
        scale = common_scale([positions[present]], [forces])
    limit = (_LIMIT if held is None else _LIMIT_OF_HAND) * reach
    _frame(axes, points, limit)
    if held is not None:
        draw_held(axes, held, limit / _MILLIMETRES)
        _list_links(axes, held.links, np.flatnonzero(present), colours)
    if surface is not None:
        axes.scatter(*(surface * _MILLIMETRES).T, s=5.0, color="0.6", alpha=0.5, linewidths=0, depthshade=False)
    for i, number in enumerate(np.flatnonzero(present).tolist()):
        point, normal = points[i], normals[i]
        colour = colours[number % len(colours)]
        axes.plot(*np.stack([np.zeros(3), point]).T, color="0.75", linewidth=0.8)
        _draw_cone(axes, point, normal, friction[i], 0.5 * reach, colour)
        _draw_disc(axes, point, normal, 0.14 * reach)
        axes.plot(
            *np.stack([point, point + 0.55 * reach * normal]).T, color="0.25", linewidth=0.9, linestyle=(0, (3, 2))
        )
        axes.text(*(point + 0.68 * reach * normal), str(number), color=colour, fontsize=8, ha="center", va="center")
        if strength[i] > 0.0:
            _draw_arrow(axes, point - forces[i] / scale, point, colour, 0.16 * reach)
        axes.scatter(*point, color=colour, s=22, edgecolors="white", linewidths=0.6, depthshade=False)
    axes.scatter(0.0, 0.0, 0.0, color="black", marker="+", s=45, linewidths=1.2, depthshade=False)
    if load is not None:
        _draw_arrow(axes, np.zeros(3), 0.6 * reach * load / np.linalg.norm(load), "black", 0.16 * reach)
    return scale


def common_scale(
    positions: Iterable[Float[np.ndarray, "contacts 3"]], forces: Iterable[Float[np.ndarray, "contacts 3"]]
) -> float:
    """Find one scale for the arrows of several grasps, so that panels can be compared.

    Args:
        positions: Contact positions of each grasp in the object frame, m.
        forces: Forces of each grasp, N; NaN where there are none.

    Returns:
        Newtons per millimetre of the drawing with which the longest arrow fits in its panel; NaN without forces.
    """
    longest = [
        np.nan_to_num(np.linalg.norm(each, axis=-1)).max()
        / (0.75 * _MILLIMETRES * np.linalg.norm(places, axis=-1).max())
        for places, each in zip(positions, forces, strict=True)
    ]
    return round_scale(float(max(longest))) if max(longest) > 0.0 else np.nan


def round_scale(newtons: float) -> float:
    """The next round number not below the given positive one."""
    decade = 10.0 ** math.floor(math.log10(newtons))
    return decade * next(
        step for step in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0) if step * decade >= newtons * (1.0 - 1e-9)
    )


def _tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _circle(normal: np.ndarray, sides: int) -> np.ndarray:
    first, second = _tangents(normal)
    angles = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    return np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second


def _draw_cone(axes: Any, apex: np.ndarray, normal: np.ndarray, friction: float, height: float, colour: str) -> None:
    # Of equal slant: a cone of wide friction would otherwise dwarf the grasp.
    height = height / np.hypot(1.0, friction)
    rim = apex + height * (normal + friction * _circle(normal, _CONE_SIDES))
    sides = [np.stack([apex, rim[k], rim[k - 1]]) for k in range(_CONE_SIDES)]
    axes.add_collection3d(Poly3DCollection(sides, facecolors=(*to_rgb(colour), 0.10), edgecolors="none"))
    axes.add_collection3d(
        Line3DCollection([np.stack([apex, point]) for point in rim[::3]], colors=colour, linewidths=0.4)
    )
    axes.plot(*np.concatenate([rim, rim[:1]]).T, color=colour, linewidth=0.8)


def _list_links(axes: Any, links: Sequence[str], numbers: np.ndarray, colours: Sequence[str]) -> None:
    """Writes the name of each contact's link at the edge of the panel."""
    for line, number in enumerate(numbers.tolist()):
        colour = colours[number % len(colours)]
        place = (-0.14, 0.92 - 0.045 * line)
        words = axes.text2D(*place, f"{number}  {links[number]}", color=colour, fontsize=7, transform=axes.transAxes)
        words.set_in_layout(False)


def _draw_disc(axes: Any, centre: np.ndarray, normal: np.ndarray, radius: float) -> None:
    rim = centre + radius * _circle(normal, _CONE_SIDES)
    axes.add_collection3d(Poly3DCollection([rim], facecolors=(0.5, 0.5, 0.5, 0.35), edgecolors="0.45", linewidths=0.5))


def _draw_arrow(axes: Any, tail: np.ndarray, tip: np.ndarray, colour: str, head: float) -> None:
    shaft = tip - tail
    length = float(np.linalg.norm(shaft))
    direction = shaft / length
    head = min(head, 0.5 * length)
    neck = tip - head * direction
    rim = neck + 0.32 * head * _circle(direction, 12)
    axes.plot(*np.stack([tail, neck]).T, color=colour, linewidth=2.0, solid_capstyle="butt")
    sides = [np.stack([tip, rim[k], rim[k - 1]]) for k in range(len(rim))]
    axes.add_collection3d(Poly3DCollection([*sides, rim], facecolors=colour, edgecolors="none"))


def _frame(axes: Any, points: np.ndarray, limit: float) -> None:
    # Seen along the direction in which the contacts spread least, from above.
    _, _, directions = np.linalg.svd(points - points.mean(axis=0))
    view = directions[-1] * (1.0 if directions[-1, 2] >= 0.0 else -1.0)
    elevation = np.clip(np.degrees(np.arcsin(np.clip(view[2], -1.0, 1.0))), 18.0, 40.0)
    azimuth = float(np.degrees(np.arctan2(view[1], view[0])))
    # Never straight along x or y, where one axis would be seen end on.
    quadrant, within = divmod(azimuth, 90.0)
    azimuth = 90.0 * quadrant + min(max(within, 20.0), 70.0)
    axes.view_init(elev=float(elevation), azim=azimuth)
    box = (-limit, limit)
    axes.set(xlim=box, ylim=box, zlim=box, xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.xaxis.labelpad = axes.yaxis.labelpad = axes.zaxis.labelpad = -4.0
    axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.1)
    axes.locator_params(nbins=4)
    axes.tick_params(labelsize=7, pad=-2)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.label.set_size(8)
        axis.line.set_color("0.4")
        axis._axinfo["grid"].update(color="0.9", linewidth=0.5)  # matplotlib has no public way for 3D grids
