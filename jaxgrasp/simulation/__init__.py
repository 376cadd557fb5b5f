"""Hands that hold an object while it is pushed, in C MuJoCo: the experiments of section V, and trials of grasps."""

from jaxgrasp.simulation.control import ComputedTorque, ForceOptimization, Impedance, JointSprings
from jaxgrasp.simulation.course import (
    DIVERGED,
    HELD,
    INSIDE,
    LOADS,
    LOST,
    NOT_TRIED,
    NOTHING,
    UNUSABLE,
    CourseTrial,
    Outcome,
)
from jaxgrasp.simulation.hold_course import HoldTrial
from jaxgrasp.simulation.holding import DIRECTIONS, Trials, hold_trials
from jaxgrasp.simulation.path import Path
from jaxgrasp.simulation.protocols import PROTOCOLS, Course, Hold, Protocol, protocol_named
from jaxgrasp.simulation.rollouts import quiet
from jaxgrasp.simulation.run import Push, Run
from jaxgrasp.simulation.simulator import Simulator, torque_hand
from jaxgrasp.simulation.trial_scene import hand_of, trial_scene

__all__ = [
    "DIRECTIONS",
    "DIVERGED",
    "HELD",
    "INSIDE",
    "LOADS",
    "LOST",
    "NOTHING",
    "NOT_TRIED",
    "PROTOCOLS",
    "UNUSABLE",
    "ComputedTorque",
    "Course",
    "CourseTrial",
    "ForceOptimization",
    "Hold",
    "HoldTrial",
    "Impedance",
    "JointSprings",
    "Outcome",
    "Path",
    "Protocol",
    "Push",
    "Run",
    "Simulator",
    "Trials",
    "hand_of",
    "hold_trials",
    "protocol_named",
    "quiet",
    "torque_hand",
    "trial_scene",
]
