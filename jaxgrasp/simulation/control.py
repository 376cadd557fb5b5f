"""Controllers: from what is measured and what is wanted to joint torques.

Both ask for a wrench on the object,

    F = M V'_d + N V - M g + (M + m GG') (2 zeta omega (V_d - V) + omega^2 e),

with the error e of its pose and m of 20 g for what of a finger goes along with its tip, and both have the joints go
along with the desired motion. What feedback adds passes through the contacts alone: while a push acts the fingers
exert what the controller has chosen. With the fingers' inertia in the feedback as well, M_h J^-1 G' V', a push along
the fingers changes their normal forces, and contacts slide that f_0 would have held.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgrasp import linalg
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.simulation.state import State
from jaxgrasp.solvers import solve_qp

# Of J J', m^2: contacts that no joint moves ask for no joint acceleration.
_DAMPING = 1e-6
# Of the trace of G Q^-1 G', moments divided by 3 cm: directions that the contacts do not reach get no force.
_RANK, _FLOOR = 1e-7, 1e-9
_SCALE = np.array([1.0, 1.0, 1.0, 1 / 0.03, 1 / 0.03, 1 / 0.03])
_ARM = 0.1
_FINGER_MASS = 0.02
_EDGES = 8


class Wanted(NamedTuple):
    """Of the object; lanes lead, world frame."""

    position: Float[Array | np.ndarray, "lanes 3"]
    rotation: Float[Array | np.ndarray, "lanes 3 3"]
    velocity: Float[Array | np.ndarray, "lanes 6"]
    """Of the centre of mass, linear m/s and angular rad/s."""
    acceleration: Float[Array | np.ndarray, "lanes 6"]


class Impedance(NamedTuple):
    """How stiff and damped the object is held where it should be."""

    frequency: Float[Array, ""] | float = 16.0
    """omega / 2 pi, Hz."""
    damping: Float[Array, ""] | float = 1.5
    """zeta."""


class Goal(NamedTuple):
    """What a controller is to bring about."""

    wrench: Float[Array, "lanes 6"]
    """F on the object, object frame, N and N m."""
    tightening: Float[Array, "lanes vars"]
    """f_0, contact frames, N; zero where a finger has lost the object."""
    joint_torque: Float[Array, "lanes joints"]
    """Of the joints alone: M_h q''_d, links' weight and damping, N m."""
    posture: Float[Array, "lanes joints"]
    """Where the joints should be, rad."""
    posture_torque: Float[Array, "lanes joints"]
    """With which each joint would go back to where it should be, as stiff and damped as the object, N m."""
    limit: Float[Array, " joints"]
    """Of torques, N m."""


class Controller(Protocol):
    """What finds torques for a goal."""

    def __call__(self, state: State, goal: Goal) -> tuple[Float[Array, "lanes joints"], Float[Array, "lanes vars"]]:
        """Joint torques, N m, before they are limited, and the contact forces that they are to give, N."""
        ...


def goal_of(
    impedance: Impedance, state: State, wanted: Wanted, tightening: Array, posture: Array, limit: Array
) -> tuple[Goal, Float[Array, "lanes joints"]]:
    """The goal, and the joint velocities that go along with the desired motion.

    Args:
        impedance: Of object and joints.
        state: What is measured.
        wanted: The object's desired motion.
        tightening: f_0 (lanes, vars), contact frames, N.
        posture: Desired joint positions (lanes, joints), rad.
        limit: Of torques (joints,), N m.
    """
    back = jnp.swapaxes(state.rotation, -1, -2)

    def inward(twist: jax.Array | np.ndarray) -> jax.Array:
        return jnp.einsum("nij,nkj->nki", back, twist.reshape(-1, 2, 3)).reshape(-1, 6)

    turn = back @ wanted.rotation
    skew = 0.5 * (turn - jnp.swapaxes(turn, -1, -2))
    away = jnp.einsum("nij,nj->ni", back, wanted.position - state.position)
    error = jnp.concatenate([away, jnp.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)], -1)
    rate, twist, acceleration = 2 * jnp.pi * impedance.frequency, inward(wanted.velocity), inward(wanted.acceleration)
    drive = 2 * impedance.damping * rate * (twist - state.twist) + rate**2 * error
    carried = jnp.einsum("nwa,na->nw", state.grasp_map, jnp.einsum("nwa,nw->na", state.grasp_map, drive))
    follow = _follow(state)
    along = lambda twist: jnp.einsum("nvw,nw->nv", follow, twist)
    inertial = lambda q: jnp.einsum("nvw,nw->nv", state.joint_inertia, q)
    homeward = 2 * impedance.damping * rate * (along(twist) - state.joint_velocity) + rate**2 * (posture - state.joints)
    goal = Goal(
        wrench=(acceleration + drive) @ state.inertia + state.weight + _FINGER_MASS * carried,
        tightening=jnp.where(jnp.repeat(state.reach, 3, -1), tightening, 0),
        joint_torque=inertial(along(acceleration)) + state.joint_bias,
        posture=posture,
        posture_torque=inertial(homeward),
        limit=limit,
    )
    return goal, along(twist)


def _follow(state: State) -> Float[Array, "lanes joints 6"]:
    """J^+ G': joint velocities with which the fingertips go along with a twist of the object."""
    across = jnp.swapaxes(state.jacobian, -1, -2)
    product = state.jacobian @ across + _DAMPING * jnp.eye(across.shape[-1])
    return across @ linalg.solve_positive(product, jnp.swapaxes(state.grasp_map, -1, -2))


def _blocking(state: State, wrench: Array, compliance: Array | None) -> Float[Array, "lanes vars"]:
    """G* w of (15)."""
    rows = jnp.asarray(_SCALE[:, None] * state.grasp_map)
    across = jnp.swapaxes(rows, -1, -2)
    softened = across if compliance is None else linalg.solve_positive(compliance, across)
    gram = rows @ softened
    least = _RANK * jnp.trace(gram, axis1=-2, axis2=-1) + _FLOOR
    gram = gram + least[:, None, None] * jnp.eye(6)
    right = jnp.asarray(_SCALE * wrench)[..., None]
    return (softened @ linalg.solve_positive(gram, right))[..., 0]


def _torques(state: State, goal: Goal, forces: Array) -> Float[Array, "lanes joints"]:
    """Tau = J'f and what the joints need for themselves."""
    return goal.joint_torque + jnp.einsum("nav,na->nv", state.jacobian, forces)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ComputedTorque:
    """The computed-torque law of section IV-C: f = f_0 + G* (F - G f_0).

    f_0 gives its internal part alone, whatever wrench it contains.
    """

    compliance: Float[Array, "lanes vars vars"] | None = None
    """Q of the blocking forces, contact frames, m/N; None is the identity."""

    def __call__(self, state: State, goal: Goal) -> tuple[Array, Array]:
        """See `Controller`."""
        given = jnp.einsum("nwa,na->nw", state.grasp_map, goal.tightening)
        forces = goal.tightening + _blocking(state, goal.wrench - given, self.compliance)
        return _torques(state, goal, forces), forces


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ForceOptimization:
    """The optimisation-based control of section V: one quadratic program a step, all lanes together.

    min 1/2 (w |G f - F|^2 + |f - f_0|^2 + w_q |J'(f - f_0) - tau_q|^2) over the contact forces f, subject to friction
    pyramids and |J'f + tau_h| <= tau_max. The dynamics of object and joints are in F, in the torques tau_h of the
    joints alone and in tau_q, which brings the joints to their posture; moments count by an arm of 3 cm, torques by one
    of 10 cm.
    """

    weight: Float[Array, " lanes"]
    """w, of the object's motion."""
    friction: Float[Array, " lanes"]
    """Of the pyramids, with eight edges."""
    posture: Float[Array, ""] | float = 0.01
    """w_q."""

    def __call__(self, state: State, goal: Goal) -> tuple[Array, Array]:
        """See `Controller`."""
        lanes, rows = goal.tightening.shape
        across = jnp.swapaxes(state.jacobian, -1, -2)
        moved = jnp.einsum("nva,na->nv", across, goal.tightening) + goal.posture_torque
        P, q = jnp.broadcast_to(jnp.eye(rows), (lanes, rows, rows)), -goal.tightening
        for weight, part, aim in (
            (self.weight[:, None], _SCALE[:, None] * state.grasp_map, _SCALE * goal.wrench),
            (jnp.full((lanes, 1), self.posture), across / _ARM, moved / _ARM),
        ):
            P = P + weight[..., None] * (jnp.swapaxes(part, -1, -2) @ part)
            q = q - weight * jnp.einsum("nka,nk->na", part, aim)
        facets = jnp.asarray(pyramid_facets(_EDGES))
        facets = facets * jnp.stack([jnp.ones_like(self.friction)] * 2 + [self.friction], -1)[:, None]
        cones = jnp.einsum("cd,nea->nceda", jnp.eye(rows // 3), facets).reshape(lanes, -1, rows)
        G = jnp.concatenate([cones, across, -across], 1)
        limits = [goal.limit - goal.joint_torque, goal.limit + goal.joint_torque]
        forces = solve_qp(P, q, G=G, h=jnp.concatenate([jnp.zeros(cones.shape[:2]), *limits], -1)).x
        forces = jnp.where(jnp.isfinite(forces), forces, goal.tightening)
        return _torques(state, goal, forces), forces


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class JointSprings:
    """No feedback but the joints' own: tau = tau_0 + k (q_0 - q) - d q' and what bears the links."""

    torques: Float[Array, "lanes joints"]
    """tau_0, J'f_0 in the beginning for example, N m."""
    stiffness: Float[Array, ""] | float = 2.0
    """k, N m/rad."""
    damping: Float[Array, ""] | float = 0.03
    """d, N m s/rad."""

    def __call__(self, state: State, goal: Goal) -> tuple[Array, Array]:
        """See `Controller`."""
        spring = self.stiffness * (goal.posture - state.joints) - self.damping * state.joint_velocity
        return goal.joint_torque + self.torques + spring, goal.tightening
