"""Whether the origin is strictly inside the hull of wrenches: force closure, by one damped Newton method.

The origin is inside the hull of the w_k, and they span the space, exactly where the polar {u : w_k'u <= 1} is bounded,
and so exactly where its barrier f(u) = -sum log(1 - w_k'u) has a minimum. f is self-concordant: damped Newton steps
fall towards a minimum where there is one, and a Newton decrement below 1 proves that there is (Nesterov and
Nemirovskii, 1994). Where there is none, u goes to infinity along a direction that no wrench opposes.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp import linalg
from jaxgrasp.contact.row_space import RANK_TOLERANCE

SMALLEST_BALL = {"float64": 1e-7, "float32": 1e-3}
"""The radius of a ball about the origin, in units of the longest wrench, below which rounding decides about closure."""
# The decrement of a closed grasp falls to any value at last, that of another one never below 1, but for rounding.
_DECREMENT = 0.5
# u grows by a fifth or more a step: at most some 115 steps in float64, 70 in float32.
_MOST_STEPS = 300


def contains_origin(wrenches: jax.Array) -> jax.Array:
    """Test whether a ball about the origin is inside the hull of wrenches.

    Args:
        wrenches: (k, 6), the longest of norm 1; zeros do not count.

    Returns:
        (), bool; False, too, where the largest ball is smaller than `SMALLEST_BALL`. Not differentiable.
    """
    W, dtype = lax.stop_gradient(wrenches), wrenches.dtype
    if len(W) < 7:
        return jnp.zeros((), bool)
    singular = linalg.right_singular(W)[0]
    spans = singular[5] > RANK_TOLERANCE[dtype.name] * singular[0]
    farthest = 1 / SMALLEST_BALL[dtype.name]

    def undecided(state: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        u, decrement, steps = state
        return (decrement >= _DECREMENT) & (jnp.max(jnp.abs(u)) < farthest) & (steps < _MOST_STEPS)

    def step(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        u, _, steps = state
        scaled = W / (1 - W @ u)[:, None]
        gradient = jnp.sum(scaled, 0)
        move = -linalg.solve_positive(scaled.T @ scaled, gradient[:, None])[:, 0]
        decrement = jnp.sqrt(jnp.maximum(-(gradient @ move), 0))
        new = u + move / (1 + decrement)
        # Rounding ends the walk where the wrenches hardly span the space: that is no closure.
        sound = jnp.all(W @ new < 1)
        return jnp.where(sound, new, jnp.inf), jnp.where(sound, decrement, jnp.inf), steps + 1

    # Like W also where it varies over devices.
    start = (jnp.zeros_like(W[0]), jnp.full_like(W[0, 0], jnp.inf), jnp.zeros((), jnp.int32))
    return spans & (lax.while_loop(undecided, step, start)[1] < _DECREMENT)
