"""Shapes made of others: smooth unions, and shapes that are moved and turned."""

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float
from jaxgrasp.geometry.shape import Shape, size
from jaxgrasp.records import record

# Rotations are refused beyond this: single precision leaves 1e-6.
_ORTHOGONAL = 1e-4


@record
class SmoothUnion(Shape):
    """Two shapes in one, with a fillet where they meet."""

    first: Shape
    """One."""
    second: Shape
    """The other."""
    blend: Float[Array, ""]
    """Width of the fillet: it is where the two distances differ by less, m."""

    @classmethod
    def from_shapes(cls, first: Shape, second: Shape, blend: ArrayLike) -> "SmoothUnion":
        """The union of two shapes.

        Args:
            first: one.
            second: the other.
            blend: the width of the fillet, m.

        Raises:
            ValueError: blend is not positive.
        """
        return cls(first=first, second=second, blend=size("blend", blend, ()))

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """The polynomial smooth minimum of the two distances, once continuously differentiable.

        In the fillet it grows more slowly than the distance, since its gradient is a mean of two unit vectors.
        """
        a, b = self.first.distance(points), self.second.distance(points)
        near = jnp.maximum(1 - jnp.abs(a - b) / self.blend, 0)
        return jnp.minimum(a, b) - 0.25 * self.blend * near**2

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`; the fillet adds at most a quarter of its width."""
        (low_a, high_a), (low_b, high_b) = self.first.bounds, self.second.bounds
        fillet = 0.25 * self.blend
        return jnp.minimum(low_a, low_b) - fillet, jnp.maximum(high_a, high_b) + fillet


@record
class Placed(Shape):
    """A shape that is turned about its own origin and then moved."""

    shape: Shape
    """The shape in its own frame."""
    rotation: Float[Array, "3 3"]
    """R_object_shape: columns are the shape's axes in the object's frame."""
    translation: Float[Array, "3"]
    """The shape's origin in the object's frame, m."""

    @classmethod
    def from_pose(
        cls,
        shape: Shape,
        *,
        translation: ArrayLike | Sequence[float] = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
    ) -> "Placed":
        """A shape at a pose in the object's frame.

        Args:
            shape: the shape in its own frame.
            translation: (3,), m.
            rotation: (3, 3), columns are the shape's axes in the object's frame; None for no rotation.

        Raises:
            ValueError: another shape of array, not finite, or no rotation.
        """
        offset = as_float("translation", translation, (3,))
        turn = as_float("rotation", jnp.eye(3, dtype=offset.dtype) if rotation is None else rotation, (3, 3))
        if offset.shape != (3,) or not bool(jnp.isfinite(offset).all()):
            raise ValueError(f"translation: got {offset.tolist()}, wanted three finite numbers, m")
        off = np.abs(np.asarray(turn).T @ np.asarray(turn) - np.eye(3)).max() if turn.shape == (3, 3) else np.inf
        if not (off < _ORTHOGONAL and np.linalg.det(np.asarray(turn)) > 0):
            raise ValueError(f"rotation: got {turn.tolist()}, wanted a rotation (3, 3)")
        return cls(shape=shape, rotation=turn, translation=offset)

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """See `Shape.distance`."""
        return self.shape.distance(jnp.einsum("ji,...j->...i", self.rotation, points - self.translation))

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        corners = [
            jnp.stack([ends[side][axis] for axis, side in enumerate(sides)])
            for ends in [self.shape.bounds]
            for sides in itertools.product((0, 1), repeat=3)
        ]
        turned = jnp.stack(corners) @ self.rotation.T + self.translation
        return turned.min(0), turned.max(0)
