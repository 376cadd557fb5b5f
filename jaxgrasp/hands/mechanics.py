"""What a hand's joints can do with contacts: Jacobians, J'f = B u + tau, and limits of the efforts.

Statically, joint torques J'f come from actuators, B u, and from what joints bear by themselves, tau. Everything that
tau may be fits the form of actuators: dry friction is an effort of its own at its joint, a stop that is reached takes a
limit of that effort away on one side, and the constant torque c of springs moves the limits. With u' = u + B^+ c,
J'f = B u + c becomes J'f = B u'. A spring on a joint that nothing else acts on is an effort whose two limits are the
same.

While a disturbance acts, efforts answer it in proportion to what they can: of all that make up J'f the smallest in
units of their own ranges, so that neither gears nor a little dry friction beside a strong motor decide.

Directions of joints that none of these reach are held (their rows are left out) or free (N'J'f = 0).
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxgrasp import linalg
from jaxgrasp.contact import Actuation
from jaxgrasp.hands.actuators import Actuators
from jaxgrasp.hands.couplings import Couplings
from jaxgrasp.hands.engines import Geometry
from jaxgrasp.hands.passive import Passive

UNREACHED = ("held", "free")
_RANK = 1e-6
# Weak efforts beside strong ones make small singular values that are none of rounding.
_ROUNDING = {"float64": 1e-10, "float32": 1e-6}
Array = Any


@dataclass(frozen=True)
class _Columns:
    """Where the efforts of joints stand behind those of the actuators."""

    friction: np.ndarray
    """Degrees of freedom with dry friction."""
    stops: np.ndarray
    """Those with a stop, but without dry friction and without an actuator of their own."""
    springs: np.ndarray
    """Those with a spring on which nothing else acts."""


class Mechanics:
    """What the joints of one hand can do."""

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: np.ndarray,
        couplings: Couplings,
        actuators: Actuators,
        passive: Passive,
        unreached: str,
    ):
        """Finds which efforts there are.

        Args:
            model: The scene.
            joints: The hand's joints.
            couplings: Among them.
            actuators: What moves them.
            passive: What they bear by themselves.
            unreached: "held" or "free".

        Raises:
            ValueError: Nothing acts on a hand whose joints shall be free.
        """
        if unreached not in UNREACHED:
            raise ValueError(f"unreached: got {unreached!r}, wanted one of {', '.join(UNREACHED)}")
        self.passive, self._couplings, self._actuators = passive, couplings, actuators
        self._held = unreached == "held"
        self._hinge = model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_HINGE)
        moments = actuators.reference
        # (dofs, actuators), the direction in which an actuator acts on a joint and on no other one, else 0.
        self._own = np.where(np.count_nonzero(moments, axis=0) == 1, np.sign(moments), 0.0)
        rough = passive.friction > 0
        ends = np.isfinite(passive.limits).any(-1)
        reached = self._through(np.concatenate([moments, np.eye(len(joints))[:, rough]], -1), joints, model)
        spring = np.flatnonzero(passive.sprung)
        spans = lambda d: _spans(reached, self._through(np.eye(len(joints))[:, [d]], joints, model))
        idle = [d for d in spring if not spans(d)]
        leaning = np.flatnonzero(ends & ~rough & ~(self._own != 0).any(-1))
        self._columns = _Columns(
            friction=np.flatnonzero(rough),
            # A direction that is held bears more than its stop.
            stops=np.array([d for d in leaning if not self._held or spans(d)], int),
            springs=np.array(idle, int),
        )
        efforts = np.concatenate([actuators.capacity, passive.friction[rough]])
        known = efforts[np.isfinite(efforts)]
        # What has no limit counts as the strongest of those that have one.
        most = known.max(initial=0) or 1.0
        efforts = np.where(np.isfinite(efforts) & (efforts > 0), efforts, most)
        others = len(self._columns.stops), len(self._columns.springs)
        self._places_of_stops = len(efforts) + np.arange(others[0])
        self._capacity = np.concatenate([efforts, np.full(sum(others), most)])
        if not self._held and not (moments.shape[1] or len(self._columns.friction) or len(self._columns.springs)):
            raise ValueError("unreached: got 'free' for a hand without actuators, which bears nothing; wanted 'held'")

    @property
    def constant(self) -> bool:
        """Whether efforts act on joints in the same way in every configuration."""
        same = self._actuators.transmission is not None and self._couplings.linear
        return same and not len(self._columns.stops)

    def jacobians(
        self,
        geometry: Geometry,
        points: Array,
        moved: Array,
        frames: Array,
        rotation: Array,
        soft: bool,
        xp: ModuleType,
    ) -> Array:
        """J (n, contacts, 3, dofs) in contact frames; of soft contacts (n, contacts, 4, dofs).

        Args:
            geometry: Where the joints are.
            points: (n, contacts, 3), m, world frame.
            moved: (n, contacts, dofs), which joints move the link of a contact.
            frames: (n, contacts, 3, 3), in the object's frame.
            rotation: (n, 3, 3), of the object.
            soft: Whether the angular velocities about the normals are wanted, too.
            xp: numpy or jax.numpy.
        """
        velocity = point_velocities(geometry.axes, geometry.anchors, self._hinge, points, moved, xp)
        # Contacts that are not admissible have no frames.
        turned = xp.einsum("nij,ncja->ncia", rotation, xp.where(xp.isnan(frames), 0, frames))
        jacobian = xp.einsum("ncia,ncvi->ncav", turned, velocity)
        if not soft:
            return jacobian
        spin = xp.einsum("nci,nvi->ncv", turned[..., 2], geometry.axes)
        spin = xp.where(moved & self._hinge, spin, 0)
        return xp.concatenate([jacobian, spin[:, :, None]], 2)

    def actuation(
        self, geometry: Geometry, joints: Array, jacobian: Array, stops: bool, xp: ModuleType
    ) -> dict[str, Array | Actuation | None]:
        """The fields of `HandGrasps` that say what joints can do.

        Args:
            geometry: Lengths, moments and springs.
            joints: (n, dofs), rad or m.
            jacobian: Of `jacobians`.
            stops: Whether stops that are reached count.
            xp: numpy or jax.numpy.
        """
        dtype = joints.dtype
        low, high = self.passive.stops(joints) if stops else (xp.zeros(joints.shape, bool),) * 2
        whole, silent = self._all_efforts(geometry.moments, low | high if stops else None, xp)
        free, stiffness = np.eye(joints.shape[-1]), self.passive.stiffness
        if len(self._couplings.follower):
            free = self._couplings.constant if self._couplings.linear else self._couplings.velocities(joints, xp)
            whole = _product(xp.swapaxes(free, -1, -2) if free.ndim == 3 else free.T, whole, xp)
            free = free.astype(dtype)
            jacobian = jacobian @ (free if free.ndim == 2 else free[:, None])
        free = free.astype(dtype)
        back = xp.swapaxes(free, -1, -2)
        stiffness = back @ stiffness.astype(dtype) @ free
        through = whole[..., : len(self._actuators.numbers)].astype(dtype)
        servo = np.maximum(-self._actuators.slope, 0).astype(dtype)
        stiffness = (through * servo) @ xp.swapaxes(through, -1, -2) + stiffness
        turn = lambda matrix, vectors: (matrix @ vectors[..., None])[..., 0]
        as_array = lambda x: jnp.asarray(x, jnp.result_type(float) if xp is np else dtype)
        spread = lambda x: as_array(xp.broadcast_to(x, (len(joints), *x.shape[-2:])))
        found = {"spring_torques": as_array(turn(back, geometry.springs)), "joint_stiffness": spread(stiffness)}
        if not whole.shape[-1] or not whole.shape[-2]:
            return found | {"actuation": None, "spring_efforts": as_array(xp.zeros((len(joints), 0), dtype))}
        # Where stops do not count there are no efforts for them.
        capacity = self._capacity if stops else np.delete(self._capacity, self._places_of_stops)
        inverse, unreached, projector = _reach(whole, capacity, silent, self._held, xp)
        if projector is not None:
            projector = projector.astype(dtype)
            jacobian = jacobian @ (projector if projector.ndim == 2 else projector[:, None])
        shared = np.ones(joints.shape[-1], bool)
        shared[self._columns.springs] = False
        shift = turn(inverse.astype(dtype), turn(back, xp.where(shared, geometry.springs, 0)))
        lower, upper = self._limits(geometry, low, high, stops, xp)
        actuation = Actuation(
            jacobian=as_array(jacobian),
            transmission=spread(whole),
            lower=as_array(lower + shift),
            upper=as_array(upper + shift),
            inverse=spread(inverse),
            unreached=None if unreached is None else spread(unreached),
        )
        return found | {"actuation": actuation, "spring_efforts": as_array(shift)}

    def _all_efforts(self, moments: Array, at_stop: Array | None, xp: ModuleType) -> tuple[Array, int]:
        """Columns of all efforts on the degrees of freedom, and how many of them can answer a disturbance."""
        columns, eye = self._columns, np.eye(moments.shape[-2])
        parts = [moments, eye[:, columns.friction]]
        if at_stop is not None and len(columns.stops):
            # The effort of a stop that is not reached acts on nothing.
            parts.append(eye[:, columns.stops] * at_stop[:, None, columns.stops])
        silent = sum(part.shape[-1] for part in parts)
        return _beside([*parts, eye[:, columns.springs]], xp), silent

    def _limits(self, geometry: Geometry, low: Array, high: Array, stops: bool, xp: ModuleType) -> tuple[Array, Array]:
        """Least and largest efforts (n, efforts), without the springs that move them."""
        columns, springs = self._columns, geometry.springs
        dtype = springs.dtype
        least, most = self._actuators.limits(geometry.lengths, xp)
        # A lower stop pushes with any positive torque, an upper one with any negative.
        for direction, least_is_open, most_is_open in ((self._own > 0, high, low), (self._own < 0, low, high)):
            free = direction.any(0)
            joint = direction.argmax(0)
            least = xp.where(free & least_is_open[:, joint], -np.inf, least)
            most = xp.where(free & most_is_open[:, joint], np.inf, most)
        loss = self.passive.friction[columns.friction].astype(dtype)
        rows = [(least, most)]
        rows.append(
            (
                xp.where(high[:, columns.friction], -np.inf, -loss),
                xp.where(low[:, columns.friction], np.inf, loss),
            )
        )
        if stops and len(columns.stops):
            low, high = low[:, columns.stops], high[:, columns.stops]
            idle = ~low & ~high
            rows.append((xp.where(high, -np.inf, -1.0 * idle), xp.where(low, np.inf, 1.0 * idle)))
        rows.append((springs[:, columns.springs], springs[:, columns.springs]))
        return tuple(xp.concatenate(side, -1) for side in zip(*rows, strict=True))

    def _through(self, columns: np.ndarray, joints: np.ndarray, model: mujoco.MjModel) -> np.ndarray:
        """Columns of degrees of freedom by way of the couplings, in the reference configuration."""
        return self._couplings.velocities(model.qpos0[model.jnt_qposadr[joints]], np).T @ columns


def point_velocities(
    axes: Array, anchors: Array, hinge: np.ndarray, points: Array, moved: Array, xp: ModuleType
) -> Array:
    """Velocities (n, k, joints, 3) of points (n, k, 3) on the hand, by the joints that move them."""
    turning = xp.cross(axes[:, None], points[:, :, None] - anchors[:, None])
    return xp.where(moved[..., None], xp.where(hinge[:, None], turning, axes[:, None]), 0)


def _beside(parts: list[Array], xp: ModuleType) -> Array:
    """Columns beside each other; in NumPy where they do not vary."""
    varying = [part for part in parts if part.ndim == 3]
    if not varying:
        return np.concatenate(parts, -1)
    count, dtype = len(varying[0]), varying[0].dtype
    return xp.concatenate([xp.broadcast_to(xp.asarray(p, dtype), (count, *p.shape[-2:])) for p in parts], -1)


def _product(a: Array, b: Array, xp: ModuleType) -> Array:
    """The product a b; in NumPy, and so known beforehand, where neither varies."""
    if a.ndim == b.ndim == 2:
        return a @ b
    varying = a if a.ndim == 3 else b
    return xp.asarray(a, varying.dtype) @ xp.asarray(b, varying.dtype)


def _spans(columns: np.ndarray, vector: np.ndarray) -> bool:
    """Whether columns (v, k) combine to a vector (v, 1)."""
    left = vector - columns @ (np.linalg.pinv(columns, _RANK) @ vector)
    return bool(np.abs(left).max(initial=0) <= _RANK * max(np.abs(vector).max(initial=0), 1e-300))


def _reach(
    whole: Array, capacity: np.ndarray, silent: int, held: bool, xp: ModuleType
) -> tuple[Array, Array | None, Array | None]:
    """How efforts answer: the inverse, the rows N' of directions that answer nothing, and what J is projected with.

    Args:
        whole: Columns of all efforts.
        capacity: In which units efforts answer.
        silent: From this one on they are constant, and answer no disturbance.
        held: Whether directions that no effort reaches are left out.
        xp: Of arrays that vary.
    """
    within = np if whole.ndim == 2 else xp
    eye = np.eye(whole.shape[-2]).astype(whole.dtype)
    answering = within.where(np.arange(whole.shape[-1]) < silent, whole, 0)
    capacity = capacity.astype(whole.dtype)
    inverse = capacity[:, None] * _inverse(answering * capacity, within)
    answered = answering @ inverse
    if not held:
        unreached, projector = eye - answered, None
    elif silent == whole.shape[-1]:
        unreached, projector = None, answered
    else:
        projector = whole @ _inverse(whole, within)
        unreached = projector - answered
    if projector is not None and within is np and np.abs(projector - eye).max() <= _RANK:
        projector = None
    if unreached is not None and whole.ndim == 2:
        left, sizes, _ = np.linalg.svd(unreached)
        unreached = left[:, sizes > 0.5].T if (sizes > 0.5).any() else None
    return inverse, unreached, projector


def _inverse(columns: Array, xp: ModuleType) -> Array:
    tolerance = _ROUNDING[columns.dtype.name]
    if columns.ndim == 2:
        return np.linalg.pinv(columns, tolerance)
    if xp is jnp:
        return linalg.pinv(columns, tolerance)
    # Few differ where it is only stops that make them.
    different, which = np.unique(columns.reshape(len(columns), -1), axis=0, return_inverse=True)
    return np.linalg.pinv(different.reshape(-1, *columns.shape[1:]), tolerance)[which.reshape(-1)]
