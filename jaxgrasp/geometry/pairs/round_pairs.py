"""Spheres with everything that has a closed form, and capsules with capsules."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from jaxgrasp.geometry.pairs.geom import Body, Point
from jaxgrasp.geometry.pairs.vectors import Vector, axis, choose, dot, norm, rotate, unit, unrotate

Surface = Callable[[Vector, Vector], tuple[Array, Vector]]

# Axes of capsules are parallel where the product of their squared lengths, m^2, and the squared sine of their angle
# is below this.
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
    """One point of two capsules; two where their axes are parallel: the ends of where they lie side by side."""
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

    # The ends of b along a's axis, -1 and 1 being those of a.
    ends = (u + ab) / aa, (u - ab) / aa
    low, high = jnp.maximum(jnp.minimum(*ends), -1), jnp.minimum(jnp.maximum(*ends), 1)
    parallel = [between(x, jnp.clip((v - ab * x) / bb, -1, 1)) for x in (jnp.clip(low, -1, 1), jnp.clip(high, -1, 1))]
    second = parallel[1]._replace(distance=jnp.where(crossed | (high <= low), jnp.inf, parallel[1].distance))
    return [choose(crossed, between(x, y), parallel[0]), second]


def _two_spheres(p: Vector, radius_p: Array, q: Vector, radius_q: Array) -> Point:
    length = norm(q - p)
    normal = choose(length > 0, unit(q - p), axis(2, length))
    distance = length - radius_p - radius_q
    return Point(p + normal * (radius_p + 0.5 * distance), normal, distance)
