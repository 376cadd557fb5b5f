"""A bound of Ferrari and Canny's metric for whole batches: the nearest facet of the hull, sought from many sides.

The wrenches that a grasp can exert form a polytope H with support function h(u), and the largest ball in it about the
origin has the radius min h(u) over unit u. Its polar {n : h(n) <= 1} turns that round: the radius is 1 / max |n|, and
every n of the polar proves that the radius is at most 1 / |n|. Maximising |n|, which is convex, has many local maxima:
vertices of the polar, which are facets of H. From each of several starts affine scaling (Dikin, 1967) walks to one of
them, with the objective made linear anew at every step, so that |n| only grows; the best counts.
"""

import math
from functools import partial
from typing import Literal

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
from jaxgrasp.metrics.interior import SMALLEST_BALL, contains_origin
from jaxgrasp.metrics.wrench_space import WrenchSpace, checked, edges_of, hidden

Norm = Literal["L1", "Linf"]

# From twelve principal and twelve fixed random directions, then once more from the best. A step leaves a tenth of the
# nearest slack.
_RANDOM_STARTS, _STEPS, _LAST_STEPS = 12, 11, 11
_STRIDE = 0.9
# The polar of a grasp without force closure has no bound, and that of others is no longer than this, in units of one
# over the longest wrench: n is kept in a box of this size.
_REACH = {name: 1 / radius for name, radius in SMALLEST_BALL.items()}


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
    closed = contains_origin(W.reshape(-1, 6))
    n, weights = one_lane(lambda _, W: _farthest(W), longest > 0, lax.stop_gradient(W))
    # The last step of a walk along an unbounded polar may have none.
    weights = jnp.where(jnp.isfinite(weights), weights, 0)
    size = jnp.sqrt(n @ n)
    # Of max 1/2 n'n the derivative is that of the Lagrangian, - weights n'dw; the value stays what it is.
    reach = jnp.sum(weights * (W @ n))
    value = 1 / size + safe_divide(reach - lax.stop_gradient(reach), size**3)
    return jnp.where(closed, scale * value, 0)


def _farthest(W: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A vertex n of the polar, and multipliers (g, k) of the rows w'n <= t.

    With t (g,) for the groups the polar is {n : w'n <= t, t >= 0, sum t <= 1}.
    """
    groups, dtype = W.shape[0], W.dtype
    random = np.random.default_rng(0).normal(size=(_RANDOM_STARTS, 6))
    principal = linalg.right_singular(W.reshape(-1, 6))[1].T
    starts = jnp.concatenate([principal, -principal, literal(random, dtype)])
    middle = jnp.full(groups, 1 / (groups + 1), dtype)

    def walk(n: jax.Array, t: jax.Array, steps: int) -> tuple[jax.Array, jax.Array]:
        return lax.fori_loop(0, steps, lambda _, at: _step(W, at[0], at[1], at[0])[:2], (n, t))

    def from_start(direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        n, t, _ = _step(W, jnp.zeros(6, dtype), middle, direction)
        return walk(n, t, _STEPS)

    n, t = jax.vmap(from_start)(starts)
    best = jnp.argmax(jnp.sum(n * n, -1))
    n, t = walk(n[best], t[best], _LAST_STEPS)
    return n, _step(W, n, t, n)[2]


def _step(W: jax.Array, n: jax.Array, t: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """One step along the direction in the metric of the slacks, and the multipliers that it shows."""
    reach = _REACH[W.dtype.name]
    slack = partial(_slack, W)
    s, rest = slack(n, t), 1 - jnp.sum(t)
    d = 1 / s
    scaled = d[..., None] * W
    across = -jnp.einsum("gki,gk->gi", scaled, d)
    own = jnp.einsum("gki,gkj->ij", scaled, scaled) + jnp.diag(1 / (reach - n) ** 2 + 1 / (reach + n) ** 2)
    others = jnp.diag(jnp.sum(d * d, -1) + 1 / t**2) + 1 / rest**2
    right = jnp.concatenate([direction, jnp.zeros_like(t)])
    move = linalg.solve_positive(jnp.block([[own, across.T], [across, others]]), right[:, None])[:, 0]
    dn, dt = move[:6], move[6:]
    fall = W @ dn - dt[:, None]
    used = jnp.concatenate([(fall * d).ravel(), -dt / t, jnp.sum(dt)[None] / rest, dn / (reach - n), -dn / (reach + n)])
    share = _STRIDE / jnp.max(used)
    new_n, new_t = n + share * dn, t + share * dt
    # Rounding ends the walk: at a vertex six slacks go to zero.
    inside = (jnp.min(slack(new_n, new_t)) > 0) & (jnp.min(new_t) > 0) & (jnp.sum(new_t) < 1)
    inside &= jnp.all(jnp.abs(new_n) < reach) & (new_n @ new_n >= n @ n)
    return jnp.where(inside, new_n, n), jnp.where(inside, new_t, t), d * d * fall


def _slack(W: jax.Array, n: jax.Array, t: jax.Array) -> jax.Array:
    return t[:, None] - W @ n
