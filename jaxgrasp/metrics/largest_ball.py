"""A bound of Ferrari and Canny's metric for whole batches: the nearest facet of the hull, sought from many sides.

The wrenches that a grasp can exert form a polytope H with support function h(u), and the largest ball in it about the
origin has the radius min h(u) over unit u. Its polar {n : h(n) <= 1} turns that round: the radius is 1 / max |n|, and
every n of the polar proves that the radius is at most 1 / |n|. Maximising |n|, which is convex, has many local maxima:
vertices of the polar, which are facets of H. From each of several starts the simplex method walks to one of them, with
the objective made linear anew at every step, so that |n| only grows; the best counts. A vertex is where rows are
active, so rounding that differs, as in another batch, ends at the same numbers.
"""

import math
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxgrasp import linalg
from jaxgrasp.arrays import literal, safe_divide
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Contacts
from jaxgrasp.lanes.independent import one_lane
from jaxgrasp.metrics.interior import contains_origin
from jaxgrasp.metrics.wrench_space import WrenchSpace, checked, edges_of, hidden

Norm = Literal["L1", "Linf"]

# Fixed random directions, and how many of them are also turned to where wrenches are short. The longest of some 10,000
# walks had 24 pivots, their mean is 5: all walks get a few, and the best goes on.
_STARTS, _TURNED, _PIVOTS, _LAST_PIVOTS = 12, 6, 8, 32
# Rows are equally near within this, in units of the largest variable.
_NEAR = {"float64": 1e-12, "float32": 1e-5}
# What of an edge or a multiplier is rounding, in units of the machine's.
_NOTHING = 1000
# Of equal choices that of the larger weight is made, so that rounding never chooses.
_MOST_WEIGHT = 1.1


def ferrari_canny_bound(
    contacts: Contacts, norm: Norm = "L1", space: WrenchSpace | None = None
) -> Float[Array, "*batch"]:
    """An upper bound of `ferrari_canny`, in most grasps the metric itself, in batch.

    It is the distance of a facet, or of a plane a little farther out than one. That no other facet is nearer is not
    proved: `benchmarks/metrics.md` has how often it is the nearest.

    Args:
        contacts: the grasps.
        norm: see `ferrari_canny`.
        space: conventions; `WrenchSpace()` where None.

    Returns:
        (*batch,), like `ferrari_canny`; exactly 0 where there is no force closure, or less of it than a ball of 1e-7
        (float32: 1e-3) of the longest wrench; NaN for data that are not admissible. Differentiable once, by the
        facet's own multipliers; where two facets are equally near, that of one of them; 0 without closure.

    Raises:
        ValueError: options or shapes that do not fit.
    """
    return _bound(contacts, check_norm(norm), checked(contacts, space))


@partial(compiled, static_argnums=(1,))
def _bound(contacts: Contacts, norm: Norm, space: WrenchSpace) -> jax.Array:
    edges = edges_of(contacts, space)
    wrenches = edges.wrenches if norm == "Linf" else edges.flat[..., None, :, :]
    flat = wrenches.reshape(math.prod(edges.valid.shape), *wrenches.shape[-3:])
    return hidden(edges, jax.vmap(_radius)(flat).reshape(edges.valid.shape))


def check_norm(norm: str) -> Norm:
    """The norm, where it is one.

    Raises:
        ValueError: it is not.
    """
    if norm not in ("L1", "Linf"):
        raise ValueError(f"norm: got {norm!r}, wanted 'L1' or 'Linf'")
    return norm


def _radius(wrenches: jax.Array) -> jax.Array:
    """Of one grasp, wrenches (g, k, 6): h(u) = sum over the groups g of the largest u'w among k and 0."""
    longest = jnp.sqrt(jnp.max(jnp.sum(wrenches * wrenches, -1)))
    scale = lax.stop_gradient(jnp.where(longest > 0, longest, 1))
    W = wrenches / scale
    closed, n, weights = one_lane(
        lambda _, W: (contains_origin(W.reshape(-1, 6)), *_farthest(W)), longest > 0, lax.stop_gradient(W)
    )
    size = jnp.sqrt(n @ n)
    # Of max 1/2 n'n the derivative is that of the Lagrangian, - weights n'dw; the value stays what it is.
    reach = jnp.sum(weights * (W @ n))
    value = safe_divide(_support(lax.stop_gradient(W), n), size) + safe_divide(
        reach - lax.stop_gradient(reach), size**3
    )
    return jnp.where(closed, scale * value, 0)


def _support(W: jax.Array, direction: jax.Array) -> jax.Array:
    return jnp.sum(jnp.maximum(jnp.max(W @ direction, -1), 0))


class _Vertex(NamedTuple):
    """Where a walk is, in the variables x = (n, t) of the rows a'x <= b."""

    x: jax.Array
    """(6 + g,)."""
    edges: jax.Array
    """(6 + g, 6 + g): along column j row `active[j]` changes by one, and no other active one changes."""
    active: jax.Array
    """(6 + g,), the rows that are active, of which there are as many at a vertex; -1 for none."""


def _farthest(W: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A vertex n of the polar, and multipliers (g, k) of the rows w'n <= t.

    With t (g,) for the groups the polar is {n : w'n <= t, t >= 0, sum t <= 1}.
    """
    groups, dtype = W.shape[0], W.dtype
    starts = _starts(W.reshape(-1, 6))
    own = jnp.concatenate([W, jnp.broadcast_to(-jnp.eye(groups, dtype=dtype)[:, None], (*W.shape[:2], groups))], -1)
    rest = np.block([[np.zeros((groups, 6)), -np.eye(groups)], [np.zeros((1, 6)), np.ones((1, groups))]])
    rows = jnp.concatenate([own.reshape(-1, 6 + groups), literal(rest, dtype)])
    sides = literal(np.arange(len(rows)) == len(rows) - 1, dtype)
    middle = jnp.concatenate([jnp.zeros(6, dtype), jnp.full(groups, 1 / (groups + 1), dtype)])
    walked = jax.vmap(lambda start: _climb(rows, sides, _fall(rows, sides, middle, start), _PIVOTS))(starts)
    best = jnp.argmax(jnp.sum(walked.x[:, :6] ** 2, -1))
    end = _climb(rows, sides, jax.tree.map(lambda x: x[best], walked), _LAST_PIVOTS)
    multipliers = jnp.zeros(len(rows), dtype).at[end.active].set(jnp.maximum(end.x[:6] @ end.edges[:6], 0))
    return end.x[:6], multipliers[: W.shape[0] * W.shape[1]].reshape(W.shape[:2])


def _starts(W: jax.Array) -> jax.Array:
    """Directions (starts, 6). They are smooth functions of the wrenches, as singular vectors are not."""
    random = literal(np.random.default_rng(0).normal(size=(_STARTS, 6)), W.dtype)
    square = W.T @ W
    square += jnp.finfo(W.dtype).eps * jnp.trace(square) * jnp.eye(6, dtype=W.dtype)
    turned = linalg.solve_positive(square, random[:_TURNED].T).T
    return jnp.concatenate([random, turned, -turned])


def _weights(count: int, dtype: jnp.dtype) -> jax.Array:
    return literal(np.random.default_rng(count).uniform(1, _MOST_WEIGHT, count), dtype)


def _fall(rows: jax.Array, sides: jax.Array, x: jax.Array, start: jax.Array) -> _Vertex:
    """From a point inside to a vertex: along `start`, then along n as far as the active rows let it."""

    def hit(step: jax.Array, at: _Vertex) -> _Vertex:
        gains = jnp.where(step == 0, start, at.x[:6]) @ at.edges[:6]
        free = jnp.where(at.active < 0, gains / jnp.sum(at.edges**2, 0), 0)
        return _pivot(rows, sides, at, free)

    # Like the rows also where these vary over devices.
    zero = 0 * x
    inside = _Vertex(x, jnp.eye(len(x), dtype=x.dtype) + zero, jnp.full_like(zero, -1, jnp.int32))
    return lax.fori_loop(0, len(x), hit, inside)


def _climb(rows: jax.Array, sides: jax.Array, vertex: _Vertex, pivots: int) -> _Vertex:
    """From vertex to vertex along the edge on which |n| grows most, until it grows along none."""

    def pivot(_: jax.Array, at: _Vertex) -> _Vertex:
        slopes = at.x[:6] @ at.edges[:6] / jnp.sqrt(jnp.sum(at.edges**2, 0)) * _weights(len(at.x), at.x.dtype)
        leaving = jnp.arange(len(at.x)) == jnp.argmin(slopes)
        grows = jnp.min(slopes) < -_NOTHING * jnp.finfo(at.x.dtype).eps * jnp.sqrt(at.x[:6] @ at.x[:6])
        moved = _pivot(rows, sides, at, jnp.where(leaving, -1, 0).astype(at.x.dtype))
        return jax.tree.map(lambda new, old: jnp.where(grows, new, old), moved, at)

    return lax.fori_loop(0, pivots, pivot, vertex)


def _pivot(rows: jax.Array, sides: jax.Array, at: _Vertex, shares: jax.Array) -> _Vertex:
    """Go along the edges by their shares to the next row, which takes the place of one of them; nowhere without one."""
    rounding = jnp.finfo(rows.dtype).eps
    along = at.edges @ shares
    rate = rows @ along
    nearing = rate > _NOTHING * rounding * jnp.sqrt(along @ along)
    rate = jnp.where(nearing, rate, 1)
    slack = jnp.maximum(sides - rows @ at.x, 0)
    way = jnp.where(nearing, slack / rate, jnp.inf)
    # Of rows that are equally near but for rounding (Harris, 1973) the one that is met most steeply.
    allowed = _NEAR[rows.dtype.name] * jnp.maximum(1, jnp.max(jnp.abs(at.x)))
    nearest = jnp.min(jnp.where(nearing, (slack + allowed) / rate, jnp.inf))
    row = jnp.argmax(jnp.where(nearing & (way <= nearest), rate * _weights(len(rows), rows.dtype), -1))
    left = jnp.arange(len(shares)) == jnp.argmax(
        jnp.abs(shares) * jnp.sqrt(jnp.sum(at.edges**2, 0)) * _weights(len(shares), shares.dtype)
    )
    met = along / rate[row]
    edges = jnp.where(left, met[:, None], at.edges - met[:, None] * (rows[row] @ at.edges))
    new = _Vertex(at.x + way[row] * along, edges, jnp.where(left, row.astype(jnp.int32), at.active))
    return jax.tree.map(lambda new, old: jnp.where(jnp.any(nearing), new, old), new, at)
