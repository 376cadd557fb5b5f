"""Position servos: those that a hand has, and those that it is given where its file has none."""

from collections.abc import Callable, Sequence
from os import PathLike

import mujoco
import numpy as np
from jaxtyping import Float

from jaxgrasp.hands.hand_files import hand_spec
from jaxgrasp.hands.hand_object import HandObject

# Of a joint that has none, N m s/rad, kg m^2 and N m: those of the Shadow Hand as published with position servos.
# Without damping and armature MuJoCo's light fingers diverge under servos.
DAMPING, ARMATURE, FRICTION = 0.05, 0.0002, 0.01
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


def prepared_hand(hand: str | PathLike | mujoco.MjSpec, servo_gain: float | None) -> tuple[mujoco.MjSpec, list[str]]:
    """The hand's specification, with servos where a gain is given, and what was added.

    Raises:
        ValueError: The hand cannot be read, or no servo can be added.
    """
    spec = hand_spec(hand)
    if servo_gain is None:
        return spec, []
    if not (np.isfinite(servo_gain) and servo_gain > 0):
        raise ValueError(f"servo gain: got {servo_gain}; wanted a finite number of N m/rad above 0")
    spec, line = with_servos(spec, servo_gain)
    return spec, [line]


def with_servos(hand: mujoco.MjSpec, gain: float) -> tuple[mujoco.MjSpec, str]:
    """A copy of a hand in which every joint that no position servo moves has one.

    Motors become servos of their joint or tendon, with what they can exert as limit; joints on which nothing acts get a
    servo of their own, unless they follow another joint. Joints get damping, armature and dry friction where they have
    none: `DAMPING`, `ARMATURE`, `FRICTION`.

    Args:
        hand: The hand.
        gain: Of the servos, N m/rad.

    Returns:
        The hand, and what was added, in a line.

    Raises:
        ValueError: The hand cannot be compiled, has a sliding joint without an actuator, for which the gain has no
            unit, or has nothing but position servos already.
    """
    spec = hand.copy()
    model = spec.compile()
    motors = [a for a in range(model.nu) if not _is_servo(model, a)]
    for number in motors:
        _make_servo(spec.actuators[number], model, number, gain)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    driven = (moment != 0).any(0)
    couplings = model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    followers = set(model.eq_obj1id[couplings & (model.eq_active0 != 0)].tolist())
    added, poor = [], {"damping": 0, "armature": 0, "dry friction": 0}
    for number in np.flatnonzero(np.isin(model.jnt_type, (_HINGE, _SLIDE))).tolist():
        joint, dof = spec.joints[number], int(model.jnt_dofadr[number])
        if not driven[dof] and number not in followers:
            if model.jnt_type[number] == _SLIDE:
                raise ValueError(
                    f"servo gain: got {gain:g} N m/rad for a hand whose joint {joint.name!r} slides; wanted hinges, or "
                    "a hand with actuators"
                )
            added.append(_add_servo(spec, joint, gain))
        for name, attribute, least in (
            ("damping", "damping", DAMPING),
            ("armature", "armature", ARMATURE),
            ("dry friction", "frictionloss", FRICTION),
        ):
            if getattr(model, f"dof_{attribute}")[dof] == 0 and model.jnt_type[number] == _HINGE:
                _set(joint, attribute, least)
                poor[name] += 1
    if not motors and not added:
        raise ValueError("servo gain: got one for a hand with position servos; wanted none")
    units = {"damping": f"{DAMPING:g} N m s/rad", "armature": f"{ARMATURE:g} kg m^2"}
    units["dry friction"] = f"{FRICTION:g} N m"
    parts = [f"position servos of {gain:g} N m/rad for {len(added) + len(motors)} joints or motors"]
    parts += [f"{name} of {units[name]} for {count} joints" for name, count in poor.items() if count]
    return spec, f"added {', '.join(parts)}"


def servo_commands(hand: HandObject) -> Callable[[np.ndarray], np.ndarray]:
    """What turns wanted lengths of the hand's actuators (*batch, actuators), rad or m, into their commands.

    Raises:
        ValueError: An actuator, which is named, is no position servo.
    """
    own = hand._actuators
    others = [name for name, slope in zip(hand.actuator_names, own.slope, strict=True) if not slope < 0]
    if others or not len(own.numbers):
        what = f"actuators {', '.join(map(repr, others[:3]))} that are no" if others else "no actuators, so no"
        raise ValueError(f"hand: it has {what} position servos; wanted some, or a servo gain (--servo-gain)")
    return lambda length: -(own.bias + own.slope * length) / own.gain


def commands_towards(
    hand: HandObject, data: mujoco.MjData, goals: Sequence[Float[np.ndarray, " nq"]]
) -> list[Float[np.ndarray, " actuators"]]:
    """Commands of the hand's actuators that pull its joints towards configurations.

    Args:
        hand: The hand, all of whose actuators are position servos.
        data: Where the hand is; by the transmission there goals become lengths of the actuators.
        goals: Configurations.

    Raises:
        ValueError: An actuator is no position servo.
    """
    model, command = hand.model, servo_commands(hand)
    moment, places = np.zeros((model.nu, model.nv)), model.jnt_qposadr[hand.joints]
    mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    moment = moment[np.ix_(hand.actuators, hand.dofs)]
    lengths = data.actuator_length[hand.actuators]
    return [command(lengths + moment @ (goal - data.qpos)[places]) for goal in goals]


def _is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    affine = model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_AFFINE)
    return bool(affine and model.actuator_biasprm[actuator, 1] < 0)


def _make_servo(actuator: mujoco.MjsActuator, model: mujoco.MjModel, number: int, gain: float) -> None:
    """Makes a motor a servo: the gear acts on length and force, so that the joint's gain is its square times ours."""
    gear = float(model.actuator_gear[number, 0]) or 1.0
    force, strength = model.actuator_forcerange[number], float(model.actuator_gainprm[number, 0])
    limits = [force] if model.actuator_forcelimited[number] else []
    if model.actuator_ctrllimited[number]:
        limits.append(np.sort(strength * model.actuator_ctrlrange[number]))
    own = gain / gear**2
    actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.gainprm[:3], actuator.biasprm[:3] = (own, 0, 0), (0, -own, 0)
    actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    if limits:
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = (max(x[0] for x in limits), min(x[1] for x in limits))


def _add_servo(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, gain: float) -> str:
    servo = spec.add_actuator(name=f"servo-{joint.name}", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    servo.gainprm[:3], servo.biasprm[:3] = (gain, 0, 0), (0, -gain, 0)
    return servo.name


def _set(joint: mujoco.MjsJoint, attribute: str, value: float) -> None:
    """Joints have one number, or coefficients of which the first is it."""
    if np.ndim(getattr(joint, attribute)):
        getattr(joint, attribute)[0] = value
    else:
        setattr(joint, attribute, value)
