"""How hand and object stand to each other in a grasp: penetration, and the benchmark's three figures of contact."""

import copy
from typing import NamedTuple

import mujoco
import numpy as np

from jaxgrasp.hands import HandObject
from jaxgrasp.hands.bodies import bodies_below

# m. Fingers farther from the object than this count as so far; links nearer than that as contacts.
REACH, TOUCHING = 0.01, 0.002


class Near(NamedTuple):
    """Of one configuration."""

    penetration: float
    """Of hand and object, m, at least 0."""
    self_penetration: float
    """Of parts of the hand, m."""
    contact_number: int
    """Links of the hand within 2 mm of the object."""
    contact_distance: float
    """Mean over the fingers of their distance to the object, between 0 and 1 cm, m."""
    contact_consistency: float
    """The farthest finger's distance less the nearest one's, negative ones where they penetrate, m."""


class NearFigures:
    """Measures configurations of one scene."""

    def __init__(self, hand: HandObject):
        """Takes a copy of the scene in which all geoms of the object have a margin of 1 cm."""
        self._model = model = copy.copy(hand.model)
        of_object = np.isin(model.geom_bodyid, bodies_below(model, hand.object_body))
        model.geom_margin[of_object] = REACH
        self._object, self._hand = of_object, np.isin(model.geom_bodyid, hand.bodies)
        self._finger = _fingers(hand)[model.geom_bodyid]

    def data(self) -> mujoco.MjData:
        """What `measure` works in; one for each thread."""
        return mujoco.MjData(self._model)

    def measure(self, data: mujoco.MjData, qpos: np.ndarray) -> Near:
        """Measures one configuration (nq,)."""
        model = self._model
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        pairs, apart = data.contact.geom, data.contact.dist
        with_object, with_hand = self._object[pairs], self._hand[pairs]
        between = with_object.any(-1) & with_hand.any(-1)
        own = with_hand.all(-1)
        geoms = np.where(with_hand[between, 0], pairs[between, 0], pairs[between, 1])
        distances, fingers = apart[between], self._finger[geoms]
        nearest = np.full(self._finger.max(initial=-1) + 1, REACH)
        np.minimum.at(nearest, fingers[fingers >= 0], distances[fingers >= 0])
        return Near(
            penetration=max(0.0, -float(distances.min(initial=0.0))),
            self_penetration=max(0.0, -float(apart[own].min(initial=0.0))),
            contact_number=len(np.unique(model.geom_bodyid[geoms[np.abs(distances) < TOUCHING]])),
            contact_distance=float(nearest.clip(0).mean()) if len(nearest) else float("nan"),
            contact_consistency=float(np.ptp(nearest)) if len(nearest) else float("nan"),
        )


def _fingers(hand: HandObject) -> np.ndarray:
    """(bodies,), which finger each body is of: -1 for the palm and what is not the hand's.

    The palm is the last body that all joints hang on; a finger is what hangs on one of its joints.
    """
    model, moved = hand.model, hand.moved_bodies
    fingers = np.full(model.nbody, -1)
    everything = moved.any(0)
    # Joints that move all that moves stand before the palm.
    inner = [j for j in range(moved.shape[1]) if not moved[moved.any(-1), j].all()]
    if not inner:
        inner = list(np.flatnonzero(everything))
    count = 0
    for body in hand.bodies:
        above = int(model.body_parentid[body])
        if not moved[body, inner].any():
            continue
        if fingers[above] >= 0:
            fingers[body] = fingers[above]
        else:
            fingers[body], count = count, count + 1
    return fingers
