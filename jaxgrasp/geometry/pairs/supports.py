"""What every convex kind is made of: a polyhedron, plus an ellipsoid, plus a ball."""

import jax.numpy as jnp
from jax import Array, lax

from jaxgrasp.arrays import safe_divide
from jaxgrasp.geometry.pairs.geom import Geom
from jaxgrasp.geometry.pairs.vectors import norm

# Corners of a hull tried at a time.
_UNROLL = 8


def corner(kind: str, geom: Geom, d: Array) -> Array:
    """The polyhedron's corner farthest along d (3, *lanes), geom's frame."""
    if kind in ("sphere", "ellipsoid"):
        return jnp.zeros_like(d)
    side = jnp.where(d < 0, -1, 1).astype(d.dtype)
    if kind in ("capsule", "cylinder"):
        return jnp.stack([*jnp.zeros_like(d[:2]), side[2] * geom.size[1]])
    if kind == "box":
        return side * geom.size
    return _farthest(geom.hull.vertices.astype(d.dtype), d)


def bulge(kind: str, geom: Geom, d: Array) -> Array:
    """The ellipsoid's farthest point along d (3, *lanes), geom's frame."""
    axes = roundness(kind, geom)
    if axes is None:
        return jnp.zeros_like(d)
    scaled = axes * d
    return axes * safe_divide(scaled, jnp.broadcast_to(norm(scaled)[None], d.shape))


def roundness(kind: str, geom: Geom) -> Array | None:
    """Semi-axes of the ellipsoid (3, *lanes), geom's frame, m; None where it is a point."""
    if kind == "ellipsoid":
        return geom.size
    if kind == "cylinder":
        return jnp.stack([geom.size[0], geom.size[0], jnp.zeros_like(geom.size[0])])
    return None


def radius(kind: str, geom: Geom) -> Array:
    """Of the ball (*lanes), m."""
    return geom.size[0] if kind in ("sphere", "capsule") else jnp.zeros_like(geom.position[0])


def is_smooth(kind: str) -> bool:
    """Whether the ellipsoid is more than a point."""
    return kind in ("ellipsoid", "cylinder")


def _farthest(vertices: Array, d: Array) -> Array:
    def compare(best: tuple[Array, Array], vertex: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        position, number = vertex
        height = position[0] * d[0] + position[1] * d[1] + position[2] * d[2]
        higher = height > best[0]
        return (jnp.where(higher, height, best[0]), jnp.where(higher, number, best[1])), None

    numbers = jnp.arange(len(vertices), dtype=jnp.int32)
    start = (jnp.full_like(d[0], -jnp.inf), jnp.zeros(d.shape[1:], jnp.int32))
    (_, index), _ = lax.scan(compare, start, (vertices, numbers), unroll=_UNROLL)
    return jnp.moveaxis(vertices[index], -1, 0)
