"""A polytope that grows by points from inside a convex set, and directions covered by the cones over its facets.

Let V be convex with gauge g(w) = min {t: w in t V}, and points v_k on V's boundary. Over a cone spanned by some v_k,
a normal l with l'v_k >= 1 for each of them proves g(w) <= l'w, since g is convex and homogeneous; so within a set D
there is g(w) <= h_D(l). The facets' cones have to cover all directions, no more: whether the polytope is convex
matters for how tight the bounds are, not for whether they hold. So rounding may decide what a new point sees: as long
as l'p > 0 on the facets that go, the cones of those that come cover what was theirs.
"""

import numpy as np

# Indices of points are packed into keys of ridges, at most five of them.
_BITS = 12
MOST_POINTS = 1 << _BITS
# A facet is seen from a point beyond its plane by more than this, or the next one where new facets would be flat.
_BEYOND = (1e-9, -1e-9, 1e-6, -1e-6)


class Polytope:
    """Facets over points in d dimensions."""

    points: np.ndarray
    """(P, d)."""
    facets: np.ndarray
    """(F, d), indices of points."""
    normals: np.ndarray
    """(F, d), l'v_k >= 1 for the points of the facet."""

    def __init__(self, points: np.ndarray) -> None:
        """Span d points along axes and d along their opposites, in this order."""
        dimension = points.shape[1]
        signs = (np.arange(1 << dimension)[:, None] >> np.arange(dimension)) & 1
        self.points = points
        self.facets = np.arange(dimension) + dimension * signs
        self.normals = _normals(points[self.facets])

    def add(self, point: np.ndarray) -> tuple[np.ndarray, int] | None:
        """Put in a point.

        Returns:
            Which facets are kept, bool (F,), and how many new ones follow them; None where nothing changes: the point
            is inside, or all new facets would be flat.
        """
        level = self.normals @ point
        if len(self.points) == MOST_POINTS or level.max() <= 1 + _BEYOND[0]:
            return None
        for beyond in _BEYOND:
            seen = level > 1 + beyond
            rim = _rim(self.facets[seen])
            facets = np.concatenate([rim, np.full((len(rim), 1), len(self.points))], 1)
            normals = _normals(np.concatenate([self.points, point[None]])[facets])
            if np.isfinite(normals).all():
                break
        else:
            return None
        self.points = np.concatenate([self.points, point[None]])
        self.facets = np.concatenate([self.facets[~seen], facets])
        self.normals = np.concatenate([self.normals[~seen], normals])
        return ~seen, len(facets)


def _rim(facets: np.ndarray) -> np.ndarray:
    """The ridges that only one of some facets has, (R, d - 1)."""
    dimension = facets.shape[1]
    ridges = np.sort(np.concatenate([np.delete(facets, k, 1) for k in range(dimension)]), 1)
    keys = (ridges << (_BITS * np.arange(dimension - 1))).sum(1)
    _, first, count = np.unique(keys, return_index=True, return_counts=True)
    return ridges[first[count == 1]]


def _normals(corners: np.ndarray) -> np.ndarray:
    """The normals of facets with these corners (F, d, d), NaN where they are flat as seen from the origin."""
    try:
        normals = np.linalg.solve(corners, np.ones((*corners.shape[:2], 1)))[..., 0]
    except np.linalg.LinAlgError:
        return np.full(corners.shape[:2], np.nan)
    least = np.einsum("fkd,fd->fk", corners, normals).min(1, initial=np.inf)
    return np.where(least > 0.5, 1, np.nan)[:, None] * normals / np.where(least > 0.5, least, 1)[:, None]
