"""The unreduced program (13), which no fixed answer to a disturbance can beat: one linear program a direction."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxgrasp as jg
from jaxgrasp.contact.friction import pyramid_facets


@jax.jit
def unreduced_margins(contacts: jg.Contacts, wrenches: jax.Array, required_wrench: jax.Array) -> jax.Array:
    """lambda_13: the fingers may answer each disturbance anew, with any forces within cones and bounds.

    Where some f_0 bears b, directions have nothing in common but lambda, so lambda_13 is the least over W_j of

        max lambda over (f, lambda) with G f = b - lambda W_j, C f <= 0, -E f <= f_max.

    Args:
        contacts: grasps (lanes, n_c), all contacts present and with friction, that can bear b; float64.
        wrenches: W (n_d, 6), shared.
        required_wrench: b (lanes, 6).

    Returns:
        (lanes,); nan where a program was not solved.
    """
    lanes, n_c = contacts.friction.shape
    length = jnp.sqrt(jnp.mean(jnp.sum(contacts.positions**2, -1), -1, keepdims=True))
    units = jnp.concatenate([jnp.ones((lanes, 3)), jnp.repeat(1 / length, 3, -1)], -1)
    # In units of F, so that all numbers are of order one; lambda in those of the least F.
    F, least = contacts.max_force, contacts.max_force.min(-1)
    G = jg.grasp_map(contacts) * units[..., None] * jnp.repeat(F, 3, -1)[:, None] / least[:, None, None]

    facets = jnp.asarray(pyramid_facets(8))
    cones = facets * jnp.stack([jnp.ones_like(F), jnp.ones_like(F), contacts.friction], -1)[..., None, :]
    bound = jnp.broadcast_to(jnp.array([0.0, 0.0, -1.0]), (lanes, n_c, 1, 3))
    blocks = jnp.concatenate([cones, bound], -2)
    eye = jnp.eye(n_c)
    rows = jnp.einsum("lnka,nm->lnkma", blocks, eye).reshape(lanes, -1, 3 * n_c)
    rows = jnp.concatenate([rows, jnp.zeros((*rows.shape[:2], 1))], -1)
    sides = jnp.tile(jnp.array([0.0] * 8 + [1.0]), n_c)

    def one_direction(wrench: jax.Array) -> jax.Array:
        A = jnp.concatenate([G, (wrench * units)[..., None]], -1)
        cost = jnp.zeros(3 * n_c + 1).at[-1].set(-1)
        answer = jg.solvers.solve_qp(None, cost, A, required_wrench * units / least[:, None], rows, sides)
        return jnp.where(answer.status == jg.Status.SOLVED, -answer.objective * least, jnp.nan)

    return jax.lax.map(one_direction, wrenches).min(0)


def quartiles(values: np.ndarray) -> np.ndarray:
    """Quartiles, nan left out."""
    return np.nanquantile(values, [0.25, 0.5, 0.75])
