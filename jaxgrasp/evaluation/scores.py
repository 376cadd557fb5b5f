"""Contacts of grasps in the scenes of a protocol, for metrics that are held against what became of them."""

from collections.abc import Callable, Sequence
from os import PathLike

import mujoco
import numpy as np

from jaxgrasp.candidates import Candidates, concatenate
from jaxgrasp.files import GraspSet
from jaxgrasp.files.objects import configurations, grouped
from jaxgrasp.hands.servos import prepared_hand
from jaxgrasp.ranking.configurations import candidates_of
from jaxgrasp.simulation import Protocol, hand_of, trial_scene


def candidates_of_grasps(
    grasps: GraspSet,
    protocol: Protocol,
    *,
    hand: str | PathLike | mujoco.MjSpec,
    object: str | PathLike | Sequence[str | PathLike],
    servo_gain: float | None = None,
    max_force: float = 10.0,
    progress: Callable[[int], None] | None = None,
) -> Candidates:
    """The contacts of grasps, and what the hand's actuators can do, with the protocol's friction, mass and gravity.

    Args:
        grasps: The grasps.
        protocol: Whose scenes count.
        hand: As in `Scene.build`.
        object: As for `evaluate`.
        servo_gain: Likewise.
        max_force: Largest normal force of a contact, N.
        progress: Called with the number of grasps done.

    Raises:
        ValueError: Hand, object or grasps cannot be used.
    """
    spec, _ = prepared_hand(hand, servo_gain)
    parts, order = [], []
    for group in grouped(grasps, object):
        scene, chosen = trial_scene(protocol.course, spec, group.object, group.scale), grasps.take(group.rows)
        own = hand_of(scene, max_force=max_force)
        parts.append(candidates_of(own, configurations(scene, chosen), source="", index=group.rows))
        order.append(group.rows)
        if progress is not None:
            progress(sum(map(len, order)))
    return concatenate(parts).take(np.argsort(np.concatenate(order)))
