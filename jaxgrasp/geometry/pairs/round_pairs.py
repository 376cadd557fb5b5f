"""Spheres with everything that has a closed form, and capsules with capsules."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from jaxgrasp.geometry.pairs.geom import Body, Point
from jaxgrasp.geometry.pairs.vectors import Vector, axis, choose, dot, norm, pick, rotate, unit, unrotate

Surface = Callable[[Vector, Vector], tuple[Array, Vector]]

# Axes of capsules are parallel where the product of their squared lengths, m^2, times the squared sine of their angle is
# below this.
_PARALLEL = 1e-15


def sphere_with(surface: Surface) -> Callable[[Body, Body], list[Point]]:
    """Touches of a sphere a and a geom b, from the signed distance of points to b's surface."""

    def touch(a: Body, b: Body) -> list[Point]:
        return [around(a.position, a.size[0], b, surface)]

    return touch


def around(centre: Vector, radius: Array, b: Body, surface: Surface) -> Point:
    """Where spheres of the given centre and radius touch a geom b."""
    distance, outward = surface(unrotate(b.rotation, centre - b.position), b.size)
    outward = rotate(b.rotation, outward)
    # The sphere's surface is radius below the centre, b's distance below it.
    return Point(centre - outward * (0.5 * (radius + distance)), -outward, distance - radius)


def capsule_capsule(a: Body, b: Body) -> list[Point]:
    """One point of two capsules; two where their axes are parallel.

    Parallel ones touch along a line. Of the ends of a and b and their nearest points on the other axis the first two
    that penetrate count, then the nearest.
    """
    half_a, half_b = a.rotation[2] * a.size[1], b.rotation[2] * b.size[1]
    apart = a.position - b.position
    aa, ab, bb = dot(half_a, half_a), -dot(half_a, half_b), dot(half_b, half_b)
    u, v = -dot(half_a, apart), dot(half_b, apart)
    determinant = aa * bb - ab * ab
    crossed = jnp.abs(determinant) >= _PARALLEL
    x = jnp.clip((bb * u - ab * v) / jnp.where(crossed, determinant, 1), -1, 1)
    y = jnp.clip((v - ab * x) / bb, -1, 1)
    x = jnp.clip((u - ab * y) / aa, -1, 1)

    def between(x: Array, y: Array) -> Point:
        return _two_spheres(a.position + half_a * x, a.size[0], b.position + half_b * y, b.size[0])

    one = jnp.ones_like(x)
    ends = [between(one * end, jnp.clip((v - ab * end) / bb, -1, 1)) for end in (1, -1)]
    ends += [between(jnp.clip((u - ab * end) / aa, -1, 1), one * end) for end in (1, -1)]
    order = [jnp.where(end.distance <= 0, -1 - 1 / (i + 1), end.distance) for i, end in enumerate(ends)]
    first, second = (pick(ends, index) for index in _first_two(order))
    first = choose(crossed, between(x, y), first)
    return [first, second._replace(distance=jnp.where(crossed, jnp.inf, second.distance))]


def _first_two(values: list[Array]) -> tuple[Array, Array]:
    """Which of some values is the least and which the next."""
    first, second = (jnp.zeros(values[0].shape, jnp.int32) for _ in range(2))
    least = jnp.full_like(values[0], jnp.inf)
    next_least = least
    for i, value in enumerate(values):
        best, good = value < least, value < next_least
        second = jnp.where(best, first, jnp.where(good, i, second))
        next_least = jnp.where(best, least, jnp.where(good, value, next_least))
        first, least = jnp.where(best, i, first), jnp.where(best, value, least)
    return first, second


def _two_spheres(p: Vector, radius_p: Array, q: Vector, radius_q: Array) -> Point:
    length = norm(q - p)
    normal = choose(length > 0, unit(q - p), axis(2, length))
    distance = length - radius_p - radius_q
    return Point(p + normal * (radius_p + 0.5 * distance), normal, distance)
