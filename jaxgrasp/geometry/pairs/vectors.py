"""Three-vectors of lanes, spelt out by component: XLA's CPU code for stacked ones branches in every element."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxgrasp.arrays import safe_divide

T = TypeVar("T")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Vector:
    """A vector a lane; every component is (*lanes)."""

    x: Array
    y: Array
    z: Array

    @classmethod
    def unstacked(cls, array: Array) -> "Vector":
        """From (3, *lanes)."""
        return cls(array[0], array[1], array[2])

    def stacked(self) -> Array:
        """As (3, *lanes)."""
        return jnp.stack([self.x, self.y, self.z])

    def __getitem__(self, index: int) -> Array:
        return (self.x, self.y, self.z)[index]

    def __add__(self, other: "Vector") -> "Vector":
        return Vector(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vector") -> "Vector":
        return Vector(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> "Vector":
        return Vector(-self.x, -self.y, -self.z)

    def __mul__(self, scale: ArrayLike) -> "Vector":
        return Vector(self.x * scale, self.y * scale, self.z * scale)

    __rmul__ = __mul__


Rotation = tuple[Vector, Vector, Vector]
"""Its columns."""


def each(function: Callable[..., Array], *vectors: Vector) -> Vector:
    """A function of components, component by component."""
    return Vector(*(function(*(v[i] for v in vectors)) for i in range(3)))


def dot(a: Vector, b: Vector) -> Array:
    """Scalar product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def root(x: Array) -> Array:
    """Square root of what is not negative, with gradient 0 at 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def norm(a: Vector) -> Array:
    """Length, with gradient 0 where it is 0."""
    return root(dot(a, a))


def unit(a: Vector) -> Vector:
    """The direction of a vector, and 0 where it has none."""
    return a * safe_divide(jnp.ones_like(a.x), norm(a))


def zeros(like: Array) -> Vector:
    """The zero vector."""
    return Vector(*[jnp.zeros_like(like)] * 3)


def axis(number: int, like: Array) -> Vector:
    """The x, y or z axis."""
    return Vector(*(jnp.full_like(like, float(i == number)) for i in range(3)))


def least_along(d: Vector) -> Vector:
    """The axis that d is least along."""
    x, y, z = (jnp.abs(d[i]) for i in range(3))
    is_x = (x <= y) & (x <= z)
    is_y = ~is_x & (y <= z)
    return Vector(*(jnp.where(mark, 1, 0).astype(d.x.dtype) for mark in (is_x, is_y, ~is_x & ~is_y)))


def rotate(rotation: Rotation, a: Vector) -> Vector:
    """Rotation times vector: from the geom's frame to the common one."""
    return rotation[0] * a.x + rotation[1] * a.y + rotation[2] * a.z


def unrotate(rotation: Rotation, a: Vector) -> Vector:
    """Transpose of a rotation times vector: from the common frame to the geom's."""
    return Vector(dot(rotation[0], a), dot(rotation[1], a), dot(rotation[2], a))


def choose(condition: Array, a: T, b: T) -> T:
    """One tree of lanes where a condition (*lanes) holds, the other where it does not."""
    return jax.tree.map(lambda one, other: jnp.where(condition, one, other), a, b)


def pick(options: list[T], index: Array) -> T:
    """The option of the given number, lane by lane, counted from 0."""
    chosen = options[0]
    for i, option in enumerate(options[1:], 1):
        chosen = choose(index == i, option, chosen)
    return chosen
