"""One grasp after the other on a course: approach, squeeze, and loads from the state after the squeeze, in C MuJoCo."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from jaxgrasp.hands import HandObject, Scene
from jaxgrasp.hands.bodies import bodies_below
from jaxgrasp.hands.hand_files import BASE
from jaxgrasp.hands.servos import commands_towards, servo_commands
from jaxgrasp.simulation.near_figures import Near, NearFigures
from jaxgrasp.simulation.protocols import DIRECTIONS, Course
from jaxgrasp.simulation.trial_scene import hand_of

HELD, LOST, INSIDE, DIVERGED, UNUSABLE = "held", "lost", "penetration", "diverged", "not usable"
OUTCOMES = (HELD, LOST, INSIDE, DIVERGED, UNUSABLE)
"""Held; lost; not tried, for it penetrates; a simulation that diverged, which says nothing; no configuration."""
# Bodies faster than this, m/s or rad/s, are no physics: a load of a course makes its object at most 60 m/s fast.
_ABSURD = 1000.0
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_DIVERGING = [mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC]
NOT_TRIED, LOADS = -1, len(DIRECTIONS)

Observer = Callable[[mujoco.MjData, np.ndarray], None]
"""Called after every few steps with the state and the load, N."""


class Outcome(NamedTuple):
    """What became of one grasp."""

    outcome: str
    """One of `OUTCOMES`."""
    near: Near
    delta_pos: float
    """m, how far the object's frame was from where the file has it when it was last looked at; NaN where nothing was
    tried or the simulation diverged."""
    delta_angle: float
    """Degrees, likewise."""
    loads: tuple[int, ...]
    """1 for each load that was borne, 0 where not, -1 where it was not tried."""


NOTHING = Near(np.nan, np.nan, 0, np.nan, np.nan)


class Diverged(Exception):
    """The numbers are no physics any more."""


@dataclass(frozen=True, eq=False)
class CourseTrial:
    """Tries grasps on a course in one scene."""

    course: Course
    scene: Scene
    hand: HandObject
    figures: NearFigures

    @classmethod
    def of(cls, course: Course, scene: Scene) -> "CourseTrial":
        """Prepares a scene of `trial_scene`.

        Raises:
            ValueError: An actuator is no position servo.
        """
        hand = hand_of(scene)
        servo_commands(hand)
        return cls(course, scene, hand, NearFigures(hand))

    def data(self) -> tuple[mujoco.MjData, mujoco.MjData]:
        """What `run` works in; one for each thread."""
        return mujoco.MjData(self.scene.model), self.figures.data()

    def run(
        self,
        data: tuple[mujoco.MjData, mujoco.MjData],
        stages: Mapping[str, Float[np.ndarray, " nq"]],
        observe: Observer | None = None,
    ) -> Outcome:
        """Tries one grasp.

        Args:
            data: Of `data`.
            stages: Configurations by stage, "grasp" and those of the course.
            observe: Called after every few steps.
        """
        course = self.course
        moving, still = data
        begun = stages[course.start]
        everything = [begun, *(stages[name] for name in course.stages)]
        if not all(np.isfinite(qpos).all() for qpos in everything):
            return Outcome(UNUSABLE, NOTHING, np.nan, np.nan, (NOT_TRIED,) * len(course.load_directions))
        near, first = (self.figures.measure(still, stages[name]) for name in ("grasp", course.start))
        deepest = max(near.penetration, near.self_penetration, first.penetration, first.self_penetration)
        none = (NOT_TRIED,) * len(course.load_directions)
        if course.max_penetration is not None and deepest > course.max_penetration:
            return Outcome(INSIDE, near, np.nan, np.nan, none)
        observe = observe or _nobody
        try:
            self._squeeze(moving, everything, observe)
            return self._loaded(moving, begun, near, observe)
        except Diverged:
            return Outcome(DIVERGED, near, np.nan, np.nan, none)

    def _squeeze(self, data: mujoco.MjData, configurations: list[np.ndarray], observe: Observer) -> None:
        """From the start by way of the stages, commands piecewise linear."""
        course, model = self.course, self.scene.model
        mujoco.mj_resetData(model, data)
        data.qpos[:] = configurations[0]
        base = model.jnt_qposadr[model.joint(BASE).id] + np.arange(7)
        poses = [qpos[base] for qpos in configurations]
        data.mocap_pos[0], data.mocap_quat[0] = poses[0][:3], poses[0][3:]
        mujoco.mj_forward(model, data)
        own = self.hand.actuators
        commands = commands_towards(self.hand, data, configurations)
        data.ctrl[own] = commands[0]
        # Actuators with a state of their own have reached their commands.
        slow = model.actuator_actadr[own] >= 0
        data.act[model.actuator_actadr[own][slow]] = commands[0][slow]
        mujoco.mj_forward(model, data)
        none = np.zeros(3)
        observe(data, none)
        for number in range(1, len(configurations)):
            for share in np.linspace(0, 1, course.commands_per_stage + 1)[1:]:
                data.mocap_pos[0] = poses[number - 1][:3] + share * (poses[number][:3] - poses[number - 1][:3])
                data.mocap_quat[0] = _slerp(poses[number - 1][3:], poses[number][3:], share)
                data.ctrl[own] = commands[number - 1] + share * (commands[number] - commands[number - 1])
                mujoco.mj_forward(model, data)
                _step(model, data, course.steps_per_command)
                observe(data, none)

    def _loaded(self, data: mujoco.MjData, begun: np.ndarray, near: Near, observe: Observer) -> Outcome:
        """Each load from the state in which `data` is."""
        course, model = self.course, self.scene.model
        state = np.zeros(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, data, state, _STATE)
        # Forces on the object's bodies that together act at its centre of mass.
        bodies = bodies_below(model, self.hand.object_body)
        share = (model.body_mass[bodies] / model.body_mass[bodies].sum())[:, None]
        first = model.jnt_qposadr[model.body_jntadr[self.hand.object_body]]
        goal = begun[first : first + 7]
        size = course.load
        if course.load_acceleration is not None:
            size = course.load_acceleration * self.hand.object_mass
        checks = round(course.load_seconds / course.check_seconds)
        steps = round(course.check_seconds / course.timestep)
        borne = []
        delta = (np.nan, np.nan)
        for name in course.load_directions:
            mujoco.mj_setState(model, data, state, _STATE)
            force = size * np.array(DIRECTIONS[name])
            data.xfrc_applied[bodies, :3] = share * force
            held = True
            for _ in range(checks):
                # In short pieces only where somebody looks on; what happens is the same.
                for piece in _pieces(steps, course.steps_per_command) if observe is not _nobody else (steps,):
                    _step(model, data, piece)
                    observe(data, force)
                delta = _apart(goal, data.qpos[first : first + 7])
                held = self._stayed(data, delta)
                if not held:
                    break
            borne.append(held)
            if not held and course.stop_at_failure:
                break
        loads = (*map(int, borne), *(NOT_TRIED,) * (len(course.load_directions) - len(borne)))
        return Outcome(HELD if sum(borne) >= course.needed_loads else LOST, near, *delta, loads)

    def _stayed(self, data: mujoco.MjData, delta: tuple[float, float]) -> bool:
        course = self.course
        limits = zip(delta, (course.max_displacement, course.max_rotation), strict=True)
        if any(limit is not None and not value < limit for value, limit in limits):
            return False
        return not course.must_touch or self._touching(data)

    def _touching(self, data: mujoco.MjData) -> bool:
        bodies = self.scene.model.geom_bodyid[data.contact.geom[data.contact.dist <= 0]]
        of_object = np.isin(bodies, bodies_below(self.scene.model, self.hand.object_body))
        return bool((of_object.any(-1) & np.isin(bodies, self.hand.bodies).any(-1)).any())


def _nobody(*_: object) -> None:
    """Looks on when nobody does."""


def _pieces(steps: int, most: int) -> Iterator[int]:
    for begun in range(0, steps, most):
        yield min(most, steps - begun)


def _step(model: mujoco.MjModel, data: mujoco.MjData, count: int) -> None:
    """Steps on.

    Raises:
        Diverged: MuJoCo began anew, or something is faster than anything can be.
    """
    mujoco.mj_step(model, data, nstep=count)
    begun_anew = any(data.warning[kind].number for kind in _DIVERGING)
    if begun_anew or not (np.abs(data.qvel) < _ABSURD).all() or not np.isfinite(data.qpos).all():
        raise Diverged


def _slerp(begin: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """Between unit quaternions, the shorter way."""
    change, turned, out = np.zeros(3), np.zeros(4), np.zeros(4)
    mujoco.mju_subQuat(change, end, begin)
    length = float(np.linalg.norm(change))
    mujoco.mju_axisAngle2Quat(turned, change / length if length else np.array([1.0, 0, 0]), share * length)
    mujoco.mju_mulQuat(out, begin, turned)
    return out


def _apart(pose: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """How far two poses are apart, m, and turned, degrees."""
    same = abs(float(pose[3:] @ other[3:]) / float(np.linalg.norm(pose[3:]) * np.linalg.norm(other[3:])))
    return float(np.linalg.norm(pose[:3] - other[:3])), float(np.degrees(2 * np.arccos(min(1.0, same))))
