"""Finds the outer surface of a mesh, which a finger can touch, without what its parts hide inside each other.

A triangle is hidden where it is inside another part. What is farther from that part's surface than it is large is
hidden wholly or not at all, many neighbours at a time; other triangles are cut until their pieces are small.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgrasp.geometry.mesh_repair import Parts
from jaxgrasp.geometry.triangle_tree import TriangleTree, along_curve
from jaxgrasp.geometry.triangles import signed_distances

# Pieces so small are hidden if their middles are; these are looked at from just outside, well above the rounding of
# single precision. Shares of the extent.
_SMALL, _OUTSIDE = 1 / 256, 1e-4
# Parts that may hide others: the largest ones.
_HIDING = 64
# Neighbouring triangles of a part that are looked at together.
_TOGETHER = 32


class Surface(NamedTuple):
    """Triangles, counterclockwise seen from outside."""

    vertices: Float[np.ndarray, "vertices 3"]
    """m."""
    faces: Int[np.ndarray, "triangles 3"]
    """Indices of the corners."""


class _Balls(NamedTuple):
    """Balls around pieces of surface."""

    middle: Float[np.ndarray, "balls 3"]
    radius: Float[np.ndarray, " balls"]
    part: Int[np.ndarray, " balls"]
    """The part that each is a piece of."""


class _Verdict(NamedTuple):
    hidden: Bool[np.ndarray, " balls"]
    doubtful: Bool[np.ndarray, " balls"]
    """True where a part of it may be hidden."""


class _Hiding(NamedTuple):
    """The parts that may hide others."""

    parts: Int[np.ndarray, " hiding"]
    trees: Sequence[TriangleTree]
    small: float
    """Radius of a ball that is hidden if its middle is, m."""

    def verdict(self, balls: _Balls) -> _Verdict:
        """Finds the pieces that other parts hide."""
        hidden, doubtful = np.zeros((2, len(balls.part)), bool)
        for number, tree in zip(self.parts, self.trees, strict=True):
            beyond = np.abs(balls.middle - tree.centre) - balls.radius[:, None]
            rows = np.flatnonzero(~hidden & (balls.part != number) & (beyond <= 0.5 * tree.extents).all(-1))
            if len(rows):
                distance, radius = signed_distances(tree, balls.middle[rows]), balls.radius[rows]
                is_small = radius <= self.small
                hidden[rows] = distance < np.where(is_small, 0, -radius)
                doubtful[rows] |= ~is_small & (np.abs(distance) <= radius)
        return _Verdict(hidden, doubtful & ~hidden)


def outer_surface(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "triangles 3"], parts: Parts
) -> Surface:
    """Leave out what lies inside the solid: nested parts, walls of closed cavities, and ends of parts in each other.

    Args:
        vertices: m.
        faces: indices of the corners.
        parts: which of them hang together.

    Raises:
        ValueError: too many triangles are long or overlap, so that it would take long.
    """
    part, volume = parts
    largest = [k for k in np.argsort(-volume)[:_HIDING] if volume[k] > 0]
    if not largest or (part == part[0]).all():
        return Surface(vertices, faces)
    extent = float(np.ptp(vertices[faces], axis=(0, 1)).max())
    trees = [TriangleTree(vertices, faces[part == k]) for k in largest]
    hiding = _Hiding(np.array(largest), trees, _SMALL * extent)
    outside = _OUTSIDE * extent
    hidden, to_cut = _of_triangles(vertices[faces], part, hiding, outside)
    pieces = vertices[faces[:0]]
    if len(to_cut):
        whole, _, pieces = _cut(vertices[faces[to_cut]], part[to_cut], hiding, outside)
        hidden[to_cut] = ~whole
    added = len(vertices) + np.arange(3 * len(pieces)).reshape(-1, 3)
    return Surface(np.concatenate([vertices, pieces.reshape(-1, 3)]), np.concatenate([faces[~hidden], added]))


def _of_triangles(
    corners: Float[np.ndarray, "triangles 3 3"], part: Int[np.ndarray, " triangles"], hiding: _Hiding, outside: float
) -> tuple[Bool[np.ndarray, " triangles"], Int[np.ndarray, " doubtful"]]:
    """Finds triangles that are hidden wholly, and those of which a part may be."""
    order = along_curve(corners.mean(1))
    order = order[np.argsort(part[order], kind="stable")]
    sorted_part = part[order]
    first = np.searchsorted(sorted_part, sorted_part)
    starts = np.flatnonzero((np.arange(len(order)) - first) % _TOGETHER == 0)
    lower = np.minimum.reduceat(corners.min(1)[order], starts)
    upper = np.maximum.reduceat(corners.max(1)[order], starts)
    radius = 0.5 * np.linalg.norm(upper - lower, axis=-1) + hiding.small
    together = hiding.verdict(_Balls(0.5 * (lower + upper), radius, sorted_part[starts]))
    hidden, doubtful = np.zeros((2, len(order)), bool)
    lengths = np.diff(np.r_[starts, len(order)])
    hidden[order], doubtful[order] = (np.repeat(x, lengths) for x in together)
    rows = np.flatnonzero(doubtful)
    alone = hiding.verdict(_balls(corners[rows], part[rows], outside))
    hidden[rows] = alone.hidden
    return hidden, rows[alone.doubtful]


def _cut(
    corners: Float[np.ndarray, "triangles 3 3"], part: Int[np.ndarray, " triangles"], hiding: _Hiding, outside: float
) -> tuple[Bool[np.ndarray, " triangles"], Bool[np.ndarray, " triangles"], Float[np.ndarray, "pieces 3 3"]]:
    """Cuts triangles: True for those that are wholly visible, for those wholly hidden, and visible pieces of others."""
    corners, part = _quartered(corners), np.tile(part, 4)
    hidden, doubtful = hiding.verdict(_balls(corners, part, outside))
    visible, pieces = ~hidden & ~doubtful, corners[:0]
    if doubtful.any():
        visible[doubtful], hidden[doubtful], pieces = _cut(corners[doubtful], part[doubtful], hiding, outside)
    whole, none = (np.asarray(x.reshape(4, -1).all(0)) for x in (visible, hidden))
    own = corners[visible & np.tile(~whole, 4)]
    return whole, none, np.concatenate([own, pieces])


def _balls(corners: Float[np.ndarray, "pieces 3 3"], part: Int[np.ndarray, " pieces"], outside: float) -> _Balls:
    """Around triangles, their middles a little outside."""
    middle = corners.mean(1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    radius = np.linalg.norm(corners - middle[:, None], axis=-1).max(-1)
    return _Balls(middle + outside * normal / np.where(length > 0, length, 1), radius + outside, part)


def _quartered(corners: Float[np.ndarray, "pieces 3 3"]) -> Float[np.ndarray, "quarters 3 3"]:
    """Triangles halved twice at the middles of their longest sides: of all of them the first quarters come first."""
    for _ in range(2):
        lengths = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=-1)
        first, rows = lengths.argmax(1), np.arange(len(corners))
        a, b, c = (corners[rows, (first + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return corners
