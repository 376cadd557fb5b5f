"""The sets that disturbance sets are sums of: each knows its support function.

Inside kernels the lanes trail: directions are (6, rows..., *lanes), the leaves of a term (event..., *lanes) with lanes
of size 1 where shared.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, Self

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold, safe_divide, safe_norm
from jaxgrasp.fence import fenced

Tree = Any


class Term(Protocol):
    """A convex set of wrenches that contains the origin."""

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


def _combine(weights: jax.Array, directions: jax.Array) -> jax.Array:
    """Sum over six components of weights (6, *lanes) with directions (6, ..., *lanes)."""
    total = _align(weights[0], directions[0]) * directions[0]
    for i in range(1, 6):
        total = total + _align(weights[i], directions[0]) * directions[i]
    return total


def _chunk(row: jax.Array, lanes: tuple[int, ...]) -> int:
    """How many vertices to work on at a time.

    Many, so that directions are read seldom. But XLA's CPU backend cuts an operation in parallel tasks, which cannot be
    done inside a tile, where it counts more than one flop a byte and 2e5 of flops + 10 bytes.
    """
    size, width = row.size, row.dtype.itemsize
    for chunk in (16, 8, 4, 2):
        flops = 12 * chunk * size
        moved = (8 * size + 6 * chunk * math.prod(lanes)) * width
        if flops <= 0.9 * moved or flops + 10 * moved < 1.8e5:
            return chunk
    return 1


def _align(leaf: jax.Array, like: jax.Array) -> jax.Array:
    """Insert axes before the lanes, so that (*lanes) meets (rows..., *lanes)."""
    return leaf.reshape((1,) * (like.ndim - leaf.ndim) + leaf.shape) if leaf.ndim else leaf


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Vertices:
    """The convex hull of wrenches and the origin."""

    wrenches: Float[Array, "*batch directions 6"]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.wrenches.shape[:-2]

    def spread_over(self, batch: tuple[int, ...]) -> "Vertices":
        """Broadcast."""
        return Vertices(wrenches=jnp.broadcast_to(self.wrenches, (*batch, *self.wrenches.shape[-2:])))

    def rotated(self, rotation: jax.Array) -> "Vertices":
        """R acts on force and moment alike."""
        halves = self.wrenches.reshape(*self.wrenches.shape[:-1], 2, 3)
        turned = jnp.einsum("...ij,...dhj->...dhi", rotation, halves)
        return Vertices(wrenches=turned.reshape(*turned.shape[:-2], 6))

    def support(self, directions: jax.Array) -> jax.Array:
        """A running maximum over the vertices, a few at a time: memory does not grow with their number."""
        if directions.ndim > self.wrenches.ndim:
            return lax.map(self.support, jnp.moveaxis(directions, 1, 0))
        return _most(self.wrenches, directions)

    def furthest(self, directions: jax.Array) -> jax.Array:
        """A vertex, or the origin."""
        if directions.ndim > self.wrenches.ndim:
            return jnp.moveaxis(lax.map(self.furthest, jnp.moveaxis(directions, 1, 0)), 0, 1)
        return jnp.stack(_furthest(self.wrenches, directions, self.wrenches)[1])

    def extent(self) -> jax.Array:
        """Componentwise maximum."""
        return jnp.max(jnp.abs(self.wrenches), -2, initial=0)


def _over_vertices(vertices: Tree, row: jax.Array, raise_to: Callable, best: Tree) -> Tree:
    """Fold `raise_to(best, some vertices)` over vertices, leaves (directions, 6, *lanes), padded with the origin."""
    first, *_ = jax.tree.leaves(vertices)
    count = first.shape[0]
    if count == 0:
        return best
    chunk = min(count, _chunk(row, first.shape[2:]))
    chunks = -(-count // chunk)
    extra = chunks * chunk - count
    padded = jax.tree.map(lambda x: jnp.pad(x, [(0, extra)] + [(0, 0)] * (x.ndim - 1)), vertices)
    if chunks == 1:
        return fenced(raise_to)(best, padded)

    def body(i: jax.Array, best: Tree) -> Tree:
        return raise_to(best, jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, i * chunk, chunk), padded))

    return lax.fori_loop(0, chunks, body, best)


@jax.custom_jvp
def _most(wrenches: jax.Array, directions: jax.Array) -> jax.Array:
    """max(0, max_j a'w_j) for vertices (directions, 6, *lanes) and a (6, rows, *lanes)."""

    def raise_to(best: jax.Array, some: jax.Array) -> jax.Array:
        for each_wrench in some:
            best = jnp.maximum(best, _combine(each_wrench, directions))
        return best

    return _over_vertices(wrenches, directions[0], raise_to, jnp.zeros_like(directions[0]))


@partial(_most.defjvp, symbolic_zeros=True)
def _most_jvp(primals: tuple, tangents: tuple) -> tuple:
    """With w the vertex that a reaches furthest along: da'w + a'dw."""
    (wrenches, directions), (moved, turned) = primals, tangents
    reach, worst = _furthest(wrenches, directions, wrenches)
    change = jnp.zeros_like(reach)
    if not isinstance(turned, SymbolicZero):
        change = change + fold(jnp.add, [w * a for w, a in zip(worst, turned, strict=True)])
    if not isinstance(moved, SymbolicZero):
        _, dots = _furthest(wrenches, directions, moved)
        change = change + fold(jnp.add, [w * a for w, a in zip(dots, directions, strict=True)])
    return reach, change


def _furthest(wrenches: jax.Array, directions: jax.Array, marks: jax.Array) -> tuple[jax.Array, tuple]:
    """How far the vertices reach, and of the one that does, for every direction, what `marks` has in its place."""

    def raise_to(best: tuple, some: tuple) -> tuple:
        for own_wrench, mark in zip(*some, strict=True):
            reach, worst = best
            own = _combine(own_wrench, directions)
            further = own > reach
            pairs = zip(mark, worst, strict=True)
            best = jnp.where(further, own, reach), tuple(jnp.where(further, _align(m, own), o) for m, o in pairs)
        return best

    none = jnp.zeros_like(directions[0])
    return _over_vertices((wrenches, marks), none, raise_to, (none, (none,) * 6))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Box:
    """|w_i| <= half_extents_i in a frame whose axes are columns of `axes` (None: the object's)."""

    half_extents: Float[Array, "*batch 6"]
    axes: Float[Array, "*batch 3 3"] | None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        own = self.half_extents.shape[:-1]
        return own if self.axes is None else jnp.broadcast_shapes(own, self.axes.shape[:-2])

    def spread_over(self, batch: tuple[int, ...]) -> "Box":
        """Broadcast."""
        axes = None if self.axes is None else jnp.broadcast_to(self.axes, (*batch, 3, 3))
        return Box(half_extents=jnp.broadcast_to(self.half_extents, (*batch, 6)), axes=axes)

    def rotated(self, rotation: jax.Array) -> "Box":
        """Turn the axes."""
        return Box(half_extents=self.half_extents, axes=rotation if self.axes is None else rotation @ self.axes)

    def support(self, directions: jax.Array) -> jax.Array:
        """Sum of |a_i| r_i, a in the box's frame."""
        return _combine(self.half_extents, jnp.abs(self._turned(directions)))

    def furthest(self, directions: jax.Array) -> jax.Array:
        """A corner, or the middle of a face."""
        signs = jnp.sign(self._turned(directions))
        corner = [_align(r, s) * s for r, s in zip(self.half_extents, signs, strict=True)]
        if self.axes is None:
            return jnp.stack(corner)
        axes = self.axes
        back = [
            sum(_align(axes[r, c], corner[0]) * corner[half + c] for c in range(3)) for half in (0, 3) for r in range(3)
        ]
        return jnp.stack(back)

    def _turned(self, directions: jax.Array) -> jax.Array:
        """Directions in the box's frame."""
        axes = self.axes
        if axes is None:
            return directions
        columns = [
            sum(_align(axes[r, c], directions[0]) * directions[half + r] for r in range(3))
            for half in (0, 3)
            for c in range(3)
        ]
        return jnp.stack(columns)

    def extent(self) -> jax.Array:
        """Half extents, turned; negative ones stay negative."""
        if self.axes is None:
            return self.half_extents
        halves = self.half_extents.reshape(*self.half_extents.shape[:-1], 2, 3)
        turned = jnp.einsum("...rc,...hc->...hr", jnp.abs(self.axes), halves).reshape(*self.batch_shape, 6)
        return jnp.where((self.half_extents >= 0).all(-1, keepdims=True), turned, -1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """L u with |u| <= 1."""

    shape_matrix: Float[Array, "*batch 6 6"]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return self.shape_matrix.shape[:-2]

    def spread_over(self, batch: tuple[int, ...]) -> "Ellipsoid":
        """Broadcast."""
        return Ellipsoid(shape_matrix=jnp.broadcast_to(self.shape_matrix, (*batch, 6, 6)))

    def rotated(self, rotation: jax.Array) -> "Ellipsoid":
        """R acts on force and moment rows alike."""
        halves = self.shape_matrix.reshape(*self.batch_shape, 2, 3, 6)
        turned = jnp.einsum("...ij,...hjk->...hik", rotation, halves)
        return Ellipsoid(shape_matrix=turned.reshape(*turned.shape[:-3], 6, 6))

    def support(self, directions: jax.Array) -> jax.Array:
        """|L'a|."""
        return safe_norm(self._pulled(directions), 0)

    def furthest(self, directions: jax.Array) -> jax.Array:
        """L L'a / |L'a|."""
        pulled = self._pulled(directions)
        unit = safe_divide(pulled, safe_norm(pulled, 0))
        return jnp.stack([_combine(self.shape_matrix[r], unit) for r in range(6)])

    def _pulled(self, directions: jax.Array) -> jax.Array:
        """L'a."""
        return jnp.stack([_combine(self.shape_matrix[:, c], directions) for c in range(6)])

    def extent(self) -> jax.Array:
        """Row norms; not the safe norm, which hides NaN."""
        return jnp.linalg.norm(self.shape_matrix, axis=-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Ball:
    """A ball of forces and, independently, one of moments."""

    force: Float[Array, "*batch"]
    torque: Float[Array, "*batch"]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return jnp.broadcast_shapes(self.force.shape, self.torque.shape)

    def spread_over(self, batch: tuple[int, ...]) -> "Ball":
        """Broadcast."""
        return Ball(force=jnp.broadcast_to(self.force, batch), torque=jnp.broadcast_to(self.torque, batch))

    def rotated(self, rotation: jax.Array) -> "Ball":
        """A ball stays what it is."""
        return self

    def support(self, directions: jax.Array) -> jax.Array:
        """Force |a_f| + torque |a_m|."""
        return _align(self.force, directions[0]) * safe_norm(directions[:3], 0) + _align(
            self.torque, directions[0]
        ) * safe_norm(directions[3:], 0)

    def furthest(self, directions: jax.Array) -> jax.Array:
        """Radii times unit vectors."""
        force, torque = (safe_divide(half, safe_norm(half, 0)) for half in (directions[:3], directions[3:]))
        return jnp.concatenate([_align(self.force, force) * force, _align(self.torque, torque) * torque])

    def extent(self) -> jax.Array:
        """Radii."""
        force, torque = jnp.broadcast_arrays(self.force, self.torque)
        return jnp.stack([*[force] * 3, *[torque] * 3], -1)
