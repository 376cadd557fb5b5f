"""Joints that an equality constraint makes follow others: the velocities that remain free."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxgrasp.hands.actuators import moved_by


@dataclass(frozen=True)
class Couplings:
    """Which of a hand's degrees of freedom follow which.

    follower, leader: (couplings,), places among the hand's degrees of freedom; the leader is -1 where there is none.
    coefficients: (couplings, 4), the derivative's polynomial in the leader's displacement, constant first.
    reference: (couplings,), the leader's position from which that counts.
    free: places of the degrees of freedom that follow none.
    """

    follower: np.ndarray
    leader: np.ndarray
    coefficients: np.ndarray
    reference: np.ndarray
    free: np.ndarray

    @property
    def constant(self) -> np.ndarray:
        """T (dofs, free), where all slopes are constant."""
        return self.velocities(np.zeros(len(self.free) + len(self.follower)), np)

    @property
    def linear(self) -> bool:
        """Whether all slopes are constant."""
        return not self.coefficients[:, 1:].any()

    def velocities(self, joints: Any, xp: ModuleType = jnp) -> Any:
        """T (*batch, dofs, free): all joint velocities from the free ones, at joint positions (*batch, dofs)."""
        count = joints.shape[-1]
        if not count:
            return joints[..., None]
        rows = list(xp.moveaxis(xp.broadcast_to(xp.eye(count, dtype=joints.dtype), (*joints.shape, count)), -2, 0))
        # Couplings may hang on each other in any order.
        for _ in range(len(self.follower)):
            for follower, leader, coefficients, reference in zip(
                self.follower, self.leader, self.coefficients, self.reference, strict=True
            ):
                if leader < 0:
                    rows[follower] = xp.zeros_like(rows[follower])
                    continue
                at = joints[..., leader] - float(reference)
                slope = sum(float(c) * at**power for power, c in enumerate(coefficients))
                rows[follower] = slope[..., None] * rows[leader]  # pyright: ignore[reportIndexIssue]  # no sum of none
        return xp.stack(rows, -2)[..., self.free]


def read_couplings(model: mujoco.MjModel, dofs: np.ndarray) -> Couplings:
    """Reads the couplings among a hand's joints.

    Args:
        model: The scene.
        dofs: Degrees of freedom of the hand's joints.

    Raises:
        ValueError: An equality constraint, which is named, closes a loop through the hand or acts on tendons.
    """
    place = {int(dof): i for i, dof in enumerate(dofs)}
    found = []
    for e in np.flatnonzero(model.eq_active0).tolist():
        kind = mujoco.mjtEq(model.eq_type[e])
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            follower, leader = (int(j) for j in (model.eq_obj1id[e], model.eq_obj2id[e]))
            at = place.get(int(model.jnt_dofadr[follower]))
            if at is None:
                continue
            slopes = model.eq_data[e, 1:5] * np.arange(1, 5)
            if leader < 0:
                found.append((at, -1, np.zeros(4), 0.0))
            elif int(model.jnt_dofadr[leader]) not in place:
                raise ValueError(
                    f"scene: joint {model.joint(follower).name!r} of the hand follows {model.joint(leader).name!r}, "
                    "which is not one of the hand's hinges and slides"
                )
            else:
                reference = model.qpos0[model.jnt_qposadr[leader]]
                found.append((at, place[int(model.jnt_dofadr[leader])], slopes, reference))
        elif kind != mujoco.mjtEq.mjEQ_WELD or not (_holds_a_base(model, e) or _held_by(model, e).any()):
            raise ValueError(
                f"scene: equality constraint {model.equality(e).name or e!r} is of kind {kind.name[5:].lower()}; "
                "wanted couplings of joints alone"
            )
    follower = np.array([f[0] for f in found], int)
    return Couplings(
        follower=follower,
        leader=np.array([f[1] for f in found], int),
        coefficients=np.array([f[2] for f in found]).reshape(-1, 4),
        reference=np.array([f[3] for f in found]),
        free=np.setdiff1d(np.arange(len(dofs)), follower),
    )


def held_by_welds(model: mujoco.MjModel) -> np.ndarray:
    """The joints that a weld to the world, to a mocap body or to what else cannot move holds where they are."""
    held = np.zeros(model.nv, bool)
    for equality in np.flatnonzero(model.eq_active0 & (model.eq_type == int(mujoco.mjtEq.mjEQ_WELD))).tolist():
        held |= _held_by(model, equality)
    return np.flatnonzero(held[model.jnt_dofadr])


def _held_by(model: mujoco.MjModel, weld: int) -> np.ndarray:
    """The degrees of freedom (nv,) that it holds."""
    none = np.zeros(model.nv, bool)
    if model.eq_objtype[weld] != int(mujoco.mjtObj.mjOBJ_BODY):
        return none
    one, other = (moved_by(model, int(body)) for body in (model.eq_obj1id[weld], model.eq_obj2id[weld]))
    return none if one.any() and other.any() else one | other


def _holds_a_base(model: mujoco.MjModel, equality: int) -> bool:
    """Whether a weld only holds a free body, the base of a hand for example, in its place."""
    if model.eq_objtype[equality] != int(mujoco.mjtObj.mjOBJ_BODY):
        return False
    free = set(model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)].tolist())
    return bool(free & {int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])})
