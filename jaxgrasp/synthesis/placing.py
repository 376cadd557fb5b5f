"""Where contacts may be: on the surface, not on top of each other, and within a hand's reach."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import safe_divide, safe_norm
from jaxgrasp.geometry import Shape, project

# Each round of moves is followed by one Newton step: moves along the tangent plane leave it little to do.
_ROUNDS = 3


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Placing:
    """A surface, and how far apart contacts on it may be."""

    shape: Shape
    """The object."""
    spacing: Float[Array, ""]
    """Least distance of two contacts whose normals point to the same side, m: fingertips there would collide."""
    span: Float[Array, ""]
    """Largest distance of any two contacts, m."""
    slack: Float[Array, ""]
    """How much farther corrections go than spacing and span ask, m."""

    def corrected(
        self, points: Float[Array, "*batch contacts 3"], outward: Float[Array, "*batch contacts 3"]
    ) -> Float[Array, "*batch contacts 3"]:
        """The points on the surface and moved, pair by pair, to where spacing and span want them.

        Each of a pair goes half of the way, a little farther than wanted; a few rounds nearly settle what many pairs
        want at once.

        Args:
            points: m, near the surface.
            outward: normals there or near.
        """

        def settle(_: int, points: Array) -> Array:
            gaps, distances, missing = self._pairs(points, outward, self.slack)
            moves = 0.5 * jnp.sum(safe_divide(gaps, distances[..., None]) * missing[..., None], -2)
            return project(self.shape, points + moves, 1)

        return jax.lax.fori_loop(0, _ROUNDS, settle, project(self.shape, points, 1))

    def shortfall(
        self, points: Float[Array, "*batch contacts 3"], outward: Float[Array, "*batch contacts 3"]
    ) -> Float[Array, "*batch"]:
        """By how much the worst pair misses spacing or span, m; 0 where none does."""
        return jnp.max(jnp.abs(self._pairs(points, outward, 0)[2]), (-2, -1))

    def _pairs(self, points: Array, outward: Array, slack: ArrayLike) -> tuple[Array, Array, Array]:
        """For each pair: the way from the second to the first, its length, and how much longer it should be."""
        gaps = points[..., :, None, :] - points[..., None, :, :]
        distances = safe_norm(gaps)
        beside = jnp.sum(outward[..., :, None, :] * outward[..., None, :, :], -1) > 0
        beside = beside & ~jnp.eye(points.shape[-2], dtype=bool)
        too_near = jnp.where(beside, jnp.maximum(self.spacing + slack - distances, 0), 0)
        return gaps, distances, too_near - jnp.maximum(distances - self.span + slack, 0)
