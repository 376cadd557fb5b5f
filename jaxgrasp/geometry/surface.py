"""Normals, projection, random points and the centroid of any shape, from its signed distance."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgrasp.arrays import safe_divide, safe_norm
from jaxgrasp.geometry.shape import Shape

# Points drawn in the box around a shape for each one on its surface.
_OVERSAMPLING = 32


@jax.jit
def normals(shape: Shape, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Outward unit normals: the direction in which the distance grows fastest.

    Args:
        shape: the shape.
        points: (*batch, 3), m, on the surface or near.

    Returns:
        (*batch, 3); zero where the distance has no gradient, such as at the centre of a sphere. Differentiable as far
        as the distance is twice.
    """
    return _direction(_slope(shape, points)[1])


@functools.partial(jax.jit, static_argnames="steps")
def project(shape: Shape, points: Float[Array, "*batch 3"], steps: int = 4) -> Float[Array, "*batch 3"]:
    """Points on the surface, near the given ones, by Newton's method along the gradient.

    Args:
        shape: the shape.
        points: (*batch, 3), m.
        steps: how many Newton steps; static. Each squares the error where the distance is smooth.

    Returns:
        (*batch, 3), m.
    """

    def step(_: int, points: Array) -> Array:
        value, slope = _slope(shape, points)
        return points - slope * safe_divide(value, jnp.sum(slope * slope, -1))[..., None]

    return jax.lax.fori_loop(0, steps, step, points)


@functools.partial(jax.jit, static_argnames="count")
def sample_surface(shape: Shape, key: PRNGKeyArray, count: int) -> Float[Array, "count 3"]:
    """Random points on the surface, nearly uniform in area.

    Of many points that are uniform in the box around the shape, those that lie nearest to the surface, moved onto it: a
    thin shell has the same thickness everywhere.

    Args:
        shape: the shape.
        key: the key of the random numbers.
        count: how many; static.

    Returns:
        (count, 3), m, in no order of place.
    """
    lower, upper = shape.bounds
    # Half of the shell lies outside.
    margin = 0.02 * jnp.max(upper - lower)
    drawn = jax.random.uniform(key, (_OVERSAMPLING * count, 3), lower.dtype, lower - margin, upper + margin)
    _, nearest = jax.lax.top_k(-jnp.abs(shape.distance(drawn)), count)
    return project(shape, drawn[nearest])


@functools.partial(jax.jit, static_argnames="cells")
def centroid(shape: Shape, cells: int = 64) -> Float[Array, "3"]:
    """The centre of the shape's volume: the centre of mass of a solid of one material.

    A sum over a grid in the box around the shape, where a cell that the surface cuts counts in part.

    Args:
        shape: the shape.
        cells: cells along each side of the box; static.

    Returns:
        (3,), m.
    """
    lower, upper = shape.bounds
    width = (upper - lower) / cells
    steps = jnp.arange(cells).astype(lower.dtype) + 0.5
    x, y, z = (lower[i] + width[i] * steps for i in range(3))

    def layer(height: Array) -> Array:
        points = jnp.stack([*jnp.meshgrid(x, y, indexing="ij"), jnp.full((cells, cells), height)], -1)
        share = jnp.clip(0.5 - shape.distance(points) / jnp.mean(width), 0, 1)[..., None]
        return jnp.sum(share * jnp.concatenate([points, jnp.ones_like(share)], -1), (0, 1))

    moments = jnp.sum(jax.lax.map(layer, z), 0)
    return moments[:3] / moments[3]


def _slope(shape: Shape, points: Array) -> tuple[Array, Array]:
    """The distance and its gradient."""
    value, pull = jax.vjp(shape.distance, points)
    return value, pull(jnp.ones_like(value))[0]


def _direction(vectors: Array) -> Array:
    return safe_divide(vectors, safe_norm(vectors)[..., None])
