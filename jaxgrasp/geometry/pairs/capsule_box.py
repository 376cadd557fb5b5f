"""A capsule and a box: the nearest point, and a second one where the capsule lies along the box.

The rules are MuJoCo's. The nearest point of the axis to the box is one of its ends above a face, or the nearest point
to one of the twelve edges. From there the axis is followed to where it still lies above the box, and the sphere there
is the second point.
"""

import itertools
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxgrasp.arrays import fold
from jaxgrasp.geometry.pairs.geom import Body, Point
from jaxgrasp.geometry.pairs.round_pairs import around
from jaxgrasp.geometry.pairs.surfaces import to_box
from jaxgrasp.geometry.pairs.vectors import Vector, choose, dot, each, pick, rotate, unrotate
from jaxgrasp.lanes.fence import fenced

# Edges nearer by less than this (m^2) are no nearer; edges and axes are parallel as in `round_pairs`.
_TIE = 1e-15


class _Nearest(NamedTuple):
    """Where the axis is nearest to the box, by the feature of the box that it is nearest to; all (*lanes)."""

    squared: Array  # distance, m^2
    along: Array  # on the axis, -1 to 1
    across: Array  # on the edge, -1 to 1
    axis: Array  # of the edge, or normal to the face; 3 is the inside
    high: tuple[Array, Array, Array]  # whether the corner, or the edge, is on the upper side of the box
    kind: Array  # _FACE, _EDGE or _CORNER


_FACE, _EDGE, _CORNER = range(3)


def capsule_box(a: Body, b: Body) -> list[Point]:
    """Up to two points of a capsule a and a box b."""
    centre = unrotate(b.rotation, a.position - b.position)
    half = unrotate(b.rotation, a.rotation[2]) * a.size[1]
    nearest = fenced(_nearest)(centre, half, b.size)
    step = fenced(_second_step)(nearest, centre, half, b.size)

    def sphere(along: Array) -> Point:
        return around(b.position + rotate(b.rotation, centre + half * along), a.size[0], b, to_box)

    second = sphere(nearest.along + step)
    return [sphere(nearest.along), second._replace(distance=jnp.where(step == 0, jnp.inf, second.distance))]


def _nearest(centre: Vector, half: Vector, size: Vector) -> _Nearest:
    best = None
    for end in (-1, 1):
        candidate = fenced(partial(_end, end=end))(centre + half * end, size)
        best = candidate if best is None else _closer(best, candidate, 0.0)
    for axis in range(3):
        for signs in itertools.product((-1, 1), repeat=2):
            best = _closer(
                best, fenced(partial(_edge, axis=axis, signs=(signs[1], signs[0])))(centre, half, size), _TIE
            )
    return best


def _closer(best: _Nearest, other: _Nearest, tie: float) -> _Nearest:
    return choose(other.squared < best.squared - tie, other, best)


def _end(point: Vector, size: Vector, end: int) -> _Nearest:
    """An end of the axis, where it is inside the box or above one face; else at infinity."""
    beyond = each(lambda p, s: jnp.maximum(jnp.abs(p) - s, 0), point, size)
    outside = [beyond[k] > 0 for k in range(3)]
    count = sum(jnp.where(x, 1, 0) for x in outside)
    face = jnp.where(outside[0], 0, jnp.where(outside[1], 1, jnp.where(outside[2], 2, 3)))
    squared = jnp.where(count > 1, jnp.inf, dot(beyond, beyond))
    flat = jnp.zeros_like(squared)
    return _Nearest(squared, flat + end, flat, face, (flat > 0, flat > 0, flat > 0), jnp.full_like(face, _FACE))


def _edge(centre: Vector, half: Vector, size: Vector, axis: int, signs: tuple[int, int]) -> _Nearest:
    """Nearest points of the axis (numbered y) and of an edge of the box along `axis` (numbered x)."""
    others = [k for k in range(3) if k != axis]
    flat = jnp.zeros_like(centre[0])
    corner = [flat, flat, flat]
    for k, sign in zip(others, signs, strict=True):
        corner[k] = sign * size[k]
    apart = Vector(*corner) - centre
    xx, xy, yy = size[axis] ** 2, -size[axis] * half[axis], dot(half, half)
    u, v = -size[axis] * apart[axis], dot(half, apart)
    determinant = xx * yy - xy * xy
    crossed = jnp.abs(determinant) >= _TIE
    safe = jnp.where(crossed, determinant, 1)
    raw = (yy * u - xy * v) / safe
    x = jnp.clip(raw, -1, 1)
    y = jnp.where(jnp.abs(raw) > 1, (v - xy * x) / yy, (xx * v - xy * u) / safe)
    again = jnp.abs(y) > 1
    y = jnp.clip(y, -1, 1)
    retried = (u - xy * y) / xx
    x = jnp.where(again, jnp.clip(retried, -1, 1), x)
    gap = apart - half * y
    gap = Vector(*(gap[k] + size[axis] * x if k == axis else gap[k] for k in range(3)))
    # An edge that was left at the first attempt counts as left although the second attempt may return to it.
    above = jnp.where(again & (jnp.abs(retried) > 1), retried > 1, raw > 1)
    left = (jnp.abs(raw) > 1) | (again & (jnp.abs(retried) > 1))
    high = [flat > 0, flat > 0, flat > 0]
    high[axis] = above
    for k, sign in zip(others, signs, strict=True):
        high[k] = flat + sign > 0
    squared = jnp.where(crossed, dot(gap, gap), jnp.inf)
    which = jnp.full(flat.shape, axis)
    return _Nearest(squared, y, x, which, (high[0], high[1], high[2]), jnp.where(left, _CORNER, _EDGE))


def _second_step(nearest: _Nearest, centre: Vector, half: Vector, size: Vector) -> Array:
    """How far along the axis, from the nearest point, the second one is: -2 to 2, and 0 where there is none."""
    # Whether the way along +half leads from the corner, or the edge, over the box, by the box's axes.
    inward = [(half[k] > 0) != nearest.high[k] for k in range(3)]
    # From one side of the box to the other.
    width = each(lambda s, h: jnp.where(h == 0, _FAR, 2 * s / jnp.where(h == 0, 1, jnp.abs(h))), size, half)
    steps = [
        _above_face(nearest, centre, half, size),
        _across_edge(nearest, half, width, inward),
        _beside_corner(nearest, half, width, inward),
    ]
    return pick(steps, nearest.kind)


_FAR = 1e6


def _above_face(nearest: _Nearest, centre: Vector, half: Vector, size: Vector) -> Array:
    """To the other end, or to where the axis leaves the face's outline."""
    way = -nearest.along
    step = jnp.full_like(way, 2)
    for k in range(3):
        rate = way * half[k]
        for side in (1, -1):
            until = (side * size[k] - centre[k] + rate) / jnp.where(rate == 0, 1, rate)
            meets = (rate != 0) & (until > 0) & (nearest.axis != k)
            step = jnp.where(meets, jnp.minimum(step, until), step)
    return jnp.where(nearest.axis == 3, 0, way * step)


def _across_edge(nearest: _Nearest, half: Vector, width: Vector, inward: list[Array]) -> Array:
    """Over the face that the axis is less steep to, where it crosses the edge from outside."""
    steps = []
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        swap = jnp.abs(half[one]) > jnp.abs(half[other])
        leads = jnp.where(swap, inward[one], inward[other])
        way = jnp.where(leads, 1, -1).astype(half.x.dtype)
        room = 0.5 * width[axis] * (1 - jnp.where(way * half[axis] > 0, 1, -1) * nearest.across)
        step = fold(jnp.minimum, [1 - way * nearest.along, jnp.where(swap, width[one], width[other]), room])
        steps.append(jnp.where(inward[one] != inward[other], way * step, 0))
    return pick(steps, jnp.minimum(nearest.axis, 2))


def _beside_corner(nearest: _Nearest, half: Vector, width: Vector, inward: list[Array]) -> Array:
    """Along an edge of the corner, or over a face of it.

    One of the two ways along the axis leads over the box by one of the box's axes, the other way by the two others.
    """
    count = sum(jnp.where(x, 1, 0) for x in inward)
    way = jnp.where(count == 1, 1, -1).astype(half.x.dtype)
    odd = [x == (count == 1) for x in inward]
    alone = jnp.where(odd[0], 0, jnp.where(odd[1], 1, 2))
    one, other = (pick([width[(k + shift) % 3] for k in range(3)], alone) for shift in (1, 2))
    mine = pick([half.x, half.y, half.z], alone)
    along = way * jnp.minimum(1 - way * nearest.along, pick([width.x, width.y, width.z], alone))
    over = -way * fold(jnp.minimum, [1 + way * nearest.along, one, other])
    step = jnp.where(2 * mine * mine > dot(half, half), along, over)
    return jnp.where((count == 1) | (count == 2), step, 0)
