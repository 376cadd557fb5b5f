"""Whether grasps of a hand are good: contacts, penetration, and the margin that the actuators can produce."""

import enum
import functools
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxgrasp.compiling import compiled
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.hands import HandGrasps, HandObject, close_fingers
from jaxgrasp.hands.squeeze_rule import pressed, squeezable
from jaxgrasp.hands.squeezing import opened
from jaxgrasp.hands.surroundings import Surroundings
from jaxgrasp.robustness import largest_disturbance, least_effort
from jaxgrasp.solvers.status import Status

# Deeper than this, m, a grasp is not good; and with a margin of no more than that.
DEEPEST, LEAST_MARGIN = 2e-3, 1e-4
# Of its margin, up to which a grasp can be squeezed.
SHARE = 0.9
# Grasps at a time.
_TILE = 256


class Verdict(enum.IntEnum):
    """What is to be said of a grasp; of several faults the first."""

    GOOD = 0
    """Contacts enough, nothing more than 2 mm inside anything, a positive margin."""
    FEW_CONTACTS = 1
    """Fewer links touch than wanted."""
    PENETRATION = 2
    """Hand and object are more than 2 mm inside each other."""
    SELF_PENETRATION = 3
    """Parts of the hand are more than 2 mm inside each other."""
    NO_MARGIN = 4
    """The hand cannot bear the weight, or withstands no disturbance besides."""
    NOT_FINITE = 5
    """The descent lost it."""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """What is known of a batch of grasps."""

    qpos: Float[np.ndarray, "grasps nq"]
    """The grasps: fingers that touch."""
    pregrasp: Float[np.ndarray, "grasps nq"]
    """The fingers a centimetre off the object."""
    squeeze: Float[np.ndarray, "grasps nq"]
    """Where the joints would go under the commands if nothing were in the way; NaN where there are none."""
    controls: Float[np.ndarray, "grasps actuators"]
    """Commands, in the order of `HandObject.actuator_names`, that squeeze as hard as (22) says, through the contacts'
    softness and dry friction; NaN where it has no answer."""
    contact_points: Float[np.ndarray, "grasps contacts 3"]
    """m, world frame."""
    forces: Float[np.ndarray, "grasps contacts 3"]
    """Of the fingers on the object under the commands, N, world frame; zero for absent contacts."""
    margin: Float[np.ndarray, " grasps"]
    """(21), with the limits of the actuators and the weight."""
    upper_bound: Float[np.ndarray, " grasps"]
    """Certified."""
    status: Int[np.ndarray, " grasps"]
    """`Status` of (21)."""
    verdict: Int[np.ndarray, " grasps"]
    """`Verdict`: whether the grasp is good, and if not why."""
    touching: Int[np.ndarray, " grasps"]
    """Contacts."""
    penetration: Float[np.ndarray, " grasps"]
    """Of hand and object, m."""
    self_penetration: Float[np.ndarray, " grasps"]
    """Of parts of the hand, m."""
    landmarks: Float[np.ndarray, "grasps landmarks 3"]
    """The palm and the links that shall touch, in the object's frame about its centre of mass, m: by these grasps are
    told apart."""


def closed(around: Surroundings, qpos: Float[np.ndarray, "grasps nq"]) -> Float[np.ndarray, "grasps nq"]:
    """The configurations with the fingers closed until they touch."""
    size = min(_TILE, len(qpos))
    tiles = [qpos[first : first + size] for first in range(0, len(qpos), size)]
    return np.concatenate([np.asarray(close_fingers(around.hand, padded(t, size)))[: len(t)] for t in tiles])


def padded(rows: np.ndarray, count: int) -> np.ndarray:
    """Filled up with rows that are there already, so that one compilation serves all."""
    return rows[np.arange(count) % len(rows)]


def judged(
    around: Surroundings,
    qpos: Float[np.ndarray, "grasps nq"],
    disturbances: DisturbanceSet,
    min_contacts: int,
    squeeze: Float[Array, ""],
) -> Judgement:
    """Judges grasps whose fingers are closed.

    Args:
        around: The hand and the object.
        qpos: The grasps.
        disturbances: What they shall withstand.
        min_contacts: With fewer they are not good.
        squeeze: The margin for which commands are found, at most `SHARE` of that of the grasp.
    """
    count, size = len(qpos), min(_TILE, len(qpos))
    parts = []
    for first in range(0, count, size):
        rows = padded(qpos[first : first + size], size)
        found = _judged(around, jnp.asarray(rows), disturbances, squeeze)
        parts.append({name: np.asarray(x)[: count - first] for name, x in found.items()})
    found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    solved = (found["status"] == Status.SOLVED) & (found["margin"] > LEAST_MARGIN)
    faults = [
        ~np.isfinite(qpos).all(-1),
        found["touching"] < min_contacts,
        found["penetration"] > DEEPEST,
        found["self_penetration"] > DEEPEST,
        ~solved,
    ]
    names = [Verdict.NOT_FINITE, Verdict.FEW_CONTACTS, Verdict.PENETRATION, Verdict.SELF_PENETRATION, Verdict.NO_MARGIN]
    verdict = np.select(faults, names, Verdict.GOOD)
    return Judgement(qpos=qpos, verdict=verdict, **found)


def _judged(
    around: Surroundings, qpos: Float[Array, "n nq"], disturbances: DisturbanceSet, squeeze: Float[Array, ""]
) -> dict[str, Any]:
    hand = around.hand
    grasps = hand.grasps(qpos)
    given = {"required_wrench": grasps.required_wrench, "actuation": grasps.actuation}
    best = largest_disturbance(grasps.contacts, disturbances, **given)
    wanted = jnp.minimum(SHARE * jnp.maximum(best.margin, 0), squeeze)
    hold = least_effort(grasps.contacts, disturbances, wanted, **given)
    points, forces = grasps.in_world_frame(hold.forces)
    self_penetration, landmarks = _of_the_hand(qpos, around)
    return {
        "pregrasp": opened(hand, qpos),
        **_squeeze(hand, qpos, grasps, hold.forces),
        "contact_points": points,
        "forces": forces,
        "margin": best.margin,
        "upper_bound": best.upper_bound,
        "status": best.status,
        "touching": grasps.touching,
        "penetration": grasps.penetration,
        "self_penetration": self_penetration,
        "landmarks": landmarks,
    }


def _squeeze(hand: HandObject, qpos: Array, grasps: HandGrasps, forces: Array) -> dict[str, Any]:
    """Where joints are sent, and the commands for it, by the rule of `squeeze_rule`; without actuators they stay."""
    moved, given_forces = np.array(qpos, float), np.asarray(forces)
    if grasps.actuation is None or not len(hand.actuators):
        return {"squeeze": moved, "controls": np.zeros((len(moved), 0))}
    unknown = ~np.isfinite(given_forces).all((-1, -2))
    known_forces = np.where(unknown.reshape(-1, 1, 1), 0, given_forces)
    joints, controls = pressed(hand, squeezable(hand, moved, grasps), known_forces)
    joints[unknown], controls[unknown] = np.nan, np.nan
    moved[:, hand.model.jnt_qposadr[hand.joints]] += joints
    return {"squeeze": moved, "controls": controls}


@functools.partial(compiled, static_argnums=(1,))
def _of_the_hand(qpos: Float[Array, "n nq"], around: Surroundings) -> tuple[Array, Array]:
    """How deep the hand is in itself (n,), and where the landmarks are in the object's frame (n, landmarks, 3)."""
    poses, rotation, centre = around.hand.frames(qpos)
    apart = poses.positions[:, np.array([around.palm, *around.links])].T - centre[:, None]
    depth = jnp.maximum(0, -around.self_pairs.distances(poses).min(0))
    return depth, jnp.einsum("nji,nlj->nli", rotation, apart)
