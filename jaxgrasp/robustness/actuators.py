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
from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.row_space import Basis
from jaxgrasp.lanes.fence import in_turn
from jaxgrasp.solvers.block.kkt import Blocks
from jaxgrasp.solvers.small_matrices import ColumnFactor, cholesky_by_columns, lower_places, sum_over_blocks

# Rows shorter than this, in units of the others, are zero but for rounding.
_SHORTEST_ROW = {"float64": 1e-12, "float32": 1e-5}
# What is left of the square of a row of B beside the rows before is rounding up to this share.
_LEAST_PIVOT = {"float64": 1e-13, "float32": 4e-6}


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


def usable_actuation(actuation: Actuation, active: jax.Array) -> jax.Array:
    """True where everything that is used is finite and no limits cross, (*lanes)."""
    # A sum is finite where all of its terms are. Spelt out: large reductions are library calls.
    total = lambda x: fold(jnp.add, jnp.abs(x))
    matrices = _by_joints(actuation)[1:]

    def add(sums: tuple, joint: tuple) -> tuple[tuple, None]:
        return jax.tree.map(jnp.add, sums, (total(jnp.moveaxis(joint[0], 1, 0)), *map(total, joint[1]))), None

    jacobian = actuation.jacobian
    zeros = lambda *shape: jnp.zeros(shape, jacobian.dtype)
    none = (zeros(jacobian.shape[0], *jacobian.shape[3:]), *[zeros(*m.shape[2:]) for m in matrices])
    (contacts, *sums), _ = in_turn(add, none, (_by_joints(actuation)[0], matrices))
    usable = (jnp.isfinite(contacts) | ~active).all(0)
    for whole in sums:
        usable &= jnp.isfinite(whole)
    lower, upper = actuation.lower, actuation.upper
    return usable & ((lower <= upper) & (lower < jnp.inf) & (upper > -jnp.inf)).all(0)


def admit_actuation(actuation: Actuation, transmits: jax.Array, valid: jax.Array, length: jax.Array) -> Actuated:
    """The actuation in units of the length, harmless in lanes that are not valid."""

    def admit(_: None, joint: list[jax.Array]) -> tuple[None, tuple]:
        jacobian, inverse, transmission, *unreached = joint
        rest = [jnp.where(valid, x, 0) for x in (inverse * length, transmission / length, *unreached)]
        return None, (jnp.moveaxis(jnp.where(transmits, jacobian, 0), 1, 0) / length, *rest)

    joints, inverse, transmission, *unreached = in_turn(admit, None, _by_joints(actuation))[1]
    return Actuated(
        joints=joints,
        transmission=transmission,
        inverse=jnp.swapaxes(inverse, 0, 1),
        unreached=jnp.swapaxes(unreached[0], 0, 1) if unreached else None,
        lower=jnp.where(valid, actuation.lower, -1),
        upper=jnp.where(valid, actuation.upper, 1),
    )


def _by_joints(actuation: Actuation) -> list[jax.Array]:
    """J, B^+, B and N', if there is one, with joints along the leading axis."""
    given = [jnp.moveaxis(actuation.jacobian, 2, 0), jnp.swapaxes(actuation.inverse, 0, 1), actuation.transmission]
    return given if actuation.unreached is None else [*given, jnp.swapaxes(actuation.unreached, 0, 1)]


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
    torque = _torques(jnp.abs(actuated.joints), reach[None])[:, 0]

    def most_of(_: None, effort: tuple) -> tuple[None, jax.Array]:
        inverse, direct = jnp.abs(effort[0]), jnp.abs(effort[1])
        # Where actuators oppose each other, one may have to make up for all the others.
        alone = fold(jnp.maximum, torque / jnp.where(direct > 0, direct, jnp.inf))
        return None, jnp.maximum(fold(jnp.add, inverse * torque), alone)

    efforts = actuated.inverse, jnp.swapaxes(actuated.transmission, 0, 1)
    most = lax.stop_gradient(in_turn(most_of, None, efforts)[1])
    return actuated._replace(
        upper=jnp.minimum(actuated.upper, jnp.maximum(most, actuated.lower)),
        lower=jnp.maximum(actuated.lower, -jnp.maximum(most, -actuated.upper)),
    )


def stack_rows(columns: jax.Array, actuated: Actuated | None) -> jax.Array:
    """Stack G (6, k, n, *lanes) and N'J' where actuators do not reach every joint direction."""
    if actuated is None or actuated.unreached is None:
        return columns
    torqueless = [fold(jnp.add, row[:, None, None] * actuated.joints) for row in actuated.unreached]
    return jnp.concatenate([columns, jnp.stack(torqueless)])


def actuator_reach(actuated: Actuated, inverse: jax.Array, units: jax.Array) -> jax.Array:
    """The wrenches -A G*, then A G*, of the limits' rows: (6, 2, n_u, *lanes) from G* (k, 6, n, *lanes)."""
    torques = _torques(actuated.joints, jnp.moveaxis(inverse, 1, 0))
    change = in_turn(lambda _, row: (None, fold(jnp.add, row[:, None] * torques) * units), None, actuated.inverse)[1]
    change = jnp.moveaxis(change, 1, 0)
    return jnp.stack([-change, change], 1)


def _torques(joints: jax.Array, forces: jax.Array) -> jax.Array:
    """J'f (n_v, w, *lanes) of w forces, from (n_v, k, n, *lanes) and (w, k, n, *lanes)."""

    def of_joint(_: None, row: jax.Array) -> tuple[None, jax.Array]:
        # Spelt out: a product would be a library call.
        return None, sum_over_blocks(row * forces)

    return in_turn(of_joint, None, joints)[1]


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

    def join(_: None, joint: tuple) -> tuple[None, tuple]:
        torque, effort = joint[0] * scales, -joint[1] * unit
        squares = fold(jnp.add, fold(jnp.add, torque**2)) + fold(jnp.add, effort**2)
        size = lax.stop_gradient(jnp.sqrt(squares))
        size = jnp.where(size > _SHORTEST_ROW[size.dtype.name], size, 1)
        return None, (torque / size, jnp.broadcast_to(effort / size, (len(effort), *size.shape)), size)

    torque, effort, sizes = in_turn(join, None, (actuated.joints, actuated.transmission))[1]
    return JoinedRows(
        forces=jnp.concatenate([columns, torque]),
        actuators=jnp.concatenate([jnp.zeros((6, *effort.shape[1:]), effort.dtype), effort])[:, None],
        sizes=sizes,
    )


class HandRows(NamedTuple):
    """Rows of J'f - B u = 0 after row operations L^-1 that make those of B orthonormal.

    forces: (n_v, k, n, *lanes).
    actuators: (n_v, n_u, *lanes), -L^-1 B.
    kept: (n_v, *lanes), 1, or 0 where a row of B depends on those before, and the row is zero.
    factor: L.
    lost: (*lanes), the largest entry of J' in a row that is not kept: zero, but for rounding, where efforts answer all
        forces.
    """

    forces: jax.Array
    actuators: jax.Array
    kept: jax.Array
    factor: ColumnFactor
    lost: jax.Array


def whiten_efforts(rows: JoinedRows) -> HandRows:
    """Make the rows of efforts orthonormal; the row operations are held by derivatives."""
    efforts, count = rows.actuators[6:, 0], len(rows.sizes)
    held = lax.stop_gradient(efforts)

    # B B', the lower triangle row by row.
    def add(triangle: jax.Array, column: jax.Array) -> tuple[jax.Array, None]:
        return triangle + jnp.concatenate([column[: r + 1] * column[r] for r in range(count)]), None

    triangle = jnp.zeros((count * (count + 1) // 2, *held.shape[2:]), held.dtype)
    triangle, _ = in_turn(add, triangle, jnp.swapaxes(held, 0, 1))
    factor = cholesky_by_columns(triangle[lower_places(count)], _LEAST_PIVOT[held.dtype.name])
    inverse = jnp.stack(factor.inverse)
    kept = (inverse > 0).astype(held.dtype)

    def turn(lost: jax.Array, column: jax.Array) -> tuple[jax.Array, jax.Array]:
        left = factor.remainders(column)
        return jnp.maximum(lost, fold(jnp.maximum, jnp.abs(lax.stop_gradient(left)) * (1 - kept))), left * inverse

    joints = jnp.moveaxis(rows.forces[6:], 0, 2)
    lost, forces = in_turn(turn, jnp.zeros_like(held[0, 0]), joints.reshape(-1, *joints.shape[2:]))
    _, actuators = in_turn(turn, lost, jnp.swapaxes(efforts, 0, 1))
    forces = jnp.moveaxis(forces.reshape(joints.shape), 2, 0)
    return HandRows(forces, jnp.swapaxes(actuators, 0, 1), kept, factor, lost)


class HandBasis(NamedTuple):
    """Row operations of the rows of G f = b and of J'f - B u = 0, apart from each other; see `Basis`.

    wrenches: those of G.
    joints: L, with the operations L^-1.
    kept: (6 + n_v, *lanes).
    """

    wrenches: Basis
    joints: ColumnFactor
    kept: jax.Array

    def coordinates(self, rows: jax.Array) -> jax.Array:
        """Apply the operations to (6 + n_v, *lanes)."""
        return jnp.concatenate([self.wrenches.coordinates(rows[:6]), self.joints.down(rows[6:])])

    def multipliers(self, y: jax.Array) -> jax.Array:
        """Apply their transpose to (6 + n_v, *lanes)."""
        return jnp.concatenate([self.wrenches.multipliers(y[:6]), self.joints.up(y[6:])])


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
