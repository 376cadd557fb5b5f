"""Which compliance Q of (14) makes a grasp withstand most: the margin of (21), maximised over one diagonal a contact.

The margin of (21) falls short of what the fingers could do if they answered each disturbance anew, program (13), since
the blocking forces -G* W are fixed by Q. They depend on the ratios of its entries alone, so Q is sought as
Q = diag(exp(-u)) with u of mean 0, by ascent along the gradient of the margin.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.robustness import Solution, largest_disturbance
from jaxgrasp.robustness.interface.cone_margins import cone_margin_shape

# Of u a step, at first; it falls to a tenth along a cosine.
_LEARNING_RATE = 0.3


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ComplianceResult:
    """The best compliance found for each grasp, and what it changed."""

    compliance: Float[Array, "*batch contacts 3 3"]
    """Diagonal blocks of Q, contact frames, up to a common factor, which changes nothing; 1 for absent contacts. The
    identity where nothing better was found."""
    before: Solution
    """(21) with Q = I."""
    after: Solution
    """(21) with `compliance`; its margin is nowhere less, but for the solver's tolerance."""
    margins: Float[Array, "*batch steps+1"]
    """The margins on the way, that of Q = I first."""


class _State(NamedTuple):
    u: jax.Array
    momenta: optax.OptState
    best: jax.Array
    best_u: jax.Array


def optimize_compliance(
    contacts: Contacts,
    disturbances: DisturbanceSet,
    required_wrench: ArrayLike | None = None,
    cone_edges: int = 8,
    cone_margin: ArrayLike = 0.0,
    steps: int = 60,
    spread: float = 1e3,
) -> ComplianceResult:
    """Maximise the margin of (21) over a diagonal compliance of every contact, from Q = I.

    Adam on u = log Q^-1, each grasp for itself. The margin has kinks, so it does not rise at every step: the best
    iterate of each grasp is kept.

    Args:
        contacts: the grasps; their dtype is the precision.
        disturbances: the set D; without batch axes it is shared by all grasps.
        required_wrench: b (*batch, 6), N and N m; None is zero.
        cone_edges: n_e.
        cone_margin: d, N, >= 0: a grasp, a contact or a row, as in `largest_disturbance`.
        steps: of the ascent; each costs a margin and its gradient. Other numbers of steps compile anew.
        spread: largest ratio of two entries of Q in a grasp, > 1. Q gets lost in rounding where it is too large.

    Returns:
        ComplianceResult with `*batch` axes.

    Raises:
        ValueError: shapes or options that do not fit.

    Status:
        That of (21), in `before` and `after`. Where the margin is flat (a grasp without force closure and without load)
        or there is none, Q stays the identity.
    """
    if steps < 1:
        raise ValueError(f"steps: got {steps}, wanted at least 1")
    if not spread > 1:
        raise ValueError(f"spread: got {spread}, wanted more than 1")
    n = contacts.n_c
    wrench = as_float("required_wrench", jnp.zeros(6) if required_wrench is None else required_wrench, (6,))
    reserve = as_float("cone_margin", cone_margin, ())
    batches = {
        "contacts": contacts.batch_shape,
        "disturbances": disturbances.batch_shape,
        "required_wrench": wrench.shape[:-1],
    }
    event = cone_margin_shape(reserve.shape, max(map(len, batches.values())), n, cone_edges)
    batch = broadcast_batch(**batches, cone_margin=reserve.shape[: reserve.ndim - len(event)])
    solve = functools.partial(largest_disturbance, contacts, disturbances, wrench, cone_edges=cone_edges)
    solve = functools.partial(solve, cone_margin=reserve)
    bound = jnp.asarray(0.5 * math.log(spread), contacts.positions.dtype)
    u, margins = _ascend(steps, cone_edges, batch, contacts, disturbances, wrench, reserve, bound)
    compliance = _blocks(u)
    before = solve(compliance=jnp.broadcast_to(jnp.eye(3, dtype=u.dtype), (*batch, n, 3, 3)))
    return ComplianceResult(compliance=compliance, before=before, after=solve(compliance=compliance), margins=margins)


@functools.partial(compiled, static_argnums=(0, 1, 2))
def _ascend(
    steps: int,
    cone_edges: int,
    batch: tuple[int, ...],
    contacts: Contacts,
    disturbances: DisturbanceSet,
    wrench: jax.Array,
    reserve: jax.Array,
    bound: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The best u (*batch, n_c, 3) and the margins (*batch, steps + 1) on the way."""
    optimizer = optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, steps, 0.1))
    present = jnp.broadcast_to(contacts.active[..., None], (*batch, contacts.n_c, 3))

    def loss(u: jax.Array) -> tuple[jax.Array, jax.Array]:
        margin = largest_disturbance(
            contacts, disturbances, wrench, compliance=_blocks(u), cone_edges=cone_edges, cone_margin=reserve
        ).margin
        return -jnp.sum(jnp.where(jnp.isfinite(margin), margin, 0)), margin

    def step(state: _State, _: None) -> tuple[_State, jax.Array]:
        slopes, margin = jax.grad(loss, has_aux=True)(state.u)
        better = margin > state.best
        best = jnp.where(better, margin, state.best)
        best_u = jnp.where(better[..., None, None], state.u, state.best_u)
        # Optax raises floats to integer powers, which users of strict promotion have forbidden.
        with jax.numpy_dtype_promotion("standard"):
            updates, momenta = optimizer.update(slopes, state.momenta)
        # Optax's parameters are any tree; these are one array.
        u = cast(jax.Array, optax.apply_updates(state.u, updates))
        mean = jnp.mean(u, (-2, -1), keepdims=True, where=present)
        return _State(jnp.clip(jnp.where(present, u - mean, 0), -bound, bound), momenta, best, best_u), margin

    u = jnp.zeros(present.shape, contacts.positions.dtype)
    start = _State(u, optimizer.init(u), jnp.full(batch, -jnp.inf, u.dtype), u)
    last, margins = jax.lax.scan(step, start, length=steps + 1)
    return last.best_u, jnp.moveaxis(margins, 0, -1)


def _blocks(u: jax.Array) -> jax.Array:
    """Q = diag(exp(-u)), (*batch, n_c, 3, 3)."""
    return jnp.exp(-u)[..., None] * jnp.eye(3, dtype=u.dtype)
