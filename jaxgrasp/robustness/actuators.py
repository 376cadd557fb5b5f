"""What a hand's actuators add to (21) and (22): their efforts u as unknowns, J'f = B u, and limits under disturbance.

While the disturbance w acts, contact forces change by -lambda G* w and u by -lambda A G* w with A = B^+ J'. So the
worst case of u <= u_max and -u <= -u_min is again a support function: h_D(-A G*) and h_D(A G*), row by row. G* belongs
to the stacked rows of G and N'J': then directions that no actuator reaches stay without torque.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold, literal
from jaxgrasp.lanes.fence import each, fenced
from jaxgrasp.solvers.block.kkt import Blocks

# Rows shorter than this, in units of the others, are zero but for rounding.
_SHORTEST_ROW = {"float64": 1e-12, "float32": 1e-5}


class Actuated(NamedTuple):
    """`Actuation` in lanes (trailing; some leaves may be shared, with lanes of size 1)."""

    joints: jax.Array
    """(n_v, k, n, *lanes), J' divided by the length unit of `Grasps`; zero for absent contacts."""
    transmission: jax.Array
    """(n_v, n_u, *lanes), B divided by the length unit."""
    inverse: jax.Array
    """(n_u, n_v, *lanes), B^+ times the length unit."""
    unreached: jax.Array | None
    """(r, n_v, *lanes), N'; None where every joint direction is reached."""
    lower: jax.Array
    """(n_u, *lanes), u_min, finite."""
    upper: jax.Array
    """(n_u, *lanes), u_max, finite."""


class ActuatorRows(NamedTuple):
    """The actuators' part of the scaled program; lanes trail.

    columns: (eq, 1, n_u, *lanes), of the orthonormal equality rows.
    sigma, h: (2, n_u, *lanes), of u <= u_max and -u <= -u_min, scaled.
    unit: (n_u, *lanes), actuator effort per unit of unknown.
    """

    columns: jax.Array
    sigma: jax.Array
    h: jax.Array
    unit: jax.Array

    @property
    def blocks(self) -> Blocks:
        """The actuators as blocks of one unknown with two rows."""
        return Blocks(
            patterns=literal(np.array([[1.0], [-1.0]]), self.h.dtype),
            columns=self.columns,
            sigma=self.sigma,
            h=self.h,
            present=jnp.ones_like(self.unit),
            hessian_root=None,
            start=literal(np.zeros(1), self.h.dtype),
        )


def actuator_unit(actuated: Actuated) -> jax.Array:
    """The units of the actuator efforts, (n_u, *lanes): the larger limit of each."""
    largest = lax.stop_gradient(jnp.maximum(jnp.abs(actuated.upper), jnp.abs(actuated.lower)))
    # An actuator whose limits are zero is as good as one that hardly exerts anything.
    return jnp.maximum(largest, 1e-6 * jnp.maximum(fold(jnp.maximum, largest), 1e-6))


def clip_limits(actuated: Actuated, friction: jax.Array, max_force: jax.Array) -> Actuated:
    """Reduce limits that bounded forces can never reach, infinite ones for example, to the most that these ask for.

    With |f_t| <= mu f_max and |f_n| <= f_max in every contact, no actuator effort needs to be larger.
    """
    reach = jnp.stack([friction, friction, jnp.ones_like(friction), friction][: actuated.joints.shape[1]]) * max_force
    torque = _torques(jnp.abs(actuated.joints), reach)
    needed = _times(jnp.abs(actuated.inverse), torque)
    # Where actuators oppose each other, one may have to make up for all the others.
    direct = jnp.abs(actuated.transmission)
    alone = fold(jnp.maximum, torque[:, None] / jnp.where(direct > 0, direct, jnp.inf))
    most = lax.stop_gradient(jnp.maximum(needed, alone))
    return actuated._replace(
        upper=jnp.minimum(actuated.upper, jnp.maximum(most, actuated.lower)),
        lower=jnp.maximum(actuated.lower, -jnp.maximum(most, -actuated.upper)),
    )


def stack_rows(columns: jax.Array, actuated: Actuated | None) -> jax.Array:
    """Stack G (6, k, n, *lanes) and N'J' where actuators do not reach every joint direction."""
    if actuated is None or actuated.unreached is None:
        return columns
    torqueless = _times(actuated.unreached, actuated.joints)
    return jnp.concatenate([columns, torqueless])


def actuator_reach(actuated: Actuated, inverse: jax.Array, units: jax.Array) -> jax.Array:
    """The wrenches -A G*, then A G*, of the limits' rows: (6, 2, n_u, *lanes) from G* (k, 6, n, *lanes)."""

    @fenced
    def spread(inverse: jax.Array) -> jax.Array:
        def component(one: tuple) -> jax.Array:
            column, unit = one
            change = _times(actuated.inverse, _torques(actuated.joints, column)) * unit
            return jnp.stack([-change, change])

        return each(component, (jnp.moveaxis(inverse, 1, 0), units))

    return spread(inverse)


def _torques(joints: jax.Array, forces: jax.Array) -> jax.Array:
    """J'f (n_v, *lanes) from (n_v, k, n, *lanes) and (k, n, *lanes). Spelt out: a product would be a library call."""
    return fold(jnp.add, jnp.moveaxis(fold(jnp.add, jnp.moveaxis(joints * forces, 1, 0)), 1, 0))


def _times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """(r, c, *lanes) times (c, ..., *lanes)."""
    columns = jnp.moveaxis(matrix, 1, 0)
    spread = [c.reshape(c.shape[0], *[1] * (vector.ndim - c.ndim), *c.shape[1:]) for c in columns]
    return fold(jnp.add, [c * v for c, v in zip(spread, vector, strict=True)])


class JoinedRows(NamedTuple):
    """The equality rows of contact forces and actuator efforts together, before they are made orthonormal.

    forces: (6 + n_v, k, n, *lanes), of G f = b and J'f - B u = 0 for scaled forces.
    actuators: (6 + n_v, 1, n_u, *lanes).
    sizes: (n_v, *lanes), what the joints' rows were divided by.
    """

    forces: jax.Array
    actuators: jax.Array
    sizes: jax.Array


def join_rows(actuated: Actuated, columns: jax.Array, scales: jax.Array, unit: jax.Array) -> JoinedRows:
    """Join the rows of G f = b and of J'f - B u = 0.

    Args:
        actuated: the hand.
        columns: (6, k, n, *lanes), those of G for scaled forces.
        scales: (k, n, *lanes), the units of the forces.
        unit: (n_u, *lanes), the units of the actuator efforts.
    """
    torque = actuated.joints * scales
    effort = -actuated.transmission * unit
    squares = fold(jnp.add, jnp.moveaxis(fold(jnp.add, jnp.moveaxis(torque**2, 1, 0)), 1, 0))
    sizes = lax.stop_gradient(jnp.sqrt(squares + fold(jnp.add, jnp.moveaxis(effort**2, 1, 0))))
    sizes = jnp.where(sizes > _SHORTEST_ROW[sizes.dtype.name], sizes, 1)
    effort = jnp.broadcast_to(effort / sizes[:, None], (*effort.shape[:2], *sizes.shape[1:]))
    return JoinedRows(
        forces=jnp.concatenate([columns, torque / sizes[:, None, None]]),
        actuators=jnp.concatenate([jnp.zeros((6, *effort.shape[1:]), effort.dtype), effort])[:, None],
        sizes=sizes,
    )


def pack(rows: JoinedRows) -> jax.Array:
    """Write both kinds of unknown as blocks of k, (eq, k, n + ceil(n_u / k), *lanes), for `whitened`."""
    columns, size = rows.actuators[:, 0], rows.forces.shape[1]
    spare = -columns.shape[1] % size
    padded = jnp.concatenate([columns, jnp.zeros((columns.shape[0], spare, *columns.shape[2:]), columns.dtype)], 1)
    blocks = padded.reshape(padded.shape[0], -1, size, *padded.shape[2:])
    return jnp.concatenate([rows.forces, jnp.moveaxis(blocks, 2, 1)], 2)


def unpack(rows: jax.Array, contacts: int, actuators: int) -> tuple[jax.Array, jax.Array]:
    """Take the columns of forces (eq, k, n, *lanes) and of actuators (eq, 1, n_u, *lanes) out of packed rows."""
    blocks = jnp.moveaxis(rows[:, :, contacts:], 1, 2)
    columns = blocks.reshape(rows.shape[0], -1, *rows.shape[3:])[:, :actuators]
    return rows[:, :, :contacts], columns[:, None]
