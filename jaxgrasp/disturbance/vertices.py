"""Convex hulls of wrenches: running maxima over any number of vertices, in bounded memory."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jaxgrasp.arrays import fold
from jaxgrasp.disturbance.terms import Term, align, checked, combine, common, spread
from jaxgrasp.lanes.fence import fenced
from jaxgrasp.records import record

Tree = Any


@record
class Vertices:
    """The convex hull of wrenches and the origin."""

    wrenches: Float[Array, "*batch directions 6"]
    width: Float[Array, "*batch"] | None = None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes."""
        return common(self.wrenches.shape[:-2], self.width)

    def spread_over(self, batch: tuple[int, ...]) -> "Vertices":
        """Broadcast."""
        wrenches = jnp.broadcast_to(self.wrenches, (*batch, *self.wrenches.shape[-2:]))
        return Vertices(wrenches=wrenches, width=spread(self.width, batch))

    def rotated(self, rotation: jax.Array) -> "Vertices":
        """R acts on force and moment alike."""
        halves = self.wrenches.reshape(*self.wrenches.shape[:-1], 2, 3)
        turned = jnp.einsum("...ij,...dhj->...dhi", rotation, halves)
        return replace(self, wrenches=turned.reshape(*turned.shape[:-2], 6))

    def scaled(self, factor: jax.Array) -> "Vertices":
        """Scale the wrenches."""
        return replace(self, wrenches=factor[..., None, None] * self.wrenches)

    def support(self, directions: jax.Array) -> jax.Array:
        """A running maximum over the vertices, a few at a time: memory does not grow with their number."""
        if directions.ndim > self.wrenches.ndim:
            return lax.map(self.support, jnp.moveaxis(directions, 1, 0))
        if self.width is None:
            return _most(self.wrenches, directions)
        return _soft_most(self.wrenches, directions, self.width)

    def furthest(self, directions: jax.Array) -> jax.Array:
        """A vertex, or the origin; with a width, a mean of them."""
        if directions.ndim > self.wrenches.ndim:
            return jnp.moveaxis(lax.map(self.furthest, jnp.moveaxis(directions, 1, 0)), 0, 1)
        if self.width is not None:
            return _soft_furthest(self.wrenches, directions, self.width)
        return jnp.stack(_furthest(self.wrenches, directions, self.wrenches)[1])

    def extent(self) -> jax.Array:
        """Componentwise maximum."""
        largest = jnp.max(jnp.abs(self.wrenches), -2, initial=0)
        # XLA's CPU code for the maximum of many lanes was seen to pass over NaN.
        return checked(jnp.where(jnp.isnan(self.wrenches).any(-2), jnp.nan, largest), self.width)


def wrenches_of(terms: tuple[Term, ...]) -> jax.Array:
    """The wrenches of a set that is one list of vertices; callers have seen to that."""
    (first, *_) = terms
    assert isinstance(first, Vertices)
    return first.wrenches


def _over_vertices(vertices: Tree, row: jax.Array, raise_to: Callable, best: Tree) -> Tree:
    """Fold `raise_to(best, some vertices)` over vertices, leaves (directions, 6, *lanes)."""
    first, *_ = jax.tree.leaves(vertices)
    count = first.shape[0]
    if count == 0:
        return best
    chunk = min(count, _chunk(row, first.shape[2:]))
    chunks, rest = divmod(count, chunk)
    if rest:
        best = fenced(raise_to)(best, jax.tree.map(lambda x: x[-rest:], vertices))
    if chunks == 1:
        return fenced(raise_to)(best, jax.tree.map(lambda x: x[:chunk], vertices))

    def body(i: jax.Array, best: Tree) -> Tree:
        return raise_to(best, jax.tree.map(lambda x: lax.dynamic_slice_in_dim(x, i * chunk, chunk), vertices))

    return lax.fori_loop(0, chunks, body, best)


@jax.custom_jvp
def _most(wrenches: jax.Array, directions: jax.Array) -> jax.Array:
    """max(0, max_j a'w_j) for vertices (directions, 6, *lanes) and a (6, rows, *lanes)."""

    def raise_to(best: jax.Array, some: jax.Array) -> jax.Array:
        for each_wrench in some:
            best = jnp.maximum(best, combine(each_wrench, directions))
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
            own = combine(own_wrench, directions)
            further = own > reach
            pairs = zip(mark, worst, strict=True)
            best = jnp.where(further, own, reach), tuple(jnp.where(further, align(m, own), o) for m, o in pairs)
        return best

    none = jnp.zeros_like(directions[0])
    return _over_vertices((wrenches, marks), none, raise_to, (none, (none,) * 6))


def _soft_most(wrenches: jax.Array, directions: jax.Array, width: jax.Array) -> jax.Array:
    """Log-sum-exp: width log(1 + sum_j exp(a'w_j / width)) over the vertices that are not the origin."""
    most, width = lax.stop_gradient(_most(wrenches, directions)), align(width, directions[0])

    def add(total: jax.Array, some: jax.Array) -> jax.Array:
        for own_wrench in some:
            total = total + _share(own_wrench, directions, most, width)
        return total

    return most + width * jnp.log(_over_vertices(wrenches, most, add, jnp.exp(-most / width)))


def _soft_furthest(wrenches: jax.Array, directions: jax.Array, width: jax.Array) -> jax.Array:
    """The gradient of `_soft_most`: the mean of the vertices, weighed by their shares in the sum."""
    value, width = _soft_most(wrenches, directions, width), align(width, directions[0])

    def add(total: tuple, some: jax.Array) -> tuple:
        for own_wrench in some:
            share = _share(own_wrench, directions, value, width)
            total = tuple(t + share * align(w, share) for t, w in zip(total, own_wrench, strict=True))
        return total

    return jnp.stack(_over_vertices(wrenches, value, add, (jnp.zeros_like(value),) * 6))


def _share(wrench: jax.Array, directions: jax.Array, level: jax.Array, width: jax.Array) -> jax.Array:
    """exp((a'w - level) / width); 0 for the origin, which pads sets."""
    there = fold(jnp.maximum, jnp.abs(wrench)) > 0
    return jnp.where(align(there, level), jnp.exp((combine(wrench, directions) - level) / width), 0)


def _chunk(row: jax.Array, lanes: tuple[int, ...]) -> int:
    """How many vertices to work on at a time.

    Many, so that directions are read seldom. But XLA's CPU backend cuts an operation in parallel tasks, which cannot be
    done inside a tile, where it counts more than one flop a byte and 2e5 of flops + 10 bytes.
    """
    size, width = row.size, row.dtype.itemsize
    if not isinstance(size, int):
        # Tiles have a known size.
        return 16
    for chunk in (16, 8, 4, 2):
        flops = 12 * chunk * size
        moved = (8 * size + 6 * chunk * math.prod(lanes)) * width
        if flops <= 0.9 * moved or flops + 10 * moved < 1.8e5:
            return chunk
    return 1
