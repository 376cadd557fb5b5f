"""Triangles as people have them: which way round they are, which ones are there twice, and which are none.

Triangles with a common edge agree where they run along it in opposite ways. Parts that hang together so are turned as a
whole, so that they are counterclockwise seen from outside; a part that is inside out within others is a cavity.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.geometry.triangle_tree import TriangleTree
from jaxgrasp.geometry.triangles import signed_distances

# Corners nearer to each other than this share of the extent are one.
_SAME = 1e-9
# A part with less than this share of the area is no surface.
_NO_AREA = 1e-9
# Nor does a part with less volume than this share of its area to the power 1.5 enclose anything.
_NO_VOLUME = 1e-9
# Corners of a part that are looked at, and the share of them that must be within others for a cavity.
_CORNERS, _WITHIN = 64, 0.9


class Mended(NamedTuple):
    """Triangles that agree with each other."""

    faces: Int[np.ndarray, "triangles 3"]
    """Indices of the corners, counterclockwise seen from outside."""
    is_closed: bool
    """Whether it is one part, every edge of which has two triangles."""


def mended(vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "triangles 3"]) -> Mended:
    """Turn triangles so that they agree, and leave out those that are there twice or have no area.

    Args:
        vertices: m.
        faces: indices of the corners.

    Raises:
        ValueError: the surface has one side alone, as a Moebius strip has.
    """
    whole = faces
    welded = _welded(vertices, faces)
    kept = _once(welded)
    faces, welded = faces[kept], welded[kept]
    if not len(faces):
        return Mended(whole, False)
    part, flipped, is_open = _parts(welded)
    faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    volume, area = (np.bincount(part, x) for x in _sizes(vertices[faces], part))
    real = area > _NO_AREA * area.sum()
    # A part that is flat encloses nothing: which way round it is cannot be told.
    volume = np.where(real & (np.abs(volume) > _NO_VOLUME * area**1.5), volume, 0.0)
    if volume.sum() < 0:
        faces, volume = faces[:, ::-1], -volume
    inward = (volume < 0) & ~_cavities(vertices, faces, part, volume)
    faces = np.where(inward[part][:, None], faces[:, ::-1], faces)
    kept = real[part]
    return Mended(faces[kept], not is_open[kept].any() and int(real.sum()) == 1)


def _welded(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces with the same index for corners at the same place."""
    used, places = np.unique(faces, return_inverse=True)
    extent = np.ptp(vertices[used], axis=0).max()
    cells = np.round(vertices[used] / max(_SAME * float(extent), 1e-300))
    return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)[places.reshape(faces.shape)]


def _once(faces: np.ndarray) -> np.ndarray:
    """Which triangles have three corners, each of them once."""
    own = np.sort(faces, -1)
    rows = np.flatnonzero((own[:, 0] != own[:, 1]) & (own[:, 1] != own[:, 2]))
    return np.sort(rows[np.unique(own[rows], axis=0, return_index=True)[1]])


def _parts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The part of each triangle, whether it is to be turned to agree with its part, and whether it has a lone edge.

    Edges of more than two triangles join none of them.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(faces)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner, forward = np.tile(np.arange(count), 3), ends[:, 0] < ends[:, 1]
    order = np.lexsort(np.sort(ends, -1).T)
    lines = np.sort(ends, -1)[order]
    starts = np.flatnonzero(np.r_[True, (lines[1:] != lines[:-1]).any(-1)])
    lengths = np.diff(np.r_[starts, len(lines)])
    first = starts[lengths == 2]
    one, other = owner[order[first]], owner[order[first + 1]]
    # A triangle as it is, and turned: each agrees with one of the two of every neighbour.
    differ = (forward[order[first]] == forward[order[first + 1]]).astype(int)
    rows = np.concatenate([one, one + count])
    columns = np.concatenate([other + differ * count, other + (1 - differ) * count])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * count, 2 * count))
    label = connected_components(graph, directed=False)[1]
    as_is, turned = label[:count], label[count:]
    if (as_is == turned).any():
        raise ValueError("got a surface with one side alone, wanted one around a solid")
    # Of the two of a part, most triangles stay as they are in one.
    low, high = np.minimum(as_is, turned), np.maximum(as_is, turned)
    part = np.unique(low, return_inverse=True)[1].reshape(-1)
    stay_low = np.bincount(part, as_is == low)
    flipped = np.where(2 * stay_low[part] >= np.bincount(part)[part], as_is != low, as_is != high)
    is_open = np.zeros(count, bool)
    is_open[owner[order[np.repeat(lengths != 2, lengths)]]] = True
    return part, flipped, is_open


def _sizes(triangles: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each triangle adds to the volume and to the area of its part."""
    count = np.bincount(part)
    middle = np.stack([np.bincount(part, x) for x in triangles.mean(1).T], -1) / count[:, None]
    a, b, c = np.moveaxis(triangles - middle[part][:, None], 1, 0)
    normal = np.cross(b - a, c - a)
    return np.einsum("fi,fi->f", a, normal) / 6, 0.5 * np.linalg.norm(normal, axis=-1)


def _cavities(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """Which parts are inside out within others."""
    found = np.zeros(len(volume), bool)
    around = faces[(volume > 0)[part]]
    candidates = np.flatnonzero(volume < 0)
    if not len(candidates) or not len(around):
        return found
    points = []
    order = np.argsort(part, kind="stable")
    starts = np.searchsorted(part[order], np.arange(len(volume) + 1))
    for number in candidates:
        own = np.unique(faces[order[starts[number] : starts[number + 1]]])
        points.append(vertices[own[np.linspace(0, len(own) - 1, _CORNERS).astype(int)]])
    inside = signed_distances(TriangleTree(vertices, around), np.concatenate(points)) < 0
    found[candidates] = inside.reshape(len(candidates), _CORNERS).mean(1) > _WITHIN
    return found
