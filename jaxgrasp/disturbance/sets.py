"""Disturbance sets and their Minkowski sums."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.compiling import own_settings
from jaxgrasp.disturbance.terms import Ball, Box, Ellipsoid, Term
from jaxgrasp.disturbance.vertices import Vertices
from jaxgrasp.records import record


@record
class DisturbanceSet:
    """A convex set D of wrenches that contains the origin; force N, moment N m, object frame, about the centre of mass.

    The robustness margin is the largest factor by which D may be scaled while the grasp holds. Sets add up (Minkowski
    sum): ``a + b`` is every wrench of a with every wrench of b. A set without batch axes is shared by all grasps and
    costs no memory.
    """

    terms: tuple[Term, ...]
    """The sets whose Minkowski sum this is."""

    @classmethod
    def vertices(cls, wrenches: ArrayLike) -> "DisturbanceSet":
        """The convex hull of given wrenches and the origin.

        Args:
            wrenches: (*batch, n_d, 6); zero rows change nothing, so ragged sets may be padded with them.

        Raises:
            ValueError: another shape.
        """
        given = as_float("wrenches", wrenches, ("n_d", 6))
        return cls(
            terms=(Vertices(wrenches=given if given.shape[-2] else jnp.zeros((*given.shape[:-2], 1, 6), given.dtype)),)
        )

    @classmethod
    @own_settings()
    def forces(cls, magnitude: ArrayLike = 1.0) -> "DisturbanceSet":
        """The six forces along +-x, +-y, +-z of section V, without moment.

        Args:
            magnitude: (*batch,), N.
        """
        size = as_float("magnitude", magnitude, ())
        # NumPy's, since every operation of JAX's outside a program is a program of its own.
        axes = np.eye(3, 6, dtype=size.dtype)
        return cls(terms=(Vertices(wrenches=size[..., None, None] * np.concatenate([axes, -axes])),))

    @classmethod
    def box(cls, half_extents: ArrayLike) -> "DisturbanceSet":
        """All wrenches with |w_i| <= half_extents_i.

        Args:
            half_extents: (*batch, 6), N and N m, >= 0.

        Raises:
            ValueError: another shape.
        """
        return cls(terms=(Box(half_extents=as_float("half_extents", half_extents, (6,)), axes=None),))

    @classmethod
    def ellipsoid(cls, shape_matrix: ArrayLike) -> "DisturbanceSet":
        """All wrenches L u with |u| <= 1.

        Args:
            shape_matrix: (*batch, 6, 6), L.

        Raises:
            ValueError: another shape.
        """
        return cls(terms=(Ellipsoid(shape_matrix=as_float("shape_matrix", shape_matrix, (6, 6))),))

    @classmethod
    def ball(cls, force: ArrayLike = 1.0, torque: ArrayLike = 0.0) -> "DisturbanceSet":
        """All wrenches with |w_f| <= force and, independently, |w_m| <= torque.

        Args:
            force: (*batch,), N, >= 0.
            torque: (*batch,), N m, >= 0.
        """
        return cls(terms=(Ball(force=as_float("force", force, ()), torque=as_float("torque", torque, ())),))

    def __add__(self, other: "DisturbanceSet") -> "DisturbanceSet":
        """The Minkowski sum."""
        if not isinstance(other, DisturbanceSet):
            return NotImplemented
        return DisturbanceSet(terms=self.terms + other.terms)

    @own_settings()
    def rotated(self, rotation: ArrayLike) -> "DisturbanceSet":
        """The same set given in another frame, in the object's.

        Args:
            rotation: (*batch, 3, 3), R_object_other: columns are the other frame's axes in the object frame. One that
                is no rotation makes its grasp `Status.INVALID_INPUT`.

        Raises:
            ValueError: another shape.
        """
        turn = as_float("rotation", rotation, (3, 3))
        apart = jnp.abs(jnp.swapaxes(turn, -1, -2) @ turn - jnp.eye(3, dtype=turn.dtype)).max((-2, -1))
        handed = jnp.sum(jnp.cross(turn[..., 0], turn[..., 1]) * turn[..., 2], -1)
        sound = (apart <= (1e-6 if turn.dtype == jnp.float64 else 1e-4)) & (handed > 0)
        turn = jnp.where(sound[..., None, None], turn, jnp.nan)
        return DisturbanceSet(terms=tuple(term.rotated(turn) for term in self.terms))

    @own_settings()
    def scaled(self, factor: ArrayLike) -> "DisturbanceSet":
        """The same set, larger or smaller.

        Args:
            factor: (*batch,), >= 0.
        """
        given = as_float("factor", factor, ())
        return DisturbanceSet(terms=tuple(term.scaled(given) for term in self.terms))

    @own_settings()
    def smoothed(self, width: ArrayLike) -> "DisturbanceSet":
        """The same set with a smooth worst case, for optimisers that stumble over the edges of S_1 and S_2.

        Support functions become smooth upper bounds, so what is certified for the result holds for the set itself:
        log-sum-exp over vertices, too large by at most width log(1 + n_d), and sqrt(x^2 + width^2) in place of |x| for
        boxes (six times), balls (twice) and ellipsoids, each too large by at most the width.

        Args:
            width: (*batch,), N, > 0: small against what the disturbances cost a contact, the entries of S_1 and S_2.
        """
        given = as_float("width", width, ())
        return DisturbanceSet(terms=tuple(replace(term, width=given) for term in self.terms))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes that the terms have in common."""
        return broadcast_batch(**{f"term {i}": term.batch_shape for i, term in enumerate(self.terms)})

    @own_settings()
    def support(self, directions: ArrayLike) -> Float[Array, "*batch rows"]:
        """h_D(a) = max over w in D of a'w, at least 0.

        Args:
            directions: (*batch, rows, 6).

        Returns:
            (*batch, rows).

        Raises:
            ValueError: another shape.
        """
        directions = as_float("directions", directions, ("rows", 6))
        batch = broadcast_batch(directions=directions.shape[:-2], disturbances=self.batch_shape)
        rows = jnp.broadcast_to(directions, (*batch, *directions.shape[-2:]))
        lead = len(batch)
        to_last = lambda x: jnp.moveaxis(x, tuple(range(lead)), tuple(range(-lead, 0))) if lead else x
        terms = jax.tree.map(to_last, self.spread_over(batch)).terms
        value = support(terms, jnp.moveaxis(to_last(rows), 1, 0))
        return jnp.moveaxis(value, tuple(range(-lead, 0)), tuple(range(lead))) if lead else value

    def spread_over(self, batch: tuple[int, ...]) -> "DisturbanceSet":
        """Every leaf broadcast to the batch shape."""
        return DisturbanceSet(terms=tuple(term.spread_over(batch) for term in self.terms))


def support(terms: tuple[Term, ...], directions: jax.Array) -> jax.Array:
    """Support function of a sum of sets, the sum of theirs; components leading, (6, ..., *lanes) -> (..., *lanes)."""
    total = jnp.zeros(directions.shape[1:], directions.dtype)
    for term in terms:
        total = total + term.support(directions)
    return total


def furthest(terms: tuple[Term, ...], directions: jax.Array) -> jax.Array:
    """The wrench of a sum of sets that reaches furthest along a, the gradient of `support`, (6, ..., *lanes)."""
    total = jnp.zeros_like(directions)
    for term in terms:
        total = total + term.furthest(directions)
    return total
