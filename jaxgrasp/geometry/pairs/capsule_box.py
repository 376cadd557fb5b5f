"""A capsule and a box: the nearest point, and a second one where the capsule lies along the box.

The rules are MuJoCo's. The nearest point of the axis to the box is one of its ends above a face, or the nearest point to
one of the twelve edges. From there the axis is followed to where it still lies above the box, and the sphere there
is the second point.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxgrasp.arrays import fold
from jaxgrasp.geometry.pairs.geom import Geom, Touch
from jaxgrasp.geometry.pairs.round_pairs import around
from jaxgrasp.geometry.pairs.surfaces import to_box
from jaxgrasp.geometry.pairs.vectors import dot, norm, pick, rotate, times, unrotate

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


def capsule_box(a: Geom, b: Geom) -> Touch:
    """Up to two points of a capsule a and a box b."""
    centre = unrotate(b.rotation, a.position - b.position)
    half = times(a.size[1], unrotate(b.rotation, a.rotation[:, 2]))
    nearest = _nearest(centre, half, b.size)
    step = _second_step(nearest, centre, half, b.size)

    def sphere(along: Array) -> Touch:
        return around(b.position + rotate(b.rotation, centre + times(along, half)), a.size[0], b, to_box)

    first, second = sphere(nearest.along), sphere(nearest.along + step)
    both = [jnp.concatenate(pair) for pair in zip(first, second, strict=True)]
    absent = jnp.stack([jnp.zeros_like(step, bool), step == 0])
    return Touch(both[0], both[1], jnp.where(absent, jnp.inf, both[2]))


def _nearest(centre: Array, half: Array, size: Array) -> _Nearest:
    best = None
    for end in (-1, 1):
        candidate = _end(centre + end * half, size, end)
        best = candidate if best is None else _closer(best, candidate, 0.0)
    for axis in range(3):
        for signs in itertools.product((-1, 1), repeat=2):
            best = _closer(best, _edge(centre, half, size, axis, signs[::-1]), _TIE)
    return best


def _closer(best: _Nearest, other: _Nearest, tie: float) -> _Nearest:
    closer = other.squared < best.squared - tie

    def choose(mine: Array, its: Array) -> Array:
        return jnp.where(closer, its, mine)

    high = tuple(choose(mine, its) for mine, its in zip(best.high, other.high, strict=True))
    rest = [choose(getattr(best, name), getattr(other, name)) for name in _Nearest._fields if name != "high"]
    return _Nearest(*rest[:4], high, rest[4])


def _end(point: Array, size: Array, end: int) -> _Nearest:
    """An end of the axis, where it is inside the box or above one face; else at infinity."""
    beyond = jnp.maximum(jnp.abs(point) - size, 0)
    outside = [x > 0 for x in beyond]
    count = sum(jnp.where(x, 1, 0) for x in outside)
    face = jnp.where(outside[0], 0, jnp.where(outside[1], 1, jnp.where(outside[2], 2, 3)))
    squared = jnp.where(count > 1, jnp.inf, dot(beyond, beyond))
    flat = jnp.zeros_like(squared)
    return _Nearest(squared, flat + end, flat, face, (flat > 0, flat > 0, flat > 0), jnp.full_like(face, _FACE))


def _edge(centre: Array, half: Array, size: Array, axis: int, signs: tuple[int, int]) -> _Nearest:
    """Nearest points of the axis (numbered y) and of an edge of the box along `axis` (numbered x)."""
    others = [k for k in range(3) if k != axis]
    flat = jnp.zeros_like(centre[0])
    corner = [flat, flat, flat]
    for k, sign in zip(others, signs, strict=True):
        corner[k] = sign * size[k]
    apart = jnp.stack(corner) - centre
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
    gap = apart - times(y, half)
    gap = jnp.stack([gap[k] + size[axis] * x if k == axis else gap[k] for k in range(3)])
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


def _second_step(nearest: _Nearest, centre: Array, half: Array, size: Array) -> Array:
    """How far along the axis, from the nearest point, the second one is: -2 to 2, and 0 where there is none."""
    # Whether the way along +half leads from the corner, or the edge, over the box, by the box's axes.
    inward = [(half[k] > 0) != nearest.high[k] for k in range(3)]
    # From one side of the box to the other.
    length = jnp.abs(half)
    width = jnp.where(length > 0, 2 * size / jnp.where(length > 0, length, 1), _FAR)
    steps = [
        _above_face(nearest, centre, half, size),
        _across_edge(nearest, half, width, inward),
        _beside_corner(nearest, half, width, inward),
    ]
    return pick(steps, nearest.kind)


_FAR = 1e6


def _above_face(nearest: _Nearest, centre: Array, half: Array, size: Array) -> Array:
    """To the other end, or to where the axis leaves the face's outline."""
    way = -nearest.along
    start = centre - times(way, half)
    rate = times(way, half)
    moving = rate != 0
    safe = jnp.where(moving, rate, 1)
    step = jnp.full_like(way, 2)
    for side in (1, -1):
        until = (side * size - start) / safe
        for k in range(3):
            meets = moving[k] & (until[k] > 0) & (nearest.axis != k)
            step = jnp.where(meets, jnp.minimum(step, until[k]), step)
    return jnp.where(nearest.axis == 3, 0, way * step)


def _across_edge(nearest: _Nearest, half: Array, width: Array, inward: list[Array]) -> Array:
    """Over the face that the axis is less steep to, where it crosses the edge from outside."""
    steps = []
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        swap = jnp.abs(half[one]) > jnp.abs(half[other])
        leads = jnp.where(swap, inward[one], inward[other])
        way = jnp.where(leads, 1, -1).astype(half.dtype)
        room = 0.5 * width[axis] * (1 - jnp.where(way * half[axis] > 0, 1, -1) * nearest.across)
        step = fold(jnp.minimum, [1 - way * nearest.along, jnp.where(swap, width[one], width[other]), room])
        steps.append(jnp.where(inward[one] != inward[other], way * step, 0))
    return pick(steps, jnp.minimum(nearest.axis, 2))


def _beside_corner(nearest: _Nearest, half: Array, width: Array, inward: list[Array]) -> Array:
    """Along an edge of the corner, or over a face of it.

    One of the two ways along the axis leads over the box by one of the box's axes, the other way by the two others.
    """
    count = sum(jnp.where(x, 1, 0) for x in inward)
    way = jnp.where(count == 1, 1, -1).astype(half.dtype)
    odd = [x == (count == 1) for x in inward]
    alone = jnp.where(odd[0], 0, jnp.where(odd[1], 1, 2))
    one, other = (pick([width[(k + shift) % 3] for k in range(3)], alone) for shift in (1, 2))
    mine = pick(list(half), alone)
    along = way * jnp.minimum(1 - way * nearest.along, pick(list(width), alone))
    over = -way * fold(jnp.minimum, [1 + way * nearest.along, one, other])
    step = jnp.where(2 * mine**2 > norm(half) ** 2, along, over)
    return jnp.where((count == 1) | (count == 2), step, 0)
