"""Mends triangle meshes: turns faces, drops doubles and strays, and puts lids on holes.

Triangles with a common edge agree where they run along it in opposite ways. Parts that hang together so are turned as a
whole, so that they are counterclockwise seen from outside; a part that is inside out within others is a cavity.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.geometry.triangle_tree import TriangleTree
from jaxgrasp.geometry.triangles import signed_distances

# By which three integers become one that hardly any other three have: bits of irrational numbers.
_MIX = np.array([0x1E3779B97F4A7C15, 0x3243F6A8885A308D, 0x2B7E151628AED2A6])
# Corners nearer to each other than this share of the extent are one.
_SAME = 1e-9
# A part with less than this share of the area is no surface.
_NO_AREA = 1e-9
# Nor does a part with less volume than this share of its area to the power 1.5 enclose anything.
_NO_VOLUME = 1e-9
# Parts with less than this share of the volume, and by this share of the extent of the others beside them, are strays.
_OF_VOLUME, _BESIDE = 1e-3, 0.1
# A lid may have this share of its part's area: a half ball's has one half.
_OF_AREA = 0.6
# Corners of a part that are looked at, and the share of them that must be within others for a cavity.
_CORNERS, _WITHIN = 64, 0.9


class Parts(NamedTuple):
    """Parts of a mesh: triangles that hang together."""

    of: Int[np.ndarray, " triangles"]
    """The part of each triangle."""
    volume: Float[np.ndarray, " parts"]
    """Negative of cavities, 0 of what encloses nothing, m^3."""


class Mended(NamedTuple):
    """Triangles that agree with each other."""

    vertices: Float[np.ndarray, "vertices 3"]
    """m, those of lids among them."""
    faces: Int[np.ndarray, "triangles 3"]
    """Indices of the corners, counterclockwise seen from outside."""
    parts: Parts
    is_closed: bool
    """Whether it is one part, every edge of which has two triangles."""
    strays: int
    """Number of triangles that were left out as strays."""


def mended(vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "triangles 3"]) -> Mended:
    """Turn triangles so that they agree, and leave out those that are there twice, have no area or are strays.

    Holes get lids, triangles around the mean of their corners, unless these are almost as large as what is there.

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
        return Mended(vertices, whole, Parts(np.zeros(len(whole), int), np.zeros(1)), False, 0)
    part, flipped, is_open = _parts(welded)
    faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    volume, area = _sizes(vertices[faces], part)
    real = area > _NO_AREA * area.sum()
    if volume.sum() < 0:
        faces, volume = faces[:, ::-1], -volume
    cavity = _cavities(vertices, faces, part, volume)
    inward = (volume < 0) & ~cavity
    faces = np.where(inward[part][:, None], faces[:, ::-1], faces)
    stray = real & _strays(vertices[faces], part, np.abs(volume))
    real &= ~stray
    kept = real[part]
    faces, own, is_closed = faces[kept], part[kept], not is_open[kept].any()
    if not is_closed and volume.any():
        vertices, faces, own, is_closed = _lids(vertices, faces, own, np.where(volume != 0, area, 0.0))
    parts = Parts(own, np.where(cavity, volume, np.abs(volume)))
    return Mended(vertices, faces, parts, is_closed and int(real.sum()) == 1, int(stray[part].sum()))


def _welded(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces with the same index for corners at the same place."""
    corners = vertices[faces.reshape(-1)]
    cells = corners / max(_SAME * float(np.ptp(corners, axis=0).max()), 1e-300)
    cells = np.round(cells).astype(np.int64)
    # Sorted as one number each, they take a fifth of the time.
    _, first, label = np.unique(cells @ _MIX, return_index=True, return_inverse=True)
    if (cells[first[label]] != cells).any():
        label = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    return label.reshape(faces.shape)


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
    """Volume and area of each part.

    A part that is flat encloses nothing: which way round it is cannot be told.
    """
    count = np.bincount(part)
    middle = np.stack([np.bincount(part, x) for x in triangles.mean(1).T], -1) / count[:, None]
    a, b, c = np.moveaxis(triangles - middle[part][:, None], 1, 0)
    normal = np.cross(b - a, c - a)
    volume = np.bincount(part, np.einsum("fi,fi->f", a, normal) / 6)
    area = np.bincount(part, 0.5 * np.linalg.norm(normal, axis=-1))
    real = (area > _NO_AREA * area.sum()) & (np.abs(volume) > _NO_VOLUME * area**1.5)
    return np.where(real, volume, 0.0), area


def _lids(
    vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, area: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Vertices, faces and their parts with lids on holes of parts with such an area, and whether no hole is left."""
    welded = _welded(vertices, faces)
    # Edges of a lid run the other way.
    end, begin = faces.T.reshape(-1), np.roll(faces, -1, 1).T.reshape(-1)
    ends = np.stack([np.roll(welded, -1, 1).T.reshape(-1), welded.T.reshape(-1)], -1)
    # One number stands for an edge, which way it runs or not.
    edges = ends.min(-1) * (int(welded.max()) + 1) + ends.max(-1)
    _, line, count = np.unique(edges, return_inverse=True, return_counts=True)
    lone = (count[line] == 1) & (area[part] > 0)[np.tile(np.arange(len(faces)), 3)]
    begin, end, own, rim = begin[lone], end[lone], np.tile(part, 3)[lone], _rims(ends[lone])
    begin, end, own, rim = (x[rim >= 0] for x in (begin, end, own, rim))
    centre = np.stack([np.bincount(rim, x) for x in vertices[begin].T], -1) / np.bincount(rim)[:, None]
    arms = vertices[begin] - centre[rim], vertices[end] - centre[rim]
    of_lid = np.bincount(rim, 0.5 * np.linalg.norm(np.cross(*arms), axis=-1))
    first = np.unique(rim, return_index=True)[1]
    lidded = of_lid <= _OF_AREA * area[own[first]]
    number, chosen = len(vertices) + np.cumsum(lidded) - 1, lidded[rim]
    added = np.stack([begin[chosen], end[chosen], number[rim[chosen]]], -1)
    is_closed = bool((count <= 2).all()) and int(chosen.sum()) == int((count == 1).sum())
    vertices, faces = np.concatenate([vertices, centre[lidded]]), np.concatenate([faces, added])
    return vertices, faces, np.concatenate([part, own[chosen]]), is_closed


def _rims(ends: np.ndarray) -> np.ndarray:
    """The number of the loop, which meets no corner twice, that each of some directed edges is in; -1 for none."""
    leaving: dict[int, list[int]] = {}
    for number, corner in enumerate(ends[:, 0].tolist()):
        leaving.setdefault(corner, []).append(number)
    rim, loops, head = np.full(len(ends), -1), 0, ends[:, 1].tolist()
    for start in list(leaving):
        while leaving[start]:
            corner, path, met = start, [], {start: 0}
            while leaving.get(corner):
                path.append(leaving[corner].pop())
                corner = head[path[-1]]
                since = met.setdefault(corner, len(path))
                if since < len(path):
                    for number in path[since:]:
                        rim[number] = loops
                        if head[number] != corner:
                            del met[head[number]]
                    del path[since:]
                    loops += 1
    return rim


def _strays(triangles: np.ndarray, part: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """Finds strays: parts with hardly any volume, beside all others."""
    small = volume < _OF_VOLUME * volume.sum()
    if not small.any() or small.all():
        return np.zeros(len(volume), bool)
    low, high = triangles.min(1), triangles.max(1)
    rest = ~small[part]
    lower, upper = low[rest].min(0), high[rest].max(0)
    beside = _BESIDE * (upper - lower).max()
    outside = ((low > upper + beside) | (high < lower - beside)).any(-1)
    return small & (np.bincount(part, ~outside) == 0)


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
