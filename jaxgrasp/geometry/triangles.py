"""Distances to many triangles, and how often they wind around a point."""

import math
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxgrasp.compiling import compiled
from jaxgrasp.geometry.triangle_tree import BLOCK, ROUNDING, Blocks, Pairs, TriangleTree
from jaxgrasp.storage import allowance

# Pairs of a leaf and a block at a time: calls cost little then, and one program serves all meshes.
_CHUNK, _FEW = 8192, 512
# arctan(r) / r for 0 <= r <= 1 as a polynomial in r^2, highest power first: interpolated at Chebyshev's points.
_ARCTAN = (
    0.0027662835,
    -0.0157312490,
    0.0421376235,
    -0.0745685481,
    0.1061837063,
    -0.1419779779,
    0.1999187203,
    -0.3333303671,
    0.9999999818,
)

# Points at a time, so that progress is seen.
_POINTS = 50_000
# Bytes of what may be read for each pair of a point and a leaf that are looked at: 27 million of them, which take less
# than ten seconds. A surface of a million even triangles makes 18 million.
_OF_PAIR = 80

Vector = Sequence[Array] | Array


def signed_distances(
    tree: TriangleTree, points: Float[np.ndarray, "points 3"], progress: Callable[[int], None] = lambda done: None
) -> np.ndarray:
    """Signed distances of points to a surface of triangles, negative inside.

    Inside is where the generalised winding number, the solid angle under which the surface is seen over 4 pi, is above
    one half: holes, cracks and overlaps do no harm. Computed in single precision, relative to the surface's extent.

    Args:
        tree: the triangles, corners in counterclockwise order seen from outside.
        points: (points, 3), m.
        progress: called with how many distances are found.

    Returns:
        (points,), m, float64.

    Raises:
        ValueError: too many triangles are long or overlap, so that distances would take long.
    """
    scaled, found, work = tree.scaled(points), np.empty(len(points)), 0
    for begin in range(0, len(points), _POINTS):
        own = slice(begin, begin + _POINTS)
        squared, work = _squares(tree, scaled[own], work)
        angles, work = _windings(tree, scaled[own], work)
        found[own] = np.where(angles > math.pi, -1.0, 1.0) * np.sqrt(squared) * tree.extent
        progress(min(begin + _POINTS, len(points)))
    return found


def _squares(tree: TriangleTree, points: Float[np.ndarray, "points 3"], work: int) -> tuple[np.ndarray, int]:
    """Squared distances, and the pairs of points and leaves that were looked at so far, `work` of them before."""
    blocks = tree.blocks_for_nearest(points)
    size = blocks.points.shape[1]
    squared = np.full(blocks.points.shape[:2], np.inf, np.float32)
    for near in tree.nearest(blocks):
        # Of a block's leaves, few have to do with each of its points.
        least, most = _in_chunks(_squares_to_boxes, tree.boxes, blocks.points, near).swapaxes(0, 1)
        _reduce(np.minimum, squared, near, most)
        pair, place = np.nonzero(least <= (np.sqrt(squared) + ROUNDING)[near.blocks] ** 2)
        own = Pairs(size * near.blocks[pair] + place, near.parts[pair])
        work = _spent(work, len(near.blocks) + len(pair))
        found = _in_chunks(_least_squares, tree.leaves, blocks.points.reshape(-1, 1, 3), own)
        np.minimum.at(squared.reshape(-1), own.blocks, found[:, 0])
    return blocks.in_order(squared), work


def _windings(tree: TriangleTree, points: Float[np.ndarray, "points 3"], work: int) -> tuple[np.ndarray, int]:
    """Half the solid angles under which the surface is seen, and the pairs that were looked at so far."""
    blocks = Blocks.of(points)
    angles = np.zeros(blocks.points.shape[:2])
    for near, far, level in tree.around(blocks):
        work = _spent(work, BLOCK * len(near.blocks))
        _reduce(np.add, angles, near, _in_chunks(_half_angles, tree.leaves, blocks.points, near))
        dipoles = np.concatenate([level.middle, level.area], -1)
        _reduce(np.add, angles, far, _in_chunks(_half_angles_of_dipoles, dipoles, blocks.points, far))
    return blocks.in_order(angles), work


def _spent(before: int, more: int) -> int:
    """Adds pairs of points and leaves to those that were looked at before.

    Raises:
        ValueError: They are more than a surface makes.
    """
    if before + more > allowance() // _OF_PAIR:
        raise ValueError(
            "got too many triangles that are long or overlap, wanted evenly shaped ones (remesh it, see --read-limit)"
        )
    return before + more


def _in_chunks(function: Callable[..., Array], parts: np.ndarray, points: np.ndarray, pairs: Pairs) -> np.ndarray:
    """A function of parts and of blocks of points for all pairs of them, (pairs, ...)."""
    found, begin = [], 0
    # At least one chunk tells the shape.
    while begin < max(1, len(pairs.blocks)):
        size = _CHUNK if len(pairs.blocks) - begin > _CHUNK // 4 else _FEW
        own, places = (x[begin : begin + size] for x in pairs)
        missing, begin = size - len(own), begin + size
        own, places = np.pad(own, (0, missing)), np.pad(places, (0, missing))
        found.append(np.asarray(function(parts[places], points[own]))[: size - missing])
    return np.concatenate(found)


def _reduce(combine: np.ufunc, results: np.ndarray, pairs: Pairs, values: np.ndarray) -> None:
    """Combines the values of each block's pairs with what the block has."""
    if len(pairs.blocks):
        starts = np.flatnonzero(np.diff(pairs.blocks, prepend=-1))
        own = pairs.blocks[starts]
        results[own] = combine(results[own], combine.reduceat(values, starts))


@compiled
def _squares_to_boxes(boxes: Float[Array, "pairs 3 3"], points: Float[Array, "pairs block 3"]) -> Array:
    """Squares of how near to each point what is in a box may be, and of how near it is at most, (pairs, 2, block)."""
    places, (lower, upper, inside) = points.transpose(2, 1, 0), boxes.transpose(1, 2, 0)
    outside = [jnp.maximum(jnp.maximum(lower[k] - places[k], places[k] - upper[k]), 0) for k in range(3)]
    away = _subtract(inside, places)
    return jnp.stack([_dot(outside, outside), _dot(away, away)]).transpose(2, 0, 1)


@compiled
def _least_squares(
    triangles: Float[Array, "pairs leaf 3 3"], points: Float[Array, "pairs block 3"]
) -> Float[Array, "pairs block"]:
    """Squared distances of points to the nearest of the triangles."""
    return _over_triangles(
        lambda best, corners: jnp.minimum(best, _squared_distance(*corners)), jnp.inf, triangles, points
    )


@compiled
def _half_angles(
    triangles: Float[Array, "pairs leaf 3 3"], points: Float[Array, "pairs block 3"]
) -> Float[Array, "pairs block"]:
    """Sums of half the solid angles of triangles."""
    return _over_triangles(lambda angle, corners: angle + _half_angle(*corners), 0.0, triangles, points)


def _over_triangles(
    combine: Callable[[Array, list[Vector]], Array], start: float, triangles: Array, points: Array
) -> Array:
    # Pairs trail: they fill the vectors.
    places = points.transpose(2, 1, 0)

    def step(found: Array, triangle: Array) -> tuple[Array, None]:
        return combine(found, [_subtract(corner, places) for corner in triangle]), None

    found, _ = lax.scan(step, jnp.full_like(places[0], start), triangles.transpose(1, 2, 3, 0))
    return found.T


@compiled
def _half_angles_of_dipoles(dipoles: Float[Array, "pairs 6"], points: Float[Array, "pairs block 3"]) -> Array:
    """Half the solid angles of small surfaces far away: their middles, and their normals as long as their areas."""
    places, (middle, area) = points.transpose(2, 1, 0), dipoles.T.reshape(2, 3, -1)
    arm = _subtract(middle, places)
    squared = _dot(arm, arm)
    return (0.5 * _dot(arm, area) / (squared * jnp.sqrt(squared))).T


def _squared_distance(a: Vector, b: Vector, c: Vector) -> Array:
    """Squared distance of the origin to a triangle."""
    edges = [(a, _subtract(b, a)), (b, _subtract(c, b)), (c, _subtract(a, c))]
    normal = _cross(edges[0][1], edges[1][1])
    beside = [_dot(_cross(edge, normal), corner) for corner, edge in edges]
    whole = beside[0] + beside[1] + beside[2]
    above = (beside[0] >= 0) & (beside[1] >= 0) & (beside[2] >= 0) & (whole > 0)
    # A mean of the corners is on the triangle, however narrow that is and wherever rounding turns its normal.
    c_, a_, b_ = (jnp.where(above, part / jnp.where(above, whole, 1), 1) for part in beside)
    foot = [a_ * p + b_ * q + c_ * r for p, q, r in zip(a, b, c, strict=True)]
    to_edges = [_squared_distance_to_edge(corner, edge) for corner, edge in edges]
    inside = jnp.where(above, _dot(foot, foot), jnp.inf)
    return jnp.minimum(jnp.minimum(inside, to_edges[0]), jnp.minimum(to_edges[1], to_edges[2]))


def _squared_distance_to_edge(corner: Vector, edge: Vector) -> Array:
    length = _dot(edge, edge)
    along = jnp.clip(-_dot(corner, edge) / jnp.where(length > 0, length, 1), 0, 1)
    foot = [p + along * e for p, e in zip(corner, edge, strict=True)]
    return foot[0] ** 2 + foot[1] ** 2 + foot[2] ** 2


def _half_angle(a: Vector, b: Vector, c: Vector) -> Array:
    """Half the solid angle of a triangle seen from the origin, positive from behind (van Oosterom and Strackee)."""
    la, lb, lc = (jnp.sqrt(_dot(v, v)) for v in (a, b, c))
    level = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
    return _arctan2(_dot(a, _cross(b, c)), level)


def _arctan2(y: Array, x: Array) -> Array:
    """arctan2 to 3e-7 rad, in a tenth of the time that XLA's takes on CPUs."""
    a, b = jnp.abs(x), jnp.abs(y)
    larger = jnp.maximum(a, b)
    ratio = jnp.minimum(a, b) / jnp.where(larger > 0, larger, 1)
    square = ratio * ratio
    series = jnp.zeros_like(ratio)
    for coefficient in _ARCTAN:
        series = series * square + coefficient
    angle = ratio * series
    angle = jnp.where(b > a, math.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, math.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def _subtract(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
