"""A shape whose distance is looked up: quadratic B-splines on a regular grid."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxgrasp.arrays import safe_norm
from jaxgrasp.geometry.shape import Shape


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
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
        shape = np.array(self.coefficients.shape)
        places = (points - self.origin) / self.spacing
        held = jnp.clip(places, jnp.asarray(0.5, places.dtype), jnp.asarray(shape - 1.5, places.dtype))
        # The gradient ends with the index: a spline's pieces are polynomials in what is left.
        nearest = jnp.clip(jnp.round(lax.stop_gradient(held)).astype(jnp.int32), 1, jnp.asarray(shape - 2, jnp.int32))
        rest = held - nearest.astype(held.dtype)
        weights = jnp.stack([0.5 * (0.5 - rest) ** 2, 0.75 - rest**2, 0.5 * (0.5 + rest) ** 2], -1)
        x, y, z = jnp.moveaxis(weights, -2, 0)
        strides = np.array([shape[1] * shape[2], shape[2], 1], np.int32)
        offsets = sum(np.arange(-1, 2, dtype=np.int32).reshape(-1, *[1] * (2 - i)) * strides[i] for i in range(3))
        start = jnp.sum(nearest * jnp.asarray(strides), -1, dtype=jnp.int32)
        window = self.coefficients.reshape(-1)[start[..., None, None, None] + jnp.asarray(offsets)]
        value = jnp.sum(x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :] * window, (-3, -2, -1))
        return value + safe_norm(places - held) * self.spacing

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
