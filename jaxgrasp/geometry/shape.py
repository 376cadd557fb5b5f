"""What every shape answers."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float


class Shape(ABC):
    """A solid by its signed distance, in metres and in the object's frame.

    The distance is negative inside, zero on the surface and, at the surface, true to first order: its gradient there is
    the outward unit normal. Farther away it may be off in size but not in sign. Shapes are pytrees of arrays, and their
    distances are differentiable with respect to the points and to their own sizes.
    """

    @abstractmethod
    def distance(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Signed distance, m.

        Args:
            points: (*batch, 3), m, object frame.
        """

    @property
    @abstractmethod
    def bounds(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Lower and upper corner of a box along the axes that holds the shape, m."""


def size(name: str, value: ArrayLike | Sequence[float], event: tuple[int, ...], *, zero: bool = False) -> Array:
    """A length or lengths, checked.

    Args:
        name: the argument's name, for the error.
        value: what the caller gave.
        event: wanted shape.
        zero: whether zero is a length, too.

    Raises:
        ValueError: another shape, not finite, negative, or zero where that is none.
    """
    array = as_float(name, value, event)
    if array.shape != event:
        raise ValueError(f"{name}: got shape {array.shape}, wanted {event}")
    if not bool(jnp.isfinite(array).all() & ((array >= 0) if zero else (array > 0)).all()):
        raise ValueError(f"{name}: got {array.tolist()}, wanted finite and {'not negative' if zero else 'positive'}, m")
    return array
