"""What joints bear by themselves: dry friction, stops that they lean on, and springs."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from jaxgrasp.hands.actuators import is_fixed, moved_by_tendon

_OFF = mujoco.mjtDisableBit
# A joint this near to the end of its range, or beyond, leans on the stop: MuJoCo's stops give by about that much.
_AT_STOP = {int(mujoco.mjtJoint.mjJNT_HINGE): 1e-3, int(mujoco.mjtJoint.mjJNT_SLIDE): 1e-4}


@dataclass(frozen=True)
class Passive:
    """Of the hand's degrees of freedom, one entry for each."""

    friction: np.ndarray
    """Largest torque of dry friction, N m or N."""
    limits: np.ndarray
    """(dofs, 2), positions at which a stop is reached, rad or m; infinite without one."""
    stiffness: np.ndarray
    """(dofs, dofs), of the springs of joints and of fixed tendons, N m/rad or N/m, where they are at rest."""
    sprung: np.ndarray
    """Whether a spring acts on it."""

    def stops(self, joints: Any) -> tuple[Any, Any]:
        """Whether joints (*batch, dofs) lean on their lower stop, and on their upper one."""
        low, high = self.limits.T
        return joints <= low, joints >= high


def read_passive(model: mujoco.MjModel, joints: np.ndarray) -> Passive:
    """Reads it for the hand's joints."""
    dofs, off = model.jnt_dofadr[joints], model.opt.disableflags
    friction = np.where(off & _OFF.mjDSBL_FRICTIONLOSS, 0.0, model.dof_frictionloss[dofs])
    near = np.array([_AT_STOP[int(kind)] for kind in model.jnt_type[joints]])
    near = np.maximum(near, model.jnt_margin[joints])[:, None] * [1.0, -1.0]
    limited = model.jnt_limited[joints].astype(bool) & ~bool(off & _OFF.mjDSBL_LIMIT)
    limits = np.where(limited[:, None], model.jnt_range[joints] + near, [-np.inf, np.inf])
    stiffness, sprung = np.diag(model.jnt_stiffness[joints]), model.jnt_stiffness[joints] != 0
    sprung |= (model.jnt_stiffnesspoly[joints] != 0).any(-1)
    for tendon in _sprung_tendons(model):
        lever = levers(model, tendon)[dofs]
        if is_fixed(model, tendon):
            stiffness = stiffness + model.tendon_stiffness[tendon] * np.outer(lever, lever)
        sprung |= lever != 0
    if off & _OFF.mjDSBL_SPRING:
        stiffness, sprung = np.zeros_like(stiffness), np.zeros_like(sprung)
    return Passive(friction=friction, limits=limits, stiffness=stiffness, sprung=sprung)


def spring_torques(model: mujoco.MjModel, joints: np.ndarray, qpos: Any, xp: ModuleType) -> Any:
    """Torques (n, dofs) of the springs of joints and of fixed tendons at qpos (n, nq), N m or N.

    Raises:
        ValueError: A tendon over sites or geoms has a spring.
    """
    dofs, places = model.jnt_dofadr[joints], model.jnt_qposadr[joints]
    total = xp.zeros((len(qpos), len(joints)), qpos.dtype)
    if model.opt.disableflags & _OFF.mjDSBL_SPRING:
        return total
    if (model.jnt_stiffness[joints] != 0).any() or (model.jnt_stiffnesspoly[joints] != 0).any():
        stretch = qpos[:, places] - model.qpos_spring[places].astype(qpos.dtype)
        total = total + _force(model.jnt_stiffness[joints], model.jnt_stiffnesspoly[joints], stretch)
    for tendon in _sprung_tendons(model):
        if not is_fixed(model, tendon):
            raise ValueError(
                f"scene: tendon {model.tendon(tendon).name!r} over sites or geoms has a spring, which engine "
                "'distance' does not know; wanted engine 'mujoco'"
            )
        lever = levers(model, tendon)
        every = np.flatnonzero(model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE))
        weights = lever[model.jnt_dofadr[every]].astype(qpos.dtype)
        length = qpos[:, model.jnt_qposadr[every]] @ weights
        low, high = model.tendon_lengthspring[tendon]
        stretch = xp.where(length > high, length - high, xp.where(length < low, length - low, 0))
        pull = _force(model.tendon_stiffness[tendon], model.tendon_stiffnesspoly[tendon], stretch)
        total = total + pull[:, None] * lever[dofs].astype(qpos.dtype)
    return total


def levers(model: mujoco.MjModel, tendon: int) -> np.ndarray:
    """The derivatives (nv,) of a tendon's length by joint positions; where they vary, 1 for what it acts on."""
    if is_fixed(model, tendon):
        out = np.zeros(model.nv)
        path = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        out[model.jnt_dofadr[model.wrap_objid[path]]] = model.wrap_prm[path]
        return out
    return moved_by_tendon(model, tendon).astype(float)


def _sprung_tendons(model: mujoco.MjModel) -> list[int]:
    return np.flatnonzero((model.tendon_stiffness != 0) | (model.tendon_stiffnesspoly != 0).any(-1)).tolist()


def _force(stiffness: np.ndarray, poly: np.ndarray, stretch: Any) -> Any:
    """MuJoCo's springs: -(k + k_1 x + k_2 x^2) x."""
    return -(stiffness + poly[..., 0] * stretch + poly[..., 1] * stretch**2) * stretch
