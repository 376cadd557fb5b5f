"""Signed distances of points to surfaces and their outward normals, in the geom's frame: all that a sphere asks for."""

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import fold, safe_divide
from jaxgrasp.geometry.pairs.vectors import Vector, axis, choose, each, norm, unit

# Newton's steps for the ellipsoid's multiplier, from its lower bound.
_STEPS = 8


def to_sphere(point: Vector, size: Vector) -> tuple[Array, Vector]:
    """Distance and normal at a point."""
    return norm(point) - size[0], _direction(point, axis(2, point.x))


def to_capsule(point: Vector, size: Vector) -> tuple[Array, Vector]:
    """See `to_sphere`."""
    return to_sphere(Vector(point.x, point.y, point.z - jnp.clip(point.z, -size[1], size[1])), size)


def to_box(point: Vector, size: Vector) -> tuple[Array, Vector]:
    """See `to_sphere`; inside, the nearest face."""
    beyond = each(lambda p, s: jnp.abs(p) - s, point, size)
    outer = each(lambda x: jnp.maximum(x, 0), beyond)
    highest = fold(jnp.maximum, [beyond.x, beyond.y, beyond.z])
    is_x, is_y = beyond.x == highest, beyond.y == highest
    nearest = Vector(*(jnp.where(mark, 1.0, 0.0).astype(highest.dtype) for mark in (is_x, is_y & ~is_x, ~is_x & ~is_y)))
    outside = highest > 0
    normal = choose(outside, unit(outer), nearest)
    return jnp.where(outside, norm(outer), highest), each(lambda n, p: jnp.where(p < 0, -n, n), normal, point)


def to_cylinder(point: Vector, size: Vector) -> tuple[Array, Vector]:
    """See `to_sphere`; inside, the nearer of the side and the caps."""
    zero = jnp.zeros_like(point.x)
    across = Vector(point.x, point.y, zero)
    radial = _direction(across, axis(0, zero))
    up = axis(2, zero)
    axial = choose(point.z < 0, -up, up)
    aside, above = norm(across) - size[0], jnp.abs(point.z) - size[1]
    outer = Vector(jnp.maximum(aside, 0), jnp.maximum(above, 0), zero)
    outside = (aside > 0) | (above > 0)
    share = unit(outer)
    normal = choose(outside, radial * share.x + axial * share.y, choose(aside > above, radial, axial))
    return jnp.where(outside, norm(outer), jnp.maximum(aside, above)), normal


def to_ellipsoid(point: Vector, size: Vector) -> tuple[Array, Vector]:
    """See `to_sphere`.

    The nearest point of the surface is a^2 p / (a^2 + t) with the t > -min a^2 at which it is on the surface,
    |a p / (a^2 + t)| = 1: the largest root. From below, Newton's steps on the reciprocal of that norm, which is
    concave, never pass it.
    """
    squared = each(jnp.multiply, size, size)

    def step(multiplier: Array, point: Vector) -> Array:
        scaled = each(lambda p, s, a: s * p / (a + multiplier), point, size, squared)
        length = norm(scaled)
        slopes = each(lambda q, a: q * q / (a + multiplier), scaled, squared)
        return multiplier + safe_divide((length - 1) * length * length, slopes.x + slopes.y + slopes.z)

    def aside(p: Array, s: Array) -> Array:
        # Inside, a point on a plane of two axes may have its nearest point off that plane; a little aside it has not.
        return jnp.where(jnp.abs(p) < 1e-9 * s, jnp.where(p < 0, -1e-9, 1e-9) * s, p)

    held = each(aside, jax.tree.map(lax.stop_gradient, point), size)
    starts = each(lambda p, s, a: s * jnp.abs(p) - a, held, size, squared)
    start = fold(jnp.maximum, [starts.x, starts.y, starts.z])
    multiplier = lax.fori_loop(0, _STEPS, lambda _, t: step(t, held), start)
    # Once more with derivatives: those of the root.
    multiplier = step(lax.stop_gradient(multiplier), point)
    ratio = each(lambda p, a: p / (a + multiplier), point, squared)
    return multiplier * norm(ratio), unit(ratio)


def _direction(point: Vector, fallback: Vector) -> Vector:
    return choose(norm(point) > 0, unit(point), fallback)
