"""A hand and a free object in C MuJoCo: many lanes at once over all cores, commands and loads known beforehand."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, fields
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco import rollout

from jaxgrasp.hands import HandObject
from jaxgrasp.hands.bodies import bodies_below

# kg and kg m^2, added to a free base of the hand: 10 N move it by 0.1 mm in half a second. With a hundred times as much
# the accelerations of light fingers drown in rounding.
_ANCHORED = 1e4
# Steps at a time: what is kept of them is bounded.
_STEPS = 25
_GIVEN = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
_STATE = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)


class Pose(NamedTuple):
    """Of the object."""

    position: Float[np.ndarray, "*batch 3"]
    """Of the centre of mass, m, world frame."""
    quaternion: Float[np.ndarray, "*batch 4"]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A part of an experiment: commands and the force on the object rise evenly, then stay."""

    rise: float
    """s."""
    seconds: float
    """In all."""


@dataclass(frozen=True, kw_only=True)
class Lanes:
    """Where simulations are."""

    state: Float[np.ndarray, "lanes state"]
    """MuJoCo's full physics state, its first number the time."""
    sound: Bool[np.ndarray, " lanes"]
    """False where a simulation has diverged; its state then means nothing."""
    displacement: Float[np.ndarray, " lanes"]
    """The farthest that the object was from its reference in the last stage, m."""
    rotation: Float[np.ndarray, " lanes"]
    """The most that it was turned from there, rad."""

    def take(self, lanes: Int[np.ndarray, " chosen"]) -> "Lanes":
        """Some of the lanes, also several times."""
        return Lanes(**{each.name: getattr(self, each.name)[lanes] for each in fields(self)})


class Rollouts:
    """Simulations of a scene in which nothing has weight; forces on the object are given.

    The base of a hand with a free joint stays where it is.
    """

    def __init__(self, hand: HandObject, workers: int | None = None):
        """Prepares the scene.

        Args:
            hand: The hand and the object.
            workers: How many threads; None is one for each core.

        Raises:
            ValueError: The object has no free joint or is welded to something, or an actuator integrates its command.
        """
        self._hand, self._address = hand, _free_joint(hand)
        self.model = _anchored(hand)
        self._links = np.unique(hand.slot_links)
        of_object = bodies_below(hand.model, hand.object_body)
        mass = hand.model.body_mass[of_object]
        self._geoms = np.isin(hand.model.geom_bodyid, of_object)
        # Forces on the bodies of the object that together act at its centre of mass.
        self._wrench = hand.model.nu + 6 * of_object[:, None] + np.arange(3)
        self._share = (mass / mass.sum())[:, None]
        self._data = [mujoco.MjData(self.model) for _ in range(workers or os.cpu_count() or 1)]
        self._rest, self._others = _at_rest(self.model)
        self._centre = _mass_centre(hand)

    @property
    def weight(self) -> Float[np.ndarray, "3"]:
        """Of the object, N, world frame."""
        return self._hand.object_mass * self._hand.model.opt.gravity

    def start(self, qpos: Float[np.ndarray, "lanes nq"], commands: Float[np.ndarray, "lanes actuators"]) -> Lanes:
        """Lanes at rest; actuators with a state of their own have reached their commands."""
        model, count = self.model, len(qpos)
        state = np.tile(self._rest, (count, 1))
        state[:, 1 : 1 + model.nq] = qpos
        activation = model.actuator_actadr[self._hand.actuators]
        slow = activation >= 0
        state[:, 1 + model.nq + model.nv + activation[slow]] = commands[:, slow]
        none = np.zeros(count)
        return Lanes(state=state, sound=np.ones(count, bool), displacement=none, rotation=none)

    def qpos(self, lanes: Lanes) -> Float[np.ndarray, "lanes nq"]:
        """Configurations."""
        return lanes.state[:, 1 : 1 + self.model.nq]

    def pose(self, qpos: Float[np.ndarray, "*batch nq"]) -> Pose:
        """Of the object in configurations."""
        quaternion = qpos[..., self._address + 3 : self._address + 7]
        quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
        return Pose(qpos[..., self._address : self._address + 3] + _turned(quaternion, self._centre), quaternion)

    def run(
        self,
        stage: Stage,
        lanes: Lanes,
        commands: tuple[np.ndarray, np.ndarray],
        force: tuple[np.ndarray, np.ndarray],
        reference: Pose,
    ) -> Lanes:
        """Simulates one stage.

        Args:
            stage: How long, and how fast commands and force change.
            lanes: Where it begins.
            commands: In the beginning and in the end, (lanes, actuators).
            force: On the object's centre of mass, (lanes, 3), N, world frame.
            reference: From which the object's motion counts.
        """
        model, steps = self.model, round(stage.seconds / self.model.opt.timestep)
        count, state, begun = len(lanes.state), lanes.state, lanes.state[:, 0].copy()
        given = np.zeros((count, _STEPS, model.nu + 6 * model.nbody))
        given[..., : model.nu] = self._others
        farthest, turned = np.zeros(count), np.zeros(count)
        still = Pose(reference.position[:, None], reference.quaternion[:, None])
        with quiet(), rollout.Rollout(nthread=len(self._data)) as pool:
            for first in range(0, steps if count else 0, _STEPS):
                time = model.opt.timestep * np.arange(first, min(first + _STEPS, steps))
                share = np.clip(time / stage.rise, 0, 1)[:, None]
                part = given[:, : len(time)]
                part[..., self._hand.actuators] = _between(commands, share)
                part[..., self._wrench] = self._share * _between(force, share)[..., None, :]
                states = np.asarray(pool.rollout(model, self._data, state, part, control_spec=_GIVEN)[0])
                state = states[:, -1]
                apart = distances(self.pose(states[..., 1 : 1 + model.nq]), still)
                farthest, turned = (np.maximum(a, b.max(1)) for a, b in zip((farthest, turned), apart, strict=True))
        # MuJoCo begins anew where a state is not finite or velocities are huge, and a rollout then goes no further.
        in_time = np.abs(state[:, 0] - begun - steps * model.opt.timestep) < 0.5 * model.opt.timestep
        return Lanes(state=state, sound=lanes.sound & in_time, displacement=farthest, rotation=turned)

    def touching(self, qpos: Float[np.ndarray, "lanes nq"]) -> Int[np.ndarray, " lanes"]:
        """How many links of the hand touch the object."""
        model, data, counts = self.model, self._data[0], []
        for each in qpos:
            data.qpos[:] = each
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            pairs = data.contact.geom[data.contact.dist <= 0]
            with_object = self._geoms[pairs].sum(-1) == 1
            links = model.geom_bodyid[pairs[with_object]]
            counts.append(np.isin(np.unique(links), self._links).sum())
        return np.array(counts, int)


def distances(pose: Pose, other: Pose) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """How far apart two poses are, m, and how much turned, rad."""
    same = np.abs((pose.quaternion * other.quaternion).sum(-1))
    return np.linalg.norm(pose.position - other.position, axis=-1), 2 * np.arccos(np.clip(same, 0, 1))


def _between(ends: tuple[np.ndarray, np.ndarray], share: np.ndarray) -> np.ndarray:
    """(lanes, steps, k) from (lanes, k) each and shares (steps, 1)."""
    begin, end = (x[:, None] for x in ends)
    return begin + share * (end - begin)


def _turned(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector (3,) turned by unit quaternions (*batch, 4)."""
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    across = 2 * np.cross(axis, vector)
    return vector + scalar * across + np.cross(axis, across)


def _free_joint(hand: HandObject) -> int:
    """Where the object's pose begins in a configuration."""
    model, body = hand.model, hand.object_body
    free = np.flatnonzero((model.jnt_bodyid == body) & (model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)))
    name = repr(model.body(body).name)
    if not len(free):
        raise ValueError(f"hand: its object, body {name}, has no free joint; wanted an object that can fall")
    welds = np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_WELD))
    for weld in welds[model.eq_active0[welds] != 0]:
        if np.isin(_welded(model, weld), bodies_below(model, body)).any():
            raise ValueError(f"hand: its object, body {name}, is welded to another; wanted an object that can fall")
    return int(model.jnt_qposadr[free[0]])


def _welded(model: mujoco.MjModel, weld: int) -> np.ndarray:
    """The two bodies of a weld."""
    ends = np.array([model.eq_obj1id[weld], model.eq_obj2id[weld]])
    return ends if model.eq_objtype[weld] == int(mujoco.mjtObj.mjOBJ_BODY) else model.site_bodyid[ends]


def _anchored(hand: HandObject) -> mujoco.MjModel:
    """The scene without weight, free bases of the hand held by an inertia of tons."""
    model = copy(hand.model)
    numbers = hand.actuators
    integrating = numbers[model.actuator_dyntype[numbers] == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)]
    if len(integrating):
        names = ", ".join(repr(model.actuator(a).name) for a in integrating)
        raise ValueError(f"hand: actuators {names} integrate their commands; wanted commands that are held")
    model.opt.gravity[:] = 0
    free = model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
    for joint in np.flatnonzero(free & (model.jnt_bodyid != hand.object_body)):
        first = model.jnt_dofadr[joint]
        model.dof_armature[first : first + 6] = _ANCHORED
    # Welds would pull a base back to where the scene has it.
    model.eq_active0[model.eq_type == int(mujoco.mjtEq.mjEQ_WELD)] = 0
    return model


def _at_rest(model: mujoco.MjModel) -> tuple[Float[np.ndarray, " state"], Float[np.ndarray, " nu"]]:
    """State and commands of the first keyframe where there is one, else MuJoCo's own; at time zero, at rest."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    data.time, data.qvel[:] = 0, 0
    state = np.zeros(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    return state, data.ctrl.copy()


def _mass_centre(hand: HandObject) -> Float[np.ndarray, "3"]:
    """Of the object, in its body's frame."""
    model, data = hand.model, mujoco.MjData(hand.model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    body = hand.object_body
    return data.xmat[body].reshape(3, 3).T @ (data.subtree_com[body] - data.xpos[body])


@contextmanager
def quiet() -> Iterator[None]:
    """Passes over MuJoCo's warnings, of simulations that diverge: they would go to the terminal and to a log file."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
