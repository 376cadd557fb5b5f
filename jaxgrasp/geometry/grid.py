"""A shape whose distance is looked up: quadratic B-splines on a regular grid."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold, safe_norm
from jaxgrasp.geometry.shape import Shape
from jaxgrasp.records import record


@record
class DistanceGrid(Shape):
    """Signed distances at the nodes of a grid and, between them, once continuously differentiable.

    A look-up takes 27 numbers, however intricate the object is. Features below the spacing of the grid are rounded off.
    """

    coefficients: Float[Array, "x y z"]
    """Of the B-splines that are centred at the nodes, m."""
    origin: Float[Array, "3"]
    """The node (0, 0, 0), m."""
    spacing: Float[Array, ""]
    """Between neighbouring nodes, the same along all axes, m."""
    lower: Float[Array, "3"]
    """Lower corner of a box that holds the surface, m."""
    upper: Float[Array, "3"]
    """Upper corner of it, m."""

    @classmethod
    def from_samples(
        cls, values: np.ndarray, *, origin: np.ndarray, spacing: float, lower: np.ndarray, upper: np.ndarray
    ) -> "DistanceGrid":
        """The spline that takes the given values at the nodes.

        Args:
            values: (nx, ny, nz), signed distances at origin + spacing (i, j, k), m; at least three nodes an axis.
            origin: (3,), m.
            spacing: m.
            lower: (3,), lower corner of a box that holds the surface, itself at least two spacings inside the grid, m.
            upper: (3,), its upper corner, m.

        Raises:
            ValueError: values of another shape or not finite.
        """
        if values.ndim != 3 or min(values.shape) < 3 or not np.isfinite(values).all():
            raise ValueError(f"values: got shape {values.shape}, wanted finite numbers (nx, ny, nz), 3 or more an axis")
        coefficients = np.asarray(values, float)
        for axis in range(3):
            coefficients = np.moveaxis(
                np.tensordot(_interpolation(values.shape[axis]), coefficients, (1, axis)), 0, axis
            )
        precise = jnp.result_type(float)
        return cls(
            coefficients=jnp.asarray(coefficients, precise),
            origin=jnp.asarray(origin, precise),
            spacing=jnp.asarray(spacing, precise),
            lower=jnp.asarray(lower, precise),
            upper=jnp.asarray(upper, precise),
        )

    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """See `Shape.distance`. Off the grid, that at its nearest point plus the distance to that."""
        counts = self.coefficients.shape
        places = (points - self.origin) / self.spacing
        ends = jnp.asarray(np.array(counts) - 1.5, places.dtype)
        held = jnp.clip(places, jnp.asarray(0.5, places.dtype), ends)
        # The gradient ends with the index: a spline's pieces are polynomials in what is left.
        nearest = jnp.clip(jnp.round(lax.stop_gradient(held)).astype(jnp.int32), 1, jnp.array(counts, jnp.int32) - 2)
        rest = jnp.moveaxis(held - nearest.astype(held.dtype), -1, 0)
        weights = jnp.stack([0.5 * (0.5 - rest) ** 2, 0.75 - rest**2, 0.5 * (0.5 + rest) ** 2])
        strides = (counts[1] * counts[2], counts[2], 1)
        start = fold(jnp.add, [nearest[..., axis] * strides[axis] for axis in range(3)])
        nodes = np.arange(-1, 2, dtype=np.int32)
        offsets = nodes[:, None, None] * strides[0] + nodes[:, None] * strides[1] + nodes * strides[2]
        offsets = jnp.asarray(offsets.reshape(3, 3, 3, *[1] * start.ndim), jnp.int32)
        # Points trail: look-ups and sums over leading axes run in full vectors.
        total = self.coefficients.reshape(-1).at[start + offsets].get(mode="promise_in_bounds")
        for axis in (2, 1, 0):
            total = fold(jnp.add, jnp.moveaxis(total, axis, 0) * weights[:, axis].reshape(3, *[1] * axis, *start.shape))
        return total + safe_norm(places - held) * self.spacing

    @property
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """See `Shape.bounds`."""
        return self.lower, self.upper


def _interpolation(count: int) -> np.ndarray:
    """From values at the nodes to coefficients; the spline continues beyond the ends as if mirrored there."""
    matrix = (6 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)) / 8
    matrix[0, 0] += 1 / 8
    matrix[-1, -1] += 1 / 8
    return np.linalg.inv(matrix)
