"""What disturbance sets are sums of: boxes, ellipsoids and balls here, vertices in `vertices`.

Each knows its support function.

Inside kernels the lanes trail: directions are (6, rows..., *lanes), the leaves of a term (event..., *lanes) with lanes
of size 1 where shared.

With a width w > 0 (N) the support functions are smooth and by some w larger: log-sum-exp of width w in place of the
maximum over vertices and the origin, sqrt(x^2 + w^2) in place of |x|.
"""

from dataclasses import Field, replace
from typing import Any, ClassVar, Protocol, Self

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold, safe_divide, safe_norm
from jaxgrasp.records import record


class Term(Protocol):
    """A convex set of wrenches that contains the origin: a record with a width that smooths it, None for none."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def width(self) -> jax.Array | None:
        """(*batch,), N, see above."""
        ...

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes, for batch-first leaves."""
        ...

    def spread_over(self, batch: tuple[int, ...]) -> Self:
        """Leaves broadcast to a batch shape, for batch-first leaves."""
        ...

    def rotated(self, rotation: jax.Array) -> "Term":
        """The set turned by rotations (*batch, 3, 3), for batch-first leaves."""
        ...

    def scaled(self, factor: jax.Array) -> "Term":
        """The set with all wrenches times factors (*batch,), for batch-first leaves."""
        ...

    def support(self, directions: jax.Array) -> jax.Array:
        """max(0, max over the set of a'w) for directions a (6, ..., *lanes)."""
        ...

    def furthest(self, directions: jax.Array) -> jax.Array:
        """The wrench of the set that reaches furthest along a, the gradient of `support`, (6, ..., *lanes)."""
        ...

    def extent(self) -> jax.Array:
        """The largest |w_i| for every component, (*batch, 6), for batch-first leaves.

        Negative or NaN where the data are not a set.
        """
        ...


def combine(weights: jax.Array, directions: jax.Array) -> jax.Array:
    """Sum over six components of weights (6, *lanes) with directions (6, ..., *lanes)."""
    total = align(weights[0], directions[0]) * directions[0]
    for i in range(1, 6):
        total = total + align(weights[i], directions[0]) * directions[i]
    return total


def _length(x: jax.Array, width: jax.Array | None) -> jax.Array:
    """|x| over the leading axis, or sqrt(|x|^2 + width^2)."""
    if width is None:
        return safe_norm(x, 0)
    aligned = align(width, x[0])
    return jnp.sqrt(fold(jnp.add, x * x) + aligned * aligned)


def common(own: tuple[int, ...], width: jax.Array | None) -> tuple[int, ...]:
    """Batch axes of a term with those of its width."""
    return own if width is None else jnp.broadcast_shapes(own, width.shape)


def spread(width: jax.Array | None, batch: tuple[int, ...]) -> jax.Array | None:
    """A width broadcast."""
    return None if width is None else jnp.broadcast_to(width, batch)


def checked(extent: jax.Array, width: jax.Array | None) -> jax.Array:
    """An extent, -1 where the width is not positive."""
    return extent if width is None else jnp.where((width > 0)[..., None], extent, -1)


def align(leaf: jax.Array, like: jax.Array) -> jax.Array:
    """Insert axes before the lanes, so that (*lanes) meets (rows..., *lanes)."""
    return leaf.reshape((1,) * (like.ndim - leaf.ndim) + leaf.shape) if leaf.ndim else leaf


@record
class Box:
    """|w_i| <= half_extents_i in a frame whose axes are columns of `axes` (None: the object's)."""

    half_extents: Float[Array, "*batch 6"]
    axes: Float[Array, "*batch 3 3"] | None
    width: Float[Array, "*batch"] | None = None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        own = common(self.half_extents.shape[:-1], self.width)
        return own if self.axes is None else jnp.broadcast_shapes(own, self.axes.shape[:-2])

    def spread_over(self, batch: tuple[int, ...]) -> "Box":
        """Broadcast."""
        axes = None if self.axes is None else jnp.broadcast_to(self.axes, (*batch, 3, 3))
        half_extents = jnp.broadcast_to(self.half_extents, (*batch, 6))
        return Box(half_extents=half_extents, axes=axes, width=spread(self.width, batch))

    def rotated(self, rotation: jax.Array) -> "Box":
        """Turn the axes."""
        return replace(self, axes=rotation if self.axes is None else rotation @ self.axes)

    def scaled(self, factor: jax.Array) -> "Box":
        """Scale the half extents."""
        return replace(self, half_extents=factor[..., None] * self.half_extents)

    def support(self, directions: jax.Array) -> jax.Array:
        """Sum of |a_i| r_i, a in the box's frame."""
        turned = self._turned(directions)
        if self.width is None:
            return combine(self.half_extents, jnp.abs(turned))
        return fold(
            jnp.add,
            [_length((align(r, t) * t)[None], self.width) for r, t in zip(self.half_extents, turned, strict=True)],
        )

    def furthest(self, directions: jax.Array) -> jax.Array:
        """A corner, or the middle of a face."""
        turned = self._turned(directions)
        if self.width is None:
            corner = [align(r, t) * jnp.sign(t) for r, t in zip(self.half_extents, turned, strict=True)]
        else:
            reach = [align(r, t) * t for r, t in zip(self.half_extents, turned, strict=True)]
            corner = [
                align(r, x) * x / _length(x[None], self.width) for r, x in zip(self.half_extents, reach, strict=True)
            ]
        if self.axes is None:
            return jnp.stack(corner)
        axes = self.axes
        back = [
            sum(align(axes[r, c], corner[0]) * corner[half + c] for c in range(3)) for half in (0, 3) for r in range(3)
        ]
        return jnp.stack(back)

    def _turned(self, directions: jax.Array) -> jax.Array:
        """Directions in the box's frame."""
        axes = self.axes
        if axes is None:
            return directions
        columns = [
            sum(align(axes[r, c], directions[0]) * directions[half + r] for r in range(3))
            for half in (0, 3)
            for c in range(3)
        ]
        return jnp.stack(columns)

    def extent(self) -> jax.Array:
        """Half extents, turned; negative ones stay negative."""
        if self.axes is None:
            return checked(self.half_extents, self.width)
        halves = self.half_extents.reshape(*self.half_extents.shape[:-1], 2, 3)
        turned = jnp.einsum("...rc,...hc->...hr", jnp.abs(self.axes), halves).reshape(*self.batch_shape, 6)
        return checked(jnp.where((self.half_extents >= 0).all(-1, keepdims=True), turned, -1), self.width)


@record
class Ellipsoid:
    """L u with |u| <= 1."""

    shape_matrix: Float[Array, "*batch 6 6"]
    width: Float[Array, "*batch"] | None = None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return common(self.shape_matrix.shape[:-2], self.width)

    def spread_over(self, batch: tuple[int, ...]) -> "Ellipsoid":
        """Broadcast."""
        shape_matrix = jnp.broadcast_to(self.shape_matrix, (*batch, 6, 6))
        return Ellipsoid(shape_matrix=shape_matrix, width=spread(self.width, batch))

    def rotated(self, rotation: jax.Array) -> "Ellipsoid":
        """R acts on force and moment rows alike."""
        halves = self.shape_matrix.reshape(*self.shape_matrix.shape[:-2], 2, 3, 6)
        turned = jnp.einsum("...ij,...hjk->...hik", rotation, halves)
        return replace(self, shape_matrix=turned.reshape(*turned.shape[:-3], 6, 6))

    def scaled(self, factor: jax.Array) -> "Ellipsoid":
        """Scale L."""
        return replace(self, shape_matrix=factor[..., None, None] * self.shape_matrix)

    def support(self, directions: jax.Array) -> jax.Array:
        """|L'a|."""
        return _length(self._pulled(directions), self.width)

    def furthest(self, directions: jax.Array) -> jax.Array:
        """L L'a / |L'a|."""
        pulled = self._pulled(directions)
        unit = safe_divide(pulled, _length(pulled, self.width))
        return jnp.stack([combine(self.shape_matrix[r], unit) for r in range(6)])

    def _pulled(self, directions: jax.Array) -> jax.Array:
        """L'a."""
        return jnp.stack([combine(self.shape_matrix[:, c], directions) for c in range(6)])

    def extent(self) -> jax.Array:
        """Row norms; not the safe norm, which hides NaN."""
        return checked(jnp.linalg.norm(self.shape_matrix, axis=-1), self.width)


@record
class Ball:
    """A ball of forces and, independently, one of moments."""

    force: Float[Array, "*batch"]
    torque: Float[Array, "*batch"]
    width: Float[Array, "*batch"] | None = None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return common(jnp.broadcast_shapes(self.force.shape, self.torque.shape), self.width)

    def spread_over(self, batch: tuple[int, ...]) -> "Ball":
        """Broadcast."""
        force, torque = jnp.broadcast_to(self.force, batch), jnp.broadcast_to(self.torque, batch)
        return Ball(force=force, torque=torque, width=spread(self.width, batch))

    def rotated(self, rotation: jax.Array) -> "Ball":
        """A ball stays what it is, but for what is no rotation."""
        return replace(self, force=self.force + 0 * rotation[..., 0, 0])

    def scaled(self, factor: jax.Array) -> "Ball":
        """Scale both radii."""
        return replace(self, force=factor * self.force, torque=factor * self.torque)

    def support(self, directions: jax.Array) -> jax.Array:
        """Force |a_f| + torque |a_m|."""
        halves = self._scaled(directions)
        return sum(_length(half, self.width) for half in halves)  # pyright: ignore[reportReturnType]  # no sum of none

    def furthest(self, directions: jax.Array) -> jax.Array:
        """Radii times unit vectors."""
        radii = (self.force, self.torque)
        halves = [
            align(r, half) * safe_divide(half, _length(half, self.width))
            for r, half in zip(radii, self._scaled(directions), strict=True)
        ]
        return jnp.concatenate(halves)

    def _scaled(self, directions: jax.Array) -> tuple[jax.Array, jax.Array]:
        return align(self.force, directions) * directions[:3], align(self.torque, directions) * directions[3:]

    def extent(self) -> jax.Array:
        """Radii."""
        force, torque = jnp.broadcast_arrays(self.force, self.torque)
        return checked(jnp.stack([*[force] * 3, *[torque] * 3], -1), self.width)
