"""What MuJoCo's actuators can do: transmission, limits of effort, stiffness, and commands for wanted efforts."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


@dataclass(frozen=True)
class Actuators:
    """Actuators of a hand whose force is gain * command + bias + slope * length, at rest.

    `numbers` are theirs in the model; every other array has one entry for each of them.
    """

    numbers: np.ndarray
    gain: np.ndarray
    bias: np.ndarray
    slope: np.ndarray
    """d force / d length, N per m or N m per rad; minus the stiffness of a position servo."""
    command: np.ndarray
    """(actuators, 2), range of commands."""
    force: np.ndarray
    """(actuators, 2), range of forces, torque limits of single joints included."""
    transmission: np.ndarray | None
    """B (hand's degrees of freedom, actuators); None where it varies with the configuration."""
    reference: np.ndarray
    """B in the reference configuration, with 1 where an arm happens to be zero there."""

    @property
    def capacity(self) -> np.ndarray:
        """Half of the range of each effort, which may be infinite."""
        with np.errstate(invalid="ignore"):
            command = np.where(self.gain == 0, np.inf, np.abs(self.gain) * np.ptp(self.command, axis=-1) / 2)
            return np.minimum(command, np.ptp(self.force, axis=-1) / 2)

    def limits(self, length: Any, xp: ModuleType = jnp) -> tuple[Any, Any]:
        """Least and largest force at rest, (*batch, actuators), at lengths (*batch, actuators)."""
        # An actuator without gain has no command, however far that may go.
        reach = np.where(self.gain == 0, 0, self.gain * np.where(self.gain == 0, 0, self.command.T))
        ends = [end.astype(length.dtype) + self._at_rest(length) for end in reach]
        low, high = xp.minimum(*ends), xp.maximum(*ends)
        least, most = (end.astype(length.dtype) for end in self.force.T)
        return xp.clip(low, least, most), xp.clip(high, least, most)

    def command_for(self, force: jax.Array, length: jax.Array) -> jax.Array:
        """The command that gives a force at rest; NaN for an actuator that no command moves."""
        gain = jnp.asarray(self.gain, length.dtype)
        return jnp.where(gain == 0, jnp.nan, (force - self._at_rest(length)) / jnp.where(gain == 0, 1, gain))

    def _at_rest(self, length: Any) -> Any:
        """The force without a command."""
        return self.bias.astype(length.dtype) + self.slope.astype(length.dtype) * length


def read_actuators(model: mujoco.MjModel, dofs: np.ndarray) -> Actuators:
    """Reads the actuators that move a hand.

    Args:
        model: The scene.
        dofs: Degrees of freedom of the hand's joints.

    Raises:
        ValueError: An actuator (it is named) whose force at rest is not affine in its command, that acts by something
            else than joints and tendons, or with a limit that this cannot express.
    """
    moment = _moments(model)
    acts = np.array([_acts_on(model, a, moment[a]) for a in range(model.nu)], bool).reshape(model.nu, model.nv)
    numbers = np.flatnonzero(acts[:, dofs].any(-1))
    on_tendon = model.actuator_trntype[numbers] == int(mujoco.mjtTrn.mjTRN_TENDON)
    constant = all(is_fixed(model, t) for t in model.actuator_trnid[numbers[on_tendon], 0])
    affine = np.array([_affine(model, a) for a in numbers.tolist()]).reshape(-1, 3)
    unlimited = np.array([-np.inf, np.inf])
    limited = lambda flags, ranges: np.where(flags[numbers, None], ranges[numbers], unlimited)
    command = limited(model.actuator_ctrllimited, model.actuator_ctrlrange)
    for row, a in enumerate(numbers):
        if model.actuator_dyntype[a] == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
            command[row] = model.actuator_actrange[a] if model.actuator_actlimited[a] else unlimited
    force = limited(model.actuator_forcelimited, model.actuator_forcerange)
    return Actuators(
        numbers=numbers,
        gain=affine[:, 0],
        bias=affine[:, 1],
        slope=affine[:, 2],
        command=command,
        force=_tendon_limits(model, numbers, _joint_limits(model, dofs, numbers, moment, acts, force)),
        transmission=moment[np.ix_(numbers, dofs)].T if constant else None,
        reference=np.where(acts & (moment == 0), 1.0, moment)[np.ix_(numbers, dofs)].T,
    )


def _affine(model: mujoco.MjModel, a: int) -> tuple[float, float, float]:
    """Gain, bias and slope of the force at rest."""
    gain_type, bias_type = mujoco.mjtGain(model.actuator_gaintype[a]), mujoco.mjtBias(model.actuator_biastype[a])
    gain, bias = model.actuator_gainprm[a], model.actuator_biasprm[a]
    affine_gain = gain_type == mujoco.mjtGain.mjGAIN_AFFINE and gain[1] == 0
    known = (gain_type == mujoco.mjtGain.mjGAIN_FIXED or affine_gain) and bias_type in (
        mujoco.mjtBias.mjBIAS_NONE,
        mujoco.mjtBias.mjBIAS_AFFINE,
    )
    if not known:
        raise ValueError(
            f"scene: actuator {_name(model, a)} has gain {gain_type.name[7:].lower()} and bias "
            f"{bias_type.name[7:].lower()}; wanted a force that is affine in its command (motor, position, general)"
        )
    offset, slope = (bias[0], bias[1]) if bias_type == mujoco.mjtBias.mjBIAS_AFFINE else (0.0, 0.0)
    return float(gain[0]), float(offset), float(slope)


def _moments(model: mujoco.MjModel) -> np.ndarray:
    """Moment arms (actuators, degrees of freedom) at the reference configuration."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return moment


def _acts_on(model: mujoco.MjModel, a: int, moment: np.ndarray) -> np.ndarray:
    """Which degrees of freedom (nv,) an actuator acts on in some configuration, given its moments in one."""
    kind = mujoco.mjtTrn(model.actuator_trntype[a])
    if kind in _JOINTS:
        return moment != 0
    if kind != mujoco.mjtTrn.mjTRN_TENDON:
        raise ValueError(f"scene: actuator {_name(model, a)} acts by {kind.name[6:].lower()}; wanted joint or tendon")
    tendon = model.actuator_trnid[a, 0]
    if is_fixed(model, tendon):
        return moment != 0
    # A tendon that happens to cross a joint's axis has no moment there; elsewhere it has.
    return moved_by_tendon(model, tendon)


def moved_by_tendon(model: mujoco.MjModel, tendon: int) -> np.ndarray:
    """The degrees of freedom (nv,) that a tendon over sites and geoms acts on in some configuration."""
    path = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    bodies = {
        int((model.site_bodyid if kind == int(mujoco.mjtWrap.mjWRAP_SITE) else model.geom_bodyid)[number])
        for kind, number in zip(model.wrap_type[path], model.wrap_objid[path], strict=True)
        if kind != int(mujoco.mjtWrap.mjWRAP_PULLEY)
    }
    moved = np.array([moved_by(model, body) for body in bodies])
    return np.asarray(moved.any(0) & ~moved.all(0))


def moved_by(model: mujoco.MjModel, body: int) -> np.ndarray:
    """The degrees of freedom (nv,) that move a body."""
    moved = np.zeros(model.nv, bool)
    while body:
        moved |= model.dof_bodyid == body
        body = int(model.body_parentid[body])
    return moved


def is_fixed(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether a tendon is a sum of joint positions."""
    first = model.tendon_adr[tendon]
    return bool(np.all(model.wrap_type[first : first + model.tendon_num[tendon]] == int(mujoco.mjtWrap.mjWRAP_JOINT)))


def _joint_limits(
    model: mujoco.MjModel,
    dofs: np.ndarray,
    numbers: np.ndarray,
    moment: np.ndarray,
    acts: np.ndarray,
    force: np.ndarray,
) -> np.ndarray:
    """Force ranges within the limits of the joints' own (`actuatorfrcrange`)."""
    force = force.copy()
    for joint in np.flatnonzero(model.jnt_actfrclimited):
        dof = model.jnt_dofadr[joint]
        if dof not in dofs:
            continue
        rows = np.flatnonzero(acts[numbers, dof])
        if not len(rows):
            continue
        if len(rows) != 1 or np.count_nonzero(acts[numbers[rows[0]]]) != 1:
            raise ValueError(
                f"scene: joint {model.joint(joint).name!r} limits the sum of its actuators' forces; wanted limits of "
                "the actuators themselves (forcerange) where these act on several joints or together"
            )
        ends = np.sort(model.jnt_actfrcrange[joint] / moment[numbers[rows[0]], dof])
        force[rows[0]] = np.clip(force[rows[0]], *ends)
    return force


def _tendon_limits(model: mujoco.MjModel, numbers: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Force ranges within the limits of the tendons' own (`actuatorfrcrange`)."""
    force = force.copy()
    pulled = np.where(
        model.actuator_trntype[numbers] == int(mujoco.mjtTrn.mjTRN_TENDON), model.actuator_trnid[numbers, 0], -1
    )
    for tendon in np.flatnonzero(model.tendon_actfrclimited):
        rows = np.flatnonzero(pulled == tendon)
        if len(rows) > 1:
            raise ValueError(
                f"scene: tendon {model.tendon(tendon).name!r} limits the sum of its actuators' forces; wanted limits "
                "of the actuators themselves (forcerange)"
            )
        force[rows] = np.clip(force[rows], *model.tendon_actfrcrange[tendon])
    return force


def _name(model: mujoco.MjModel, actuator: int) -> str:
    return repr(model.actuator(actuator).name) if model.actuator(actuator).name else f"number {actuator}"
