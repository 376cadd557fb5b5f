"""Spheres, ellipsoids, boxes, capsules, cylinders and superquadrics about the origin of the object's frame."""

from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, fold, safe_divide, safe_norm
from jaxgrasp.geometry.shape import Shape, size
from jaxgrasp.records import record


@record
class Sphere(Shape):
    """A ball."""

    radius: Float[Array, ""]
    """m."""

    @classmethod
    def from_radius(cls, radius: ArrayLike) -> "Sphere":
        """A ball of the given radius, m.

        Raises:
            ValueError: not one positive number.
        """
        return cls(radius=size("radius", radius, ()))

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Exact, see `Shape.distance`."""
        return safe_norm(points) - self.radius

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        return _about_origin(jnp.stack([self.radius] * 3))


@record
class Superquadric(Shape):
    """The points with (|x/a|^q + |y/b|^q)^(p/q) + |z/c|^p <= 1: ellipsoids, and boxes and cylinders without edges."""

    semi_axes: Float[Array, "3"]
    """a, b and c, m."""
    exponents: Float[Array, "2"]
    """p, of the outlines through the z axis, and q, of the outline across it; 2 is round, larger is boxier."""

    @classmethod
    def from_semi_axes(
        cls, semi_axes: ArrayLike, exponents: ArrayLike | Sequence[float] = (4.0, 4.0)
    ) -> "Superquadric":
        """A superquadric.

        Args:
            semi_axes: (3,), m.
            exponents: (2,), p and q, at least 2: below, the surface has edges or is hollow.

        Raises:
            ValueError: another shape, or sizes that are out of bounds.
        """
        powers = size("exponents", exponents, (2,))
        if not bool((powers >= 2).all()):
            raise ValueError(f"exponents: got {powers.tolist()}, wanted at least 2")
        return cls(semi_axes=size("semi_axes", semi_axes, (3,)), exponents=powers)

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """(h - 1) / |grad h| for the norm h whose unit ball the shape is: true to first order at the surface."""
        p, q = self.exponents
        scaled = jnp.abs(points / self.semi_axes)
        # A norm is the same times any factor: near the origin the powers would underflow.
        largest = fold(jnp.maximum, jnp.moveaxis(scaled, -1, 0))
        safe = jnp.where(largest > 0, largest, 1)
        x, y, z = jnp.moveaxis(scaled / safe[..., None], -1, 0)
        across = _norm(x, y, q)
        norm = _norm(across, z, p)
        inner, outer = safe_divide(across, norm) ** (p - 1), safe_divide(z, norm) ** (p - 1)
        slopes = [inner * safe_divide(x, across) ** (q - 1), inner * safe_divide(y, across) ** (q - 1), outer]
        steepness = safe_norm(jnp.stack(slopes, -1) / self.semi_axes)
        centre = largest == 0
        return jnp.where(
            centre, -jnp.min(self.semi_axes), (norm * safe - 1) / jnp.where(centre, 1, jnp.maximum(steepness, 1e-30))
        )

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        return _about_origin(self.semi_axes)


@record
class Ellipsoid(Shape):
    """The points with |(x/a, y/b, z/c)| <= 1."""

    semi_axes: Float[Array, "3"]
    """a, b and c, m."""

    @classmethod
    def from_semi_axes(cls, semi_axes: ArrayLike) -> "Ellipsoid":
        """An ellipsoid of the given semi-axes (3,), m.

        Raises:
            ValueError: not three positive numbers.
        """
        return cls(semi_axes=size("semi_axes", semi_axes, (3,)))

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """(h - 1) / |grad h| with h = |(x/a, y/b, z/c)|: true to first order at the surface."""
        scaled = points / self.semi_axes
        norm = safe_norm(scaled)
        ratio = safe_divide(norm, safe_norm(scaled / self.semi_axes))
        return (norm - 1) * jnp.where(norm > 0, ratio, jnp.min(self.semi_axes))

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        return _about_origin(self.semi_axes)


@record
class Box(Shape):
    """A box along the axes, its edges rounded."""

    half_extents: Float[Array, "3"]
    """m, rounding included."""
    rounding: Float[Array, ""]
    """Radius of edges and corners, m."""

    @classmethod
    def from_half_extents(cls, half_extents: ArrayLike, rounding: ArrayLike = 0.0) -> "Box":
        """A box.

        Args:
            half_extents: (3,), m, rounding included.
            rounding: radius of edges and corners, m; 0 for sharp ones, where the normal jumps.

        Raises:
            ValueError: another shape, not positive, or a rounding larger than the box.
        """
        half = size("half_extents", half_extents, (3,))
        return cls(half_extents=half, rounding=_rounding(rounding, half))

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Exact, see `Shape.distance`."""
        return _corner(jnp.abs(points) - self.half_extents, self.rounding)

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        return _about_origin(self.half_extents)


@record
class Capsule(Shape):
    """A cylinder along z with half balls on its ends."""

    radius: Float[Array, ""]
    """m."""
    half_length: Float[Array, ""]
    """Half the height without the half balls, m."""

    @classmethod
    def from_radius(cls, radius: ArrayLike, half_length: ArrayLike) -> "Capsule":
        """A capsule along z; half_length is without the half balls. Both in m.

        Raises:
            ValueError: not positive numbers.
        """
        return cls(radius=size("radius", radius, ()), half_length=size("half_length", half_length, ()))

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Exact, see `Shape.distance`."""
        x, y, z = jnp.moveaxis(points, -1, 0)
        beyond = z - jnp.clip(z, -self.half_length, self.half_length)
        return safe_norm(jnp.stack([x, y, beyond], -1)) - self.radius

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        return _about_origin(jnp.stack([self.radius, self.radius, self.radius + self.half_length]))


@record
class Cylinder(Shape):
    """A cylinder along z, its two edges rounded."""

    radius: Float[Array, ""]
    """m."""
    half_length: Float[Array, ""]
    """Half the height, m."""
    rounding: Float[Array, ""]
    """Radius of the edges, m."""

    @classmethod
    def from_radius(cls, radius: ArrayLike, half_length: ArrayLike, rounding: ArrayLike = 0.0) -> "Cylinder":
        """A cylinder along z.

        Args:
            radius: m.
            half_length: half the height, m.
            rounding: radius of the edges, m; 0 for sharp ones, where the normal jumps.

        Raises:
            ValueError: not positive, or a rounding larger than the cylinder.
        """
        radius, half_length = size("radius", radius, ()), size("half_length", half_length, ())
        rounding = _rounding(rounding, jnp.stack([radius, half_length]))
        return cls(radius=radius, half_length=half_length, rounding=rounding)

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Exact, see `Shape.distance`."""
        outwards = safe_norm(points[..., :2]) - self.radius
        return _corner(jnp.stack([outwards, jnp.abs(points[..., 2]) - self.half_length], -1), self.rounding)

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        return _about_origin(jnp.stack([self.radius, self.radius, self.half_length]))


def _about_origin(half: Array) -> tuple[Array, Array]:
    return -half, half


def _rounding(value: ArrayLike, sizes: Array) -> Array:
    rounding = as_float("rounding", value, ()).astype(sizes.dtype)
    if rounding.shape != () or not bool((rounding >= 0) & (rounding <= jnp.min(sizes))):
        raise ValueError(f"rounding: got {rounding.tolist()}, wanted from 0 to {float(jnp.min(sizes)):g} m")
    return rounding


def _corner(beyond: Array, rounding: Array) -> Array:
    """Distance to a rounded corner, from how far a point lies beyond each of the faces that meet there."""
    core = beyond + rounding
    inside = fold(jnp.maximum, jnp.moveaxis(core, -1, 0))
    return safe_norm(jnp.maximum(core, 0)) + jnp.minimum(inside, 0) - rounding


def _norm(a: Array, b: Array, power: Array) -> Array:
    """(a^power + b^power)^(1/power) of numbers that are not negative, with gradient 0 at the origin."""
    total = a**power + b**power
    positive = total > 0
    return jnp.where(positive, jnp.where(positive, total, 1) ** (1 / power), 0)
