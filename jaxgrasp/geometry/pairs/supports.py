"""What every convex kind is made of: a polyhedron, plus an ellipsoid, plus a ball."""

import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import safe_divide
from jaxgrasp.geometry.pairs.geom import Body
from jaxgrasp.geometry.pairs.vectors import Vector, each, norm, zeros

# Corners of a hull tried at a time.
_UNROLL = 8


def corner(kind: str, body: Body, d: Vector) -> Vector:
    """The polyhedron's corner farthest along d, geom's frame."""
    if kind in ("capsule", "cylinder"):
        zero = jnp.zeros_like(d.x)
        return Vector(zero, zero, jnp.where(d.z < 0, -body.size[1], body.size[1]))
    if kind == "box":
        return each(lambda along, half: jnp.where(along < 0, -half, half), d, body.size)
    if body.hull is not None:
        return _farthest(body.hull.vertices.astype(d.x.dtype), d)
    return zeros(d.x)


def bulge(kind: str, body: Body, d: Vector) -> Vector:
    """The ellipsoid's farthest point along d, geom's frame."""
    axes = roundness(kind, body)
    if axes is None:
        return zeros(d.x)
    scaled = each(jnp.multiply, axes, d)
    length = norm(scaled)
    return each(lambda a, s: safe_divide(a * s, length), axes, scaled)


def roundness(kind: str, body: Body) -> Vector | None:
    """Semi-axes of the ellipsoid, geom's frame, m; None where it is a point."""
    if kind == "ellipsoid":
        return body.size
    if kind == "cylinder":
        return Vector(body.size[0], body.size[0], jnp.zeros_like(body.size[0]))
    return None


def radius(kind: str, body: Body) -> Array:
    """Of the ball, m."""
    return body.size[0] if kind in ("sphere", "capsule") else jnp.zeros_like(body.position.x)


def is_smooth(kind: str) -> bool:
    """Whether the ellipsoid is more than a point."""
    return kind in ("ellipsoid", "cylinder")


def _farthest(vertices: Array, d: Vector) -> Vector:
    def compare(best: tuple[Array, Array], vertex: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        position, number = vertex
        height = position[0] * d.x + position[1] * d.y + position[2] * d.z
        higher = height > best[0]
        return (jnp.where(higher, height, best[0]), jnp.where(higher, number, best[1])), None

    numbers = jnp.arange(len(vertices), dtype=jnp.int32)
    start = (jnp.full_like(d.x, -jnp.inf), jnp.zeros(d.x.shape, jnp.int32))
    (_, index), _ = lax.scan(compare, start, (vertices, numbers), unroll=_UNROLL)
    return Vector(vertices[:, 0][index], vertices[:, 1][index], vertices[:, 2][index])
