"""Trials of single grasps for the page of `jaxgrasp view`."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.hand_grasps import grasps_of_files

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.cli.scene import Scene
    from jaxgrasp.files import GraspSet
    from jaxgrasp.viewer.bodies import Film


def protocols() -> tuple[str, ...]:
    """The protocols with a course that can be watched, by their names."""
    from jaxgrasp.simulation import PROTOCOLS, Course

    return tuple(name for name, protocol in PROTOCOLS.items() if isinstance(protocol.course, Course))


def films(options: "Scene", candidates: "Candidates") -> "Callable[[int, str], Film]":
    """A function that tries one candidate by a protocol; it raises ValueError where that cannot be.

    Args:
        options: The hand, the object and the grasps.
        candidates: Of these grasps.
    """

    @functools.cache
    def grasps() -> "tuple[GraspSet, dict[str, int]]":
        try:
            found = grasps_of_files(options.grasps, options.grasp_format, hand=options.hand, scale=options.scale)
        except CommandError as error:
            raise ValueError(str(error)) from error
        return found, {source: row for row, source in enumerate(found.source.tolist())}

    def film(row: int, protocol: str) -> "Film":
        from jaxgrasp import evaluation
        from jaxgrasp.simulation import hand_of
        from jaxgrasp.viewer.bodies import Film, bodies_along

        given, places = grasps()
        source = candidates.sources[candidates.source[row]]
        alone = given.take(np.array([places[f"{source}:{candidates.index[row]}"]]))
        hand, object = options.hand, options.object
        assert hand is not None and object is not None
        found = evaluation.evaluate(alone, hand=hand, object=object, protocol=protocol, workers=1)
        scene, frames = evaluation.film(found, 0, hand=hand, object=object)
        if not frames:
            raise ValueError(f"nothing to watch: {found.outcome[0]}")
        bodies = bodies_along(hand_of(scene), np.stack([qpos for _, qpos, _ in frames]))
        return Film(
            bodies=bodies,
            time=np.array([time for time, _, _ in frames]),
            load=np.stack([load for _, _, load in frames]) @ bodies.turn.T,
            outcome=str(found.outcome[0]),
        )

    return film
