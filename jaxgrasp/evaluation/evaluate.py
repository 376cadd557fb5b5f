"""Tries many grasps by a protocol, on all cores."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from os import PathLike
from typing import Generic, TypeVar

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxgrasp.files import GRASP, GraspSet
from jaxgrasp.files.objects import Group, configurations, grouped
from jaxgrasp.hands import Scene
from jaxgrasp.hands.servos import prepared_hand
from jaxgrasp.simulation import (
    DIVERGED,
    HELD,
    LOADS,
    NOT_TRIED,
    NOTHING,
    UNUSABLE,
    Course,
    CourseTrial,
    Hold,
    HoldTrial,
    Outcome,
    Protocol,
    protocol_named,
    quiet,
    trial_scene,
)

T = TypeVar("T")
_UNUSABLE = Outcome(UNUSABLE, NOTHING, np.nan, np.nan, (NOT_TRIED,) * LOADS)
# s between two looks at what is done, in which a caller can stop.
_PATIENCE = 0.2
CONTROLS = "squeeze_controls"
"""Column with commands of the hand's actuators, in which `jaxgrasp-hold` takes what motors are to exert."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What became of N grasps."""

    protocol: Protocol
    grasps: GraspSet
    """Those that were tried, in the order given."""
    object: Shaped[np.ndarray, " batch"]
    """What the object of each is called, text."""
    outcome: Shaped[np.ndarray, " batch"]
    """held, lost, penetration (not tried), diverged, which says nothing of the grasp, or not usable; text."""
    held: Bool[np.ndarray, " batch"]
    delta_pos: Float[np.ndarray, " batch"]
    """How far the object was from where the file has it when it was last looked at, m; NaN where nothing was found."""
    delta_angle: Float[np.ndarray, " batch"]
    """How much it was turned, degrees."""
    penetration: Float[np.ndarray, " batch"]
    """Of hand and object in the grasp, m."""
    self_penetration: Float[np.ndarray, " batch"]
    """Of parts of the hand, m."""
    contact_number: Int[np.ndarray, " batch"]
    """Links within 2 mm of the object."""
    contact_distance: Float[np.ndarray, " batch"]
    """Mean distance of fingers and object, m."""
    contact_consistency: Float[np.ndarray, " batch"]
    """How much farther the farthest finger is than the nearest, m."""
    loads: Int[np.ndarray, "batch 6"]
    """1 for each load that was borne, 0 where not, -1 where it was not tried."""
    said: tuple[str, ...]
    """What the grasps or the hand lacked, and what was taken in its place."""
    interrupted: bool
    """Whether Ctrl-C has left some grasps out."""

    def __len__(self) -> int:
        """Returns how many grasps were tried."""
        return len(self.grasps)

    @property
    def tried(self) -> Bool[np.ndarray, " batch"]:
        """Whether something is known of the grasp: all but what diverged and what is no configuration."""
        return ~np.isin(self.outcome, (DIVERGED, UNUSABLE))


def evaluate(
    grasps: GraspSet,
    *,
    hand: str | PathLike | mujoco.MjSpec,
    object: str | PathLike | Sequence[str | PathLike],
    protocol: str | Protocol = "dexgraspbench-fc",
    servo_gain: float | None = None,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
    skipped: Callable[[ValueError], None] | None = None,
) -> Evaluation:
    """Tries grasps in C MuJoCo by a named protocol.

    Args:
        grasps: Of `jaxgrasp.files.read_grasps`; stages that they lack are the grasp itself.
        hand: As in `Scene.build`.
        object: As in `Scene.build`; or several, see `jaxgrasp.files.objects.grouped`.
        protocol: One of `jaxgrasp.simulation.PROTOCOLS`, by its name, or your own.
        servo_gain: N m/rad of position servos that the hand is given where it has none, see `hands.servos.with_servos`.
        workers: How many threads; None is one for each core.
        progress: Called often with the number of grasps done. KeyboardInterrupt from it ends the trials, and what was
            done is kept.
        skipped: Called with what is wrong with a scene, whose grasps are then not usable; None raises it.

    Returns:
        What became of each grasp.

    Raises:
        ValueError: Hand, object, protocol or grasps cannot be used.

    Example:
        >>> import jaxgrasp as jg
        >>> from jaxgrasp.files import read_grasps
        >>> found = jg.evaluate(read_grasps("can/*.npy"), hand="right_hand.xml", object="can/pieces")  # doctest: +SKIP
        >>> found.held.mean()  # doctest: +SKIP
    """
    protocol = protocol_named(protocol) if isinstance(protocol, str) else protocol
    spec, said = prepared_hand(hand, servo_gain)
    said += _missing(grasps, protocol)
    groups = list(grouped(grasps, object))
    report = progress or (lambda _: None)
    found: dict[int, Outcome] = {}
    interrupted = False
    workers = workers or os.cpu_count() or 1
    course = protocol.course
    if isinstance(course, Course):
        trial_of = partial(CourseTrial.of, course)
        outcomes = _on_course(_prepared(grasps, groups, course, spec, trial_of, skipped), workers)
    else:
        hold_of = partial(HoldTrial.of, course, workers=workers)
        outcomes = _on_hold(_prepared(grasps, groups, course, spec, hold_of, skipped))
    with quiet():
        try:
            for row, outcome in outcomes:
                if outcome is not None:
                    found[row] = outcome
                report(len(found))
        except KeyboardInterrupt:
            interrupted = True
    names = np.full(len(grasps), "", dtype=f"U{max((len(g.name) for g in groups), default=1) or 1}")
    for group in groups:
        names[group.rows] = group.name
    rows = np.array(sorted(found), int)
    return _evaluation(
        protocol, grasps.take(rows), names[rows], [found[row] for row in rows.tolist()], said, interrupted
    )


def film(
    evaluation: Evaluation,
    row: int,
    *,
    hand: str | PathLike | mujoco.MjSpec,
    object: str | PathLike | Sequence[str | PathLike],
    servo_gain: float | None = None,
) -> tuple[Scene, list[tuple[float, np.ndarray, np.ndarray]]]:
    """Tries one grasp of an evaluation again, and keeps what there is to see.

    Args:
        evaluation: Of a protocol with a course.
        row: Which of its grasps.
        hand: As for `evaluate`.
        object: Likewise.
        servo_gain: Likewise.

    Returns:
        The scene, and for every few hundredths of a second the time, s, the configuration (nq,) and the load (3,), N.

    Raises:
        ValueError: The protocol has no course.
    """
    course = evaluation.protocol.course
    if isinstance(course, Hold):
        raise ValueError(f"protocol: got {evaluation.protocol.name!r}, which has no course to film")
    spec, _ = prepared_hand(hand, servo_gain)
    alone = evaluation.grasps.take(np.array([row]))
    group = next(grouped(alone, object))
    trial = CourseTrial.of(course, trial_scene(course, spec, group.object, group.scale))
    frames: list[tuple[float, np.ndarray, np.ndarray]] = []
    pause = course.timestep * course.steps_per_command

    def observe(data: mujoco.MjData, load: np.ndarray) -> None:
        # Every load begins at the time after the squeeze; a movie goes on.
        frames.append((len(frames) * pause, data.qpos.copy(), load.copy()))

    with quiet():
        trial.run(trial.data(), {name: x[0] for name, x in stages_of(trial.scene, alone, course).items()}, observe)
    return trial.scene, frames


def stages_of(scene: Scene, grasps: GraspSet, course: Course | Hold) -> dict[str, np.ndarray]:
    """Configurations (n, nq) of the stages that a course asks for; a stage that is missing is the grasp."""
    names = (course.start, *course.stages) if isinstance(course, Course) else ("squeeze",)
    return {
        name: configurations(scene, grasps, name if name in grasps.stages else GRASP)
        for name in dict.fromkeys((GRASP, *names))
    }


def _missing(grasps: GraspSet, protocol: Protocol) -> list[str]:
    course = protocol.course
    asked = (course.start, *course.stages) if isinstance(course, Course) else ("squeeze",)
    missing = [name for name in asked if name not in grasps.stages]
    return [f"the grasps have no {' and no '.join(missing)}: the grasp itself was taken for it"] if missing else []


@dataclass(frozen=True)
class _Prepared(Generic[T]):
    """Grasps of one scene."""

    grasps: GraspSet
    rows: list[int]
    """The rows of these grasps among all grasps."""
    stages: dict[str, np.ndarray]
    trial: T | None
    """None where hand and object are not usable."""


def _prepared(
    grasps: GraspSet,
    groups: list[Group],
    course: Course | Hold,
    spec: mujoco.MjSpec,
    trial_of: Callable[[Scene], T],
    skipped: Callable[[ValueError], None] | None,
) -> Iterator[_Prepared[T]]:
    """Scene by scene, each made when the one before it is under way."""
    for group in groups:
        chosen, rows = grasps.take(group.rows), group.rows.tolist()
        try:
            scene = trial_scene(course, spec, group.object, group.scale)
            stages, trial = stages_of(scene, chosen, course), trial_of(scene)
        except ValueError as error:
            if skipped is None:
                raise
            skipped(ValueError(f"{group.name}, scale {group.scale:g}: {error}"))
            stages, trial = {}, None
        yield _Prepared(chosen, rows, stages, trial)


def _on_course(prepared: Iterator[_Prepared[CourseTrial]], workers: int) -> Iterator[tuple[int, Outcome | None]]:
    """Row by row as they are done; (-1, None) now and then while one waits."""
    own = threading.local()

    def run(trial: CourseTrial, stages: dict[str, np.ndarray]) -> Outcome:
        if getattr(own, "trial", None) is not trial:
            own.trial, own.data = trial, trial.data()
        return trial.run(own.data, stages)

    running: dict[Future[Outcome], int] = {}

    def done(most: int) -> Iterator[tuple[int, Outcome | None]]:
        """Waits until no more than so many are running."""
        while len(running) > most:
            finished, _ = wait(running, timeout=_PATIENCE, return_when=FIRST_COMPLETED)
            for future in finished:
                yield running.pop(future), future.result()
            yield -1, None

    pool = ThreadPoolExecutor(workers)
    try:
        for part in prepared:
            for number, row in enumerate(part.rows):
                if part.trial is None:
                    yield row, _UNUSABLE
                    continue
                yield from done(2 * workers)
                stages = {name: x[number] for name, x in part.stages.items()}
                running[pool.submit(run, part.trial, stages)] = row
        yield from done(0)
    finally:
        # Those that have begun are short; the others are given up.
        pool.shutdown(wait=True, cancel_futures=True)


def _on_hold(prepared: Iterator[_Prepared[HoldTrial]]) -> Iterator[tuple[int, Outcome | None]]:
    """In tiles, each of which runs on all cores."""
    for part in prepared:
        if part.trial is None:
            yield from ((row, _UNUSABLE) for row in part.rows)
            continue
        for number, outcome in part.trial.run(part.stages, part.grasps.columns.get(CONTROLS)):
            yield part.rows[number], outcome


def _evaluation(
    protocol: Protocol,
    grasps: GraspSet,
    names: np.ndarray,
    outcomes: list[Outcome],
    said: list[str],
    interrupted: bool,
) -> Evaluation:
    array = lambda values, kind="float": np.array(list(values), np.dtype(kind))
    return Evaluation(
        protocol=protocol,
        grasps=grasps,
        object=names,
        outcome=array((o.outcome for o in outcomes), "str"),
        held=array((o.outcome == HELD for o in outcomes), "bool"),
        delta_pos=array(o.delta_pos for o in outcomes),
        delta_angle=array(o.delta_angle for o in outcomes),
        penetration=array(o.near.penetration for o in outcomes),
        self_penetration=array(o.near.self_penetration for o in outcomes),
        contact_number=array((o.near.contact_number for o in outcomes), "int"),
        contact_distance=array(o.near.contact_distance for o in outcomes),
        contact_consistency=array(o.near.contact_consistency for o in outcomes),
        loads=array((o.loads for o in outcomes), "int8").reshape(len(outcomes), LOADS),
        said=tuple(said),
        interrupted=interrupted,
    )
