"""Anybody's grasps in, the same grasps with squeezes out."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from typing import NamedTuple

import mujoco
import numpy as np

from jaxgrasp.files import GRASP, GraspSet, HandPoses, concatenate
from jaxgrasp.files.objects import configurations, grouped
from jaxgrasp.hands import HandObject, Scene
from jaxgrasp.hands.servos import prepared_hand
from jaxgrasp.hands.squeeze_rule import Squeezable, Squeezes, squeezable, squeezes
from jaxgrasp.solvers.status import Status

PREGRASP, SQUEEZE = "pregrasp", "squeeze"


def squeeze_grasps(
    grasps: GraspSet,
    *,
    hand: str | PathLike | mujoco.MjSpec,
    object: str | PathLike | Sequence[str | PathLike],
    mass: float = 0.1,
    friction: float = 0.6,
    max_force: float = 10.0,
    contact_distance: float = 5e-3,
    servo_gain: float | None = None,
    progress: Callable[[int], None] | None = None,
    skipped: Callable[[ValueError], None] | None = None,
) -> GraspSet:
    """Finds squeezes of grasps by the rule of `jaxgrasp.hands.squeeze_rule`: joint targets from the forces of (22).

    Args:
        grasps: Of `jaxgrasp.files.read_grasps`. Squeezes that they have are replaced, and not looked at.
        hand: As in `Scene.build`.
        object: As in `Scene.build`; or several, see `jaxgrasp.files.objects.grouped`.
        mass: Of the object, kg; contacts with a light one are softer.
        friction: Coulomb's coefficient of every contact.
        max_force: Normal force of the most loaded contact, N; less where an actuator reaches its limit.
        contact_distance: Links nearer to the object are contacts, m.
        servo_gain: N m/rad of position servos that the hand is given where it has none, see `hands.servos.with_servos`.
        progress: Called with the number of grasps done. KeyboardInterrupt from it ends the work, and grasps that were
            done are kept.
        skipped: Called with what is wrong with a scene, whose grasps are then left out; None raises it.

    Returns:
        The grasps with a stage "squeeze", and with the columns object_name as the objects are called, margin (N,) in N,
        effort (N,) in N^2, status (N,) of (21), contact_points and forces (N, n_c, 3) on the object in the world frame,
        m and N, torques (N, joints) of the joints that put them there, N m or N, and squeeze_controls (N, actuators).
        Joints of motors, which have no target, stay where they are: their efforts are the controls. Where nothing is
        near, fingers go on as they went from pre-grasp to grasp.

    Raises:
        ValueError: Hand, object or grasps cannot be used.

    Example:
        >>> import jaxgrasp as jg
        >>> from jaxgrasp.files import read_grasps, write_grasps
        >>> grasps = read_grasps("can/*.npy")  # doctest: +SKIP
        >>> squeezed = jg.squeeze_grasps(grasps, hand="right_hand.xml", object="can/pieces")  # doctest: +SKIP
        >>> write_grasps(squeezed, "can.npz")  # doctest: +SKIP
    """
    spec, _ = prepared_hand(hand, servo_gain)
    parts: list[_Part] = []
    for group in grouped(grasps, object):
        try:
            scene = Scene.build(
                hand=spec, object=group.object, scale=group.scale, mass=mass, friction=friction, gravity=(0.0, 0.0, 0.0)
            )
            own = scene.hand_object(max_force=max_force, contact_distance=contact_distance)
            chosen = _whole(grasps.take(group.rows), scene, group.name)
            given = squeezable(own, configurations(scene, chosen))
        except ValueError as error:
            if skipped is None:
                raise
            skipped(ValueError(f"{group.name}, scale {group.scale:g}: {error}"))
        else:
            parts.append(_Part(group.rows, chosen, own, given))
    if not parts:
        return grasps.take(np.zeros(0, int))
    rows = np.concatenate([part.rows for part in parts])
    whole, hand_object = concatenate([part.grasps for part in parts]), parts[0].hand
    found = squeezes(hand_object, Squeezable.joined([part.given for part in parts]), _closing(whole), progress=progress)
    done = len(found.margin)
    return _with_squeezes(whole.take(np.arange(done)), hand_object, found).take(np.argsort(rows[:done]))


class _Part(NamedTuple):
    """Grasps of one scene."""

    rows: np.ndarray
    grasps: GraspSet
    hand: HandObject
    given: Squeezable


def _whole(grasps: GraspSet, scene: Scene, name: str) -> GraspSet:
    """The grasps with all joints of the hand, in its order; those that files do not name stand in its reference."""
    own, names = grasps.for_hand(scene.joint_names), scene.joint_names
    stages = {
        stage: HandPoses(own.stages[stage].base, scene.parts(configurations(scene, own, stage)).joints)
        for stage in own.stages
    }
    return replace(own, stages=stages, joint_names=tuple(names), object_name=np.full(len(own), name))


def _closing(grasps: GraspSet) -> np.ndarray | None:
    """How the joints moved from the pre-grasp to the grasp; None without a pre-grasp."""
    if PREGRASP not in grasps.stages:
        return None
    return grasps.stages[GRASP].joints - grasps.stages[PREGRASP].joints


def _with_squeezes(grasps: GraspSet, hand: HandObject, found: Squeezes) -> GraspSet:
    grasp = grasps.stages[GRASP]
    columns = {
        "margin": found.margin,
        "effort": found.effort,
        "status": np.array([Status(code).name for code in found.status.tolist()]),
        "contact_points": found.points,
        "forces": found.forces,
        "torques": found.torques,
        "squeeze_controls": found.controls,
    }
    stages = {name: stage for name, stage in grasps.stages.items() if name != SQUEEZE}
    return replace(
        grasps,
        stages=stages | {SQUEEZE: HandPoses(grasp.base, grasp.joints + found.joints)},
        columns={name: column for name, column in grasps.columns.items() if name not in columns} | columns,
    )
