"""Three-vectors and rotations whose lanes trail: (3, *lanes) and (3, 3, *lanes)."""

import jax.numpy as jnp
from jax import Array

from jaxgrasp.arrays import safe_divide, safe_norm


def dot(a: Array, b: Array) -> Array:
    """Scalar product, (*lanes)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Array, b: Array) -> Array:
    """Vector product, (3, *lanes)."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def norm(a: Array) -> Array:
    """Length, with gradient 0 where it is 0, (*lanes)."""
    return safe_norm(a, 0)


def times(scale: Array, a: Array) -> Array:
    """Number (*lanes) times vector."""
    return scale[None] * a


def choose(condition: Array, a: Array, b: Array | float) -> Array:
    """One vector where a condition (*lanes) holds, the other where it does not."""
    return jnp.where(condition[None], a, b)


def unit(a: Array) -> Array:
    """The direction of a vector, and 0 where it has none."""
    return safe_divide(a, jnp.broadcast_to(norm(a)[None], a.shape))


def rotate(rotation: Array, a: Array) -> Array:
    """Rotation times vector: from the geom's frame to the common one."""
    return rotation[:, 0] * a[:1] + rotation[:, 1] * a[1:2] + rotation[:, 2] * a[2:]


def unrotate(rotation: Array, a: Array) -> Array:
    """Transpose of a rotation times vector: from the common frame to the geom's."""
    return jnp.stack([dot(rotation[:, i], a) for i in range(3)])


def pick(options: list[Array], index: Array) -> Array:
    """The option of the given number, lane by lane; `index` (*lanes), counted from 0."""
    chosen = options[0]
    for i, option in enumerate(options[1:], 1):
        chosen = jnp.where((index == i).reshape((1,) * (option.ndim - index.ndim) + index.shape), option, chosen)
    return chosen
