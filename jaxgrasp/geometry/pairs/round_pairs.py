"""Spheres with everything that has a closed form, and capsules with capsules."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from jaxgrasp.geometry.pairs.geom import Geom, Touch, single
from jaxgrasp.geometry.pairs.vectors import choose, dot, norm, pick, rotate, times, unit, unrotate

Surface = Callable[[Array, Array], tuple[Array, Array]]

# Axes of capsules are parallel where the product of their squared lengths, m^2, times the squared sine of their angle is
# below this.
_PARALLEL = 1e-15


def sphere_with(surface: Surface) -> Callable[[Geom, Geom], Touch]:
    """Touches of a sphere a and a geom b, from the signed distance of points to b's surface."""

    def touch(a: Geom, b: Geom) -> Touch:
        return around(a.position, a.size[0], b, surface)

    return touch


def around(centre: Array, radius: Array, b: Geom, surface: Surface) -> Touch:
    """Touches of spheres of the given centre (3, *lanes) and radius (*lanes) and a geom b."""
    distance, outward = surface(unrotate(b.rotation, centre - b.position), b.size)
    outward = rotate(b.rotation, outward)
    # The sphere's surface is radius below the centre, b's distance below it.
    return single(centre - times(0.5 * (radius + distance), outward), -outward, distance - radius)


def capsule_capsule(a: Geom, b: Geom) -> Touch:
    """One point of two capsules; two where their axes are parallel.

    Parallel ones touch along a line. Of the ends of a and b and their nearest points on the other axis the first two
    that penetrate count, then the nearest.
    """
    half_a, half_b = times(a.size[1], a.rotation[:, 2]), times(b.size[1], b.rotation[:, 2])
    apart = a.position - b.position
    aa, ab, bb = dot(half_a, half_a), -dot(half_a, half_b), dot(half_b, half_b)
    u, v = -dot(half_a, apart), dot(half_b, apart)
    determinant = aa * bb - ab * ab
    crossed = jnp.abs(determinant) >= _PARALLEL
    safe = jnp.where(crossed, determinant, 1)
    x = jnp.clip((bb * u - ab * v) / safe, -1, 1)
    y = jnp.clip((v - ab * x) / bb, -1, 1)
    x = jnp.clip((u - ab * y) / aa, -1, 1)

    def between(x: Array, y: Array) -> Touch:
        return _two_spheres(a.position + times(x, half_a), a.size[0], b.position + times(y, half_b), b.size[0])

    one = jnp.ones_like(x)
    ends = [between(end * one, jnp.clip((v - ab * end) / bb, -1, 1)) for end in (1, -1)]
    ends += [between(jnp.clip((u - ab * end) / aa, -1, 1), end * one) for end in (1, -1)]
    order = [jnp.where(end.distance[0] <= 0, -1 - 1.0 / (i + 1), end.distance[0]) for i, end in enumerate(ends)]
    lines = []
    for index in _first_two(order):
        lines.append([pick([getattr(end, field)[0] for end in ends], index) for field in Touch._fields])
    nearest = between(x, y)
    return Touch(
        position=jnp.stack([choose(crossed, nearest.position[0], lines[0][0]), lines[1][0]]),
        normal=jnp.stack([choose(crossed, nearest.normal[0], lines[0][1]), lines[1][1]]),
        distance=jnp.stack(
            [jnp.where(crossed, nearest.distance[0], lines[0][2]), jnp.where(crossed, jnp.inf, lines[1][2])]
        ),
    )


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


def _two_spheres(p: Array, radius_p: Array, q: Array, radius_q: Array) -> Touch:
    length = norm(q - p)
    z = jnp.stack([jnp.zeros_like(length), jnp.zeros_like(length), jnp.ones_like(length)])
    normal = choose(length > 0, unit(q - p), z)
    distance = length - radius_p - radius_q
    return single(p + times(radius_p + 0.5 * distance, normal), normal, distance)
