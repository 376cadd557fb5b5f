"""Does a hand hold its object? Squeezed, under gravity, and pushed along six directions, in C MuJoCo."""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from jaxgrasp.hands import HandObject
from jaxgrasp.simulation.rollouts import Lanes, Pose, Rollouts, Stage, distances

DIRECTIONS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
"""Of the pushes, world frame."""
# Grasps at a time: with six pushes each some 100 MB.
_TILE = 256
# s. Commands rise slowly enough that fingers press, not strike; loads so that the object is not set swinging.
_SQUEEZE, _LOAD = Stage(rise=0.3, seconds=0.6), Stage(rise=0.1, seconds=0.5)
# Farther than this, m, or turned by more, rad, the object has not stayed.
_FARTHEST, _MOST_TURNED = 0.02, 0.5


@dataclass(frozen=True, kw_only=True)
class Trials:
    """What became of grasps. Courses are gravity alone, then gravity with each of `DIRECTIONS`."""

    held: Bool[np.ndarray, " n"]
    """Whether the object stayed in all courses."""
    held_gravity: Bool[np.ndarray, " n"]
    held_pushes: Bool[np.ndarray, "n 6"]
    displacement: Float[np.ndarray, "n 7"]
    """The farthest that the object's centre of mass was from where the squeeze had left it, m; NaN where nothing was
    simulated: pushes of an object that gravity has taken, and rows that are no grasps."""
    rotation: Float[np.ndarray, "n 7"]
    """The most that the object was turned, rad; NaN likewise."""
    touching: Int[np.ndarray, "n 7"]
    """How many links of the hand touch the object in the end."""
    squeeze_displacement: Float[np.ndarray, " n"]
    """How far the squeeze has moved the object, m."""
    squeeze_rotation: Float[np.ndarray, " n"]
    """rad."""
    push: Float[np.ndarray, " n"]
    """N."""
    qpos: Float[np.ndarray, "n 7 nq"]
    """Where the courses ended; NaN likewise."""


def hold_trials(
    hand: HandObject,
    qpos: Float[np.ndarray, "n nq"],
    controls: Float[np.ndarray, "n actuators"],
    *,
    push: ArrayLike | None = None,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Trials:
    """Squeezes, lets gravity act, and pushes along +-x, +-y, +-z: does the object stay?

    The hand begins at rest in the grasp configuration, under the commands that hold it there. In 0.3 s these become the
    squeeze commands, while the object floats without weight; after another 0.3 s its weight begins to act. 0.5 s later,
    from the state that has been reached, six pushes at the centre of mass begin, each for itself and for 0.5 s; weight
    and pushes rise to their full size in 0.1 s. An object has stayed that was never farther than 2 cm nor turned by
    more than 0.5 rad (29 degrees) from where the squeeze had left it, and that the hand touches in the end.

    The hand itself is without weight, as if its controller bore that: servos that sag would say more about their gains
    than about the grasp. Free joints of the hand and welds that hold its base keep it where the configuration has it.
    All else is the scene's: time step, contact parameters, limits of commands and torques.

    Args:
        hand: The hand and a free object.
        qpos: Grasp configurations, as MuJoCo lays them out.
        controls: Squeeze commands of `HandObject.actuator_names`, from `HandObject.controls` for example. All other
            actuators of the scene have the commands of its first keyframe, or zero.
        push: N, of every push, scalar or (n,); None is the object's weight.
        workers: How many threads; None is one for each core.
        progress: Called with the number of grasps done.

    Returns:
        The outcome. A row that is not finite, or with a quaternion whose norm is not 1, is not held, and neither is one
        whose simulation diverges; NaN commands of an actuator without gain do not matter.

    Raises:
        ValueError: Shapes that do not fit; an object without a free joint or that is welded to something; an actuator
            that integrates its command; pushes that are not finite and positive, or not given where nothing has weight.
    """
    qpos, controls = np.asarray(qpos, float), np.asarray(controls, float)
    count = len(qpos) if qpos.ndim else 0
    shapes = {"qpos": (count, hand.nq), "controls": (count, len(hand.actuators))}
    for name, array in (("qpos", qpos), ("controls", controls)):
        if array.shape != shapes[name]:
            raise ValueError(f"{name}: got shape {array.shape}, wanted {shapes[name]}, one row a grasp")
    rollouts = Rollouts(hand, workers)
    pushes = _pushes(push, count, float(np.linalg.norm(rollouts.weight)))
    idle, known = _idle_commands(hand, qpos)
    # An actuator without gain has no command that could matter.
    controls, idle = (np.where(np.isnan(idle), 0.0, x) for x in (controls, idle))
    known &= np.isfinite(controls).all(-1)
    trials = _nothing(count, hand.nq, pushes)
    for first in range(0, count, _TILE):
        rows = first + np.flatnonzero(known[first : first + _TILE])
        found = _run(rollouts, qpos[rows], idle[rows], controls[rows], pushes[rows])
        for each in fields(Trials):
            getattr(trials, each.name)[rows] = getattr(found, each.name)
        if progress is not None:
            progress(min(first + _TILE, count))
    return trials


def _run(rollouts: Rollouts, qpos: np.ndarray, idle: np.ndarray, controls: np.ndarray, pushes: np.ndarray) -> Trials:
    """All courses of a tile."""
    trials, none = _nothing(len(qpos), qpos.shape[1], pushes), np.zeros((len(qpos), 3))
    weight, begun = none + rollouts.weight, rollouts.pose(qpos)
    squeezed = rollouts.run(_SQUEEZE, rollouts.start(qpos, idle), (idle, controls), (none, none), begun)
    left = rollouts.pose(rollouts.qpos(squeezed))
    trials.squeeze_displacement[:], trials.squeeze_rotation[:] = distances(left, begun)
    borne = rollouts.run(_LOAD, squeezed, (controls, controls), (none, weight), left)
    everything = np.arange(len(qpos))
    trials.held_gravity[:] = _record(trials, rollouts, borne, everything, np.zeros_like(everything))
    # What gravity takes need not be pushed.
    lanes, course = (x.ravel() for x in np.meshgrid(np.flatnonzero(trials.held_gravity), range(6), indexing="ij"))
    force = weight[lanes] + pushes[lanes, None] * DIRECTIONS[course]
    given, still = controls[lanes], Pose(left.position[lanes], left.quaternion[lanes])
    pushed = rollouts.run(_LOAD, borne.take(lanes), (given, given), (weight[lanes], force), still)
    trials.held_pushes[lanes, course] = _record(trials, rollouts, pushed, lanes, 1 + course)
    trials.held[:] = trials.held_pushes.all(-1)
    return trials


def _record(trials: Trials, rollouts: Rollouts, lanes: Lanes, rows: np.ndarray, course: np.ndarray) -> np.ndarray:
    """Writes down how lanes ended, and answers whether the object stayed."""
    qpos = np.where(lanes.sound[:, None], rollouts.qpos(lanes), np.nan)
    trials.qpos[rows, course] = qpos
    trials.displacement[rows, course] = np.where(lanes.sound, lanes.displacement, np.nan)
    trials.rotation[rows, course] = np.where(lanes.sound, lanes.rotation, np.nan)
    touching = np.zeros(len(rows), int)
    touching[lanes.sound] = rollouts.touching(qpos[lanes.sound])
    trials.touching[rows, course] = touching
    near = (lanes.displacement <= _FARTHEST) & (lanes.rotation <= _MOST_TURNED)
    return lanes.sound & near & (touching > 0)


def _nothing(count: int, nq: int, pushes: np.ndarray) -> Trials:
    """Of grasps that were not simulated."""
    courses = 1 + len(DIRECTIONS)
    return Trials(
        held=np.zeros(count, bool),
        held_gravity=np.zeros(count, bool),
        held_pushes=np.zeros((count, len(DIRECTIONS)), bool),
        displacement=np.full((count, courses), np.nan),
        rotation=np.full((count, courses), np.nan),
        touching=np.zeros((count, courses), int),
        squeeze_displacement=np.full(count, np.nan),
        squeeze_rotation=np.full(count, np.nan),
        push=pushes,
        qpos=np.full((count, courses, nq), np.nan),
    )


def _pushes(push: ArrayLike | None, count: int, weight: float) -> Float[np.ndarray, " n"]:
    if push is None and not weight > 0:
        raise ValueError("push: got None, but the object has no weight; wanted newtons")
    pushes = np.asarray(weight if push is None else push, float)
    if pushes.shape not in ((), (count,)):
        raise ValueError(f"push: got shape {pushes.shape}, wanted a number or ({count},)")
    if not (np.isfinite(pushes) & (pushes > 0)).all():
        raise ValueError("push: wanted finite positive numbers of newtons")
    return np.broadcast_to(pushes, (count,)).copy()


def _idle_commands(hand: HandObject, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Commands (n, actuators) that hold configurations without an effort, and which of these are admissible (n,)."""
    idle, known = [], []
    for first in range(0, len(qpos), _TILE):
        # The last tile is filled up, so that one compilation serves all.
        rows = np.arange(first, first + _TILE) % len(qpos)
        grasps = hand.grasps(qpos[rows])
        assert grasps.spring_efforts is not None
        # Neither the actuators nor what joints bear by themselves, dry friction for example, exert anything.
        idle.append(np.asarray(hand.controls(grasps, np.zeros(grasps.spring_efforts.shape))))
        known.append(np.isfinite(np.asarray(grasps.required_wrench)).all(-1))
    if not idle:
        return np.zeros((0, len(hand.actuators))), np.zeros(0, bool)
    return np.concatenate(idle)[: len(qpos)], np.concatenate(known)[: len(qpos)]
