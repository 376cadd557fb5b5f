"""The hand and the object around the contacts of a grasp, as triangles in 3D panels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

_MILLIMETRES = 1e3
_COLOURS = {"hand": (0.55, 0.62, 0.72, 0.35), "object": (0.86, 0.79, 0.64, 0.55)}
# Behind contacts, cones and arrows.
_BEHIND = 0.5


@dataclass(frozen=True, kw_only=True)
class Held:
    """A hand around an object, in the object's frame about its centre of mass, m."""

    hand: Sequence[Float[np.ndarray, "triangles 3 3"]]
    """Surfaces of its parts, corners counterclockwise seen from outside."""
    object: Sequence[Float[np.ndarray, "triangles 3 3"]]
    """Likewise."""
    links: Sequence[str]
    """The hand's links, one for each contact."""


def draw_held(axes: Any, held: Held, reach: float) -> None:
    """Draws the sides of hand and object that face the viewer, half transparent and lit from there.

    Args:
        axes: Where to draw, an `Axes3D` whose view is set.
        held: Hand and object.
        reach: Only parts of the hand that come so near to the panel's middle are drawn, m.
    """
    elevation, azimuth = np.radians(axes.elev), np.radians(axes.azim)
    view = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    near = [part for part in held.hand if np.linalg.norm(part, axis=-1).min(initial=np.inf) <= reach]
    shown, colours = [], []
    for name, parts in (("hand", near), ("object", held.object)):
        triangles = np.concatenate([np.zeros((0, 3, 3)), *parts])
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        length = np.linalg.norm(normals, axis=-1)
        facing = (normals @ view) / np.where(length > 0, length, 1)
        seen = facing > 0
        red, green, blue, alpha = _COLOURS[name]
        light = 0.55 + 0.45 * facing[seen, None]
        shown.append(triangles[seen] * _MILLIMETRES)
        colours.append(np.concatenate([light * [red, green, blue], np.full((seen.sum(), 1), alpha)], -1))
    # One collection, whose triangles matplotlib sorts by their depth.
    axes.computed_zorder = False
    faces = Poly3DCollection(np.concatenate(shown), facecolors=np.concatenate(colours), edgecolors="none")
    faces.set_zorder(_BEHIND)
    axes.add_collection3d(faces)
