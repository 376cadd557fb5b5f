"""Grasps in the scene of a protocol by `hold_trials`, with the outcomes that courses have."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from jaxgrasp.hands import HandObject, Scene
from jaxgrasp.hands.bodies import admissible_configurations
from jaxgrasp.hands.servos import commands_towards
from jaxgrasp.simulation.course import DIVERGED, HELD, LOADS, LOST, NOT_TRIED, NOTHING, UNUSABLE, Outcome
from jaxgrasp.simulation.holding import Trials, hold_trials
from jaxgrasp.simulation.near_figures import Near, NearFigures
from jaxgrasp.simulation.protocols import DIRECTIONS, Hold
from jaxgrasp.simulation.trial_scene import hand_of

# Grasps at a time.
_TILE = 64
# `hold_trials` pushes along +x first, courses along -x.
_ORDER = [list(DIRECTIONS).index(name) for name in ("+x", "-x", "+y", "-y", "+z", "-z")]


@dataclass(frozen=True, eq=False)
class HoldTrial:
    """Tries grasps in one scene."""

    course: Hold
    scene: Scene
    hand: HandObject
    figures: NearFigures
    workers: int

    @classmethod
    def of(cls, course: Hold, scene: Scene, workers: int) -> "HoldTrial":
        """Prepares a scene of `trial_scene`."""
        hand = hand_of(scene)
        return cls(course, scene, hand, NearFigures(hand), workers)

    def run(
        self, stages: Mapping[str, np.ndarray], controls: np.ndarray | None = None
    ) -> Iterator[tuple[int, Outcome]]:
        """Tries grasps.

        Args:
            stages: Configurations (n, nq), "grasp" and "squeeze".
            controls: Squeeze commands (n, actuators) of `HandObject.actuator_names`; None, or others than these, are
                those of servos that pull towards the squeeze.

        Yields:
            Rows and what became of them.

        Raises:
            ValueError: An actuator is no position servo, and there are no commands.
        """
        grasp, data = stages["grasp"], self.figures.data()
        if controls is None or controls.shape != (len(grasp), len(self.hand.actuators)):
            controls = self._commands(grasp, stages["squeeze"])
        known = admissible_configurations(self.scene.model, grasp, np) & np.isfinite(controls).all(-1)
        for first in range(0, len(grasp), _TILE):
            rows = slice(first, first + _TILE)
            trials = hold_trials(self.hand, grasp[rows], controls[rows], push=self.course.push, workers=self.workers)
            for number in range(len(trials.held)):
                row = first + number
                near = self.figures.measure(data, grasp[row]) if known[row] else NOTHING
                yield row, _outcome(trials, number, bool(known[row]), near)

    def _commands(self, grasp: np.ndarray, squeeze: np.ndarray) -> np.ndarray:
        model, data, found = self.scene.model, mujoco.MjData(self.scene.model), []
        for begun, goal in zip(grasp, squeeze, strict=True):
            # What is no configuration is told later.
            data.qpos[:] = np.nan_to_num(begun)
            mujoco.mj_fwdPosition(model, data)
            found += commands_towards(self.hand, data, [goal])
        return np.array(found).reshape(len(grasp), len(self.hand.actuators))


def _outcome(trials: Trials, row: int, known: bool, near: Near) -> Outcome:
    if not known:
        return Outcome(UNUSABLE, NOTHING, np.nan, np.nan, (NOT_TRIED,) * LOADS)
    tried = np.isfinite(trials.displacement[row])
    pushed = bool(trials.held_gravity[row])
    loads = [NOT_TRIED] * LOADS
    for place, held in zip(_ORDER, trials.held_pushes[row], strict=True):
        loads[place] = int(held) if pushed else NOT_TRIED
    # What was begun and has no end has diverged.
    if not tried[0] or (pushed and not tried.all()):
        return Outcome(DIVERGED, near, np.nan, np.nan, (NOT_TRIED,) * LOADS)
    farthest = float(np.nanmax(trials.displacement[row]))
    turned = float(np.degrees(np.nanmax(trials.rotation[row])))
    return Outcome(HELD if trials.held[row] else LOST, near, farthest, turned, tuple(loads))
