"""Signed distances of points to surfaces and their outward normals, in the geom's frame: all that a sphere asks for."""

import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import fold, safe_divide
from jaxgrasp.geometry.pairs.vectors import choose, norm, times, unit

# Newton's steps for the ellipsoid's multiplier: eight from its lower bound give it to rounding for ratios of axes to 20.
_STEPS = 8


def to_sphere(point: Array, size: Array) -> tuple[Array, Array]:
    """Distance (*lanes) and normal (3, *lanes) at a point (3, *lanes)."""
    return norm(point) - size[0], _direction(point)


def to_capsule(point: Array, size: Array) -> tuple[Array, Array]:
    """See `to_sphere`."""
    beyond = point[2] - jnp.clip(point[2], -size[1], size[1])
    return to_sphere(jnp.stack([point[0], point[1], beyond]), size)


def to_box(point: Array, size: Array) -> tuple[Array, Array]:
    """See `to_sphere`; inside, the nearest face."""
    side = jnp.where(point < 0, -1, 1).astype(point.dtype)
    beyond = jnp.abs(point) - size
    outer = jnp.maximum(beyond, 0)
    highest = fold(jnp.maximum, beyond)
    outside = highest > 0
    nearest = _first(beyond == highest[None])
    distance = jnp.where(outside, norm(outer), highest)
    return distance, side * choose(outside, unit(outer), nearest.astype(point.dtype))


def to_cylinder(point: Array, size: Array) -> tuple[Array, Array]:
    """See `to_sphere`; inside, the nearer of the side and the caps."""
    across = jnp.stack([point[0], point[1], jnp.zeros_like(point[2])])
    radial = _direction(across, axis=0)
    axial = jnp.stack([*jnp.zeros_like(point[:2]), jnp.where(point[2] < 0, -1, 1).astype(point.dtype)])
    aside, above = norm(across) - size[0], jnp.abs(point[2]) - size[1]
    outer = jnp.stack([jnp.maximum(aside, 0), jnp.maximum(above, 0), jnp.zeros_like(above)])
    outside = (aside > 0) | (above > 0)
    share = unit(outer)
    inner = choose(aside > above, radial, axial)
    normal = choose(outside, times(share[0], radial) + times(share[1], axial), inner)
    return jnp.where(outside, norm(outer), jnp.maximum(aside, above)), normal


def to_ellipsoid(point: Array, size: Array) -> tuple[Array, Array]:
    """See `to_sphere`.

    The nearest point of the surface is a^2 p / (a^2 + t) with the t > -min a^2 at which it is on the surface,
    |a p / (a^2 + t)| = 1: the largest root. From below, Newton's steps on the reciprocal of that norm, which is concave,
    never pass it.
    """
    squared = size * size

    def step(multiplier: Array, point: Array) -> Array:
        ratio = point / (squared + multiplier[None])
        scaled = size * ratio
        length = norm(scaled)
        slope = fold(jnp.add, scaled * scaled / (squared + multiplier[None]))
        return multiplier + safe_divide((length - 1) * length * length, slope)

    held = lax.stop_gradient(point)
    # A point on an axis plane inside may have its nearest point off that plane; a little aside it has not.
    held = jnp.where(jnp.abs(held) < 1e-9 * size, jnp.where(held < 0, -1e-9, 1e-9) * size, held)
    start = fold(jnp.maximum, size * jnp.abs(held) - squared)
    multiplier = lax.fori_loop(0, _STEPS, lambda _, t: step(t, held), start)
    # Once more with derivatives: those of the root.
    multiplier = step(lax.stop_gradient(multiplier), point)
    ratio = point / (squared + multiplier[None])
    return multiplier * norm(ratio), unit(ratio)


def _direction(point: Array, axis: int = 2) -> Array:
    """Unit vector to a point; the given axis where it is the origin."""
    length = norm(point)
    fallback = jnp.stack([jnp.full_like(length, float(i == axis)) for i in range(3)])
    return choose(length > 0, unit(point), fallback)


def _first(marks: Array) -> Array:
    """The first of three marks alone."""
    x, y, z = marks
    return jnp.stack([x, y & ~x, z & ~x & ~y])
