"""A controlled hand that holds an object while it is pushed: the experiments of section V, in C MuJoCo."""

from jaxgrasp.simulation.control import ComputedTorque, ForceOptimization, Impedance, JointSprings
from jaxgrasp.simulation.holding import DIRECTIONS, Trials, hold_trials
from jaxgrasp.simulation.path import Path
from jaxgrasp.simulation.run import Push, Run
from jaxgrasp.simulation.simulator import Simulator, torque_hand

__all__ = [
    "DIRECTIONS",
    "ComputedTorque",
    "ForceOptimization",
    "Impedance",
    "JointSprings",
    "Path",
    "Push",
    "Run",
    "Simulator",
    "Trials",
    "hold_trials",
    "torque_hand",
]
