"""Which corners of two convex geoms are nearest, and the direction between them (no derivatives).

Apart, this is the distance algorithm of Gilbert, Johnson and Keerthi. Inside each other, b is first moved out along the
current direction, by a little more than the separation lacks, and the direction between the two then is the next one:
maximising s(d) + t d.d_k for a t > -s(d_k) never lowers s, so that s climbs to a maximum.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import safe_divide
from jaxgrasp.geometry.pairs.geom import Body
from jaxgrasp.geometry.pairs.supports import bulge, corner
from jaxgrasp.geometry.pairs.vectors import (
    Vector,
    axis,
    choose,
    cross,
    dot,
    least_along,
    norm,
    pick,
    rotate,
    unit,
    unrotate,
    zeros,
)
from jaxgrasp.lanes.fence import fenced

# Directions tried, and points tried for each.
_CLIMBS = 40
_ROUNDS = 48
# A convex set's nearest point is found to this, relative to its squared distance.
_GAP = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}
# The climb ends where it gains less than this share of the separation.
_GAIN = 1e-3
# Inside each other, other maxima are sought from the normals of flat faces, or where there are none from these
# directions aside of the one found (tangents of the angles).
_TILTS = ((0.7, 0.0), (-0.7, 0.0), (0.0, 0.7), (0.0, -0.7))
_FLAT = ("box", "cylinder")
# Geoms inside each other are moved apart by this share of (their depth + 1 cm).
_SLACK = 1e-2


class Corners(NamedTuple):
    """A point of the set of all b - a, and the polyhedra's corners that it belongs to."""

    point: Vector  # common frame
    a: Vector  # a's corner, a's frame
    b: Vector  # b's corner, b's frame
    of_a: Vector  # a's point less a's position, common frame


class Simplex(NamedTuple):
    """Up to three such points, and their weights in the combination nearest to the origin; zero in empty slots."""

    corners: tuple[Corners, Corners, Corners]
    weights: tuple[Array, Array, Array]


Support = Callable[[Vector], Corners]


class _State(NamedTuple):
    """Of the climbs, lane by lane."""

    steps: Array  # climbing steps so far, ()
    attempt: Array  # which start this climb began with
    d: Vector  # where this climb is
    best: tuple[Array, Vector, Simplex]  # the largest separation so far, where, and the corners there
    done: Array


def search(kind_a: str, kind_b: str, a: Body, b: Body, wanted: Array) -> tuple[Vector, Simplex]:
    """The direction from a to b along which they are farthest apart, and the corners that are nearest.

    Only of the lanes that are wanted; the others cost nothing once these are found.
    """
    start = b.position - a.position
    length = norm(start)
    zero = zeros(length)

    def support(d: Vector) -> Corners:
        return supports(kind_a, kind_b, a, b, d)

    def climb(state: _State) -> _State:
        d = state.d
        first = support(d)
        here = dot(d, first.point)
        out = jnp.maximum(-here, 0)
        shift = d * jnp.where(here > 0, 0, out + _SLACK * (out + 0.01))
        found = _nearest(support, first, shift)
        toward = unit(_combined(found))
        toward = choose(dot(toward, toward) > 0.5, toward, d)
        after = dot(toward, support(toward).point)
        better = ~state.done & (after > state.best[0])
        best = choose(better, (after, toward, found), state.best)
        on_top = after - here <= _GAIN * (jnp.abs(here) + 1e-6)
        attempt = jnp.where(on_top, state.attempt + 1, state.attempt)
        done = state.done | (here > 0) | (attempt > (len(faces) or len(_TILTS)))
        return _State(state.steps + 1, attempt, choose(on_top, _start(best[1], faces, attempt), toward), best, done)

    empty = Corners(zero, zero, zero, zero)
    simplex = Simplex((empty, empty, empty), (zero.x, zero.x, zero.x))
    d = choose(length > 0, unit(start), axis(2, length))
    faces = [
        body.rotation[k] * jnp.where(dot(body.rotation[k], d) < 0, -1.0, 1.0).astype(length.dtype)
        for kind, body in ((kind_a, a), (kind_b, b))
        if kind in _FLAT
        for k in range(3)
    ]
    d = _best_of([d, *faces], support)
    none = jnp.zeros(length.shape, jnp.int32)
    state = _State(none.sum(), none, d, (jnp.full_like(length, -jnp.inf), d, simplex), ~wanted)
    state = lax.while_loop(lambda state: (state.steps < _CLIMBS) & ~jnp.all(state.done), climb, state)
    return state.best[1], state.best[2]


def _best_of(directions: list[Vector], support: Support) -> Vector:
    """The one with the largest separation."""
    best, most = directions[0], dot(directions[0], support(directions[0]).point)
    for other in directions[1:]:
        value = dot(other, support(other).point)
        best, most = choose(value > most, (other, value), (best, most))
    return best


def _start(d: Vector, faces: list[Vector], attempt: Array) -> Vector:
    """The start of an attempt: the normals of faces, or aside of the best direction so far where there are none."""
    if faces:
        return unit(pick([d, *faces], attempt))
    one = unit(cross(d, least_along(d)))
    two = cross(d, one)
    return unit(pick([d, *(d + one * x + two * y for x, y in _TILTS)], attempt))


def supports(kind_a: str, kind_b: str, a: Body, b: Body, d: Vector) -> Corners:
    """The least of b - a along d."""
    toward_a, toward_b = unrotate(a.rotation, d), unrotate(b.rotation, -d)
    corner_a, corner_b = corner(kind_a, a, toward_a), corner(kind_b, b, toward_b)
    point_a = rotate(a.rotation, corner_a + bulge(kind_a, a, toward_a))
    point_b = rotate(b.rotation, corner_b + bulge(kind_b, b, toward_b))
    return Corners(b.position - a.position + point_b - point_a, corner_a, corner_b, point_a)


def _combined(simplex: Simplex) -> Vector:
    one, two, three = (corner.point * weight for corner, weight in zip(*simplex, strict=True))
    return one + two + three


def _nearest(support: Support, first: Corners, shift: Vector) -> Simplex:
    """The simplex that holds the nearest of all points b - a + shift, which must not hold the origin."""
    zero = zeros(shift.x)
    empty = Corners(zero, zero, zero, zero)
    moved = first._replace(point=first.point + shift)
    start = Simplex((moved, empty, empty), (jnp.ones_like(shift.x), zero.x, zero.x))
    dtype = shift.x.dtype
    rounding = 8 * float(jnp.finfo(dtype).eps)

    def add(state: tuple[Array, Simplex, Array]) -> tuple[Array, Simplex, Array]:
        count, simplex, done = state
        nearest = _combined(simplex)
        squared = dot(nearest, nearest)
        new = support(unit(nearest))
        new = new._replace(point=new.point + shift)
        gap = squared - dot(nearest, new.point)
        done = done | (gap <= _GAP[dtype] * squared + rounding * norm(nearest) * norm(new.point))
        reduced, value = _reduced(simplex, new)
        closer = value < squared * (1 - rounding)
        return count + 1, choose(done | ~closer, simplex, reduced), done | ~closer

    state = (jnp.zeros((), jnp.int32), start, jnp.zeros(shift.x.shape, bool))
    return lax.while_loop(lambda state: (state[0] < _ROUNDS) & ~jnp.all(state[2]), add, state)[1]


# The old points of each face, and the one that it leaves out.
_FACES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))


def _reduced(simplex: Simplex, new: Corners) -> tuple[Simplex, Array]:
    """The nearest among the corner, the edges and the faces that the new point makes with the old ones."""
    old, point = [corner.point for corner in simplex.corners], new.point
    present = [weight > 0 for weight in simplex.weights]
    one, zero = jnp.ones_like(point.x), jnp.zeros_like(point.x)
    best, weights, place = dot(point, point), (one, zero, zero), jnp.zeros(point.x.shape, jnp.int32)
    for i in range(3):
        share, value = fenced(_edge_foot)(old[i] - point, point, present[i])
        shares = [zero, zero, zero]
        shares[i], shares[(i + 1) % 3] = share, 1 - share
        better = value < best
        best, weights, place = choose(
            better,
            (value, (shares[0], shares[1], shares[2]), jnp.full_like(place, (i + 1) % 3)),
            (best, weights, place),
        )
    for i, j, slot in _FACES:
        share_i, share_j, value = fenced(_face_foot)(old[i] - point, old[j] - point, point, present[i] & present[j])
        shares = [zero, zero, zero]
        shares[i], shares[j], shares[slot] = share_i, share_j, 1 - share_i - share_j
        better = value < best
        best, weights, place = choose(
            better, (value, (shares[0], shares[1], shares[2]), jnp.full_like(place, slot)), (best, weights, place)
        )
    corners = tuple(choose(place == i, new, corner) for i, corner in enumerate(simplex.corners))
    return Simplex((corners[0], corners[1], corners[2]), weights), best


def _edge_foot(edge: Vector, point: Vector, present: Array) -> tuple[Array, Array]:
    """How far along an edge from a point its nearest point is, and its squared distance; inf where that is an end."""
    share = safe_divide(-dot(point, edge), dot(edge, edge))
    foot = point + edge * share
    return share, jnp.where(present & (share > 0) & (share < 1), dot(foot, foot), jnp.inf)


def _face_foot(one: Vector, other: Vector, point: Vector, present: Array) -> tuple[Array, Array, Array]:
    """The same of a face between two edges from a point."""
    normal = cross(one, other)
    flat = dot(normal, normal)
    inverse = safe_divide(jnp.ones_like(flat), flat)
    share_one = -dot(cross(point, other), normal) * inverse
    share_other = -dot(cross(one, point), normal) * inverse
    inside = present & (flat > 0) & (share_one > 0) & (share_other > 0) & (share_one + share_other < 1)
    return share_one, share_other, jnp.where(inside, dot(normal, point) ** 2 * inverse, jnp.inf)
