"""The configuration before a grasp: fingers that have let go."""

from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.hands.closing import close_fingers
from jaxgrasp.hands.hand_object import HandObject


def opened(hand: HandObject, qpos: ArrayLike, clearance: float = 0.01) -> Float[Array, "*batch nq"]:
    """The pre-grasp: each finger unbent until its nearest link is so far from the object, as far as its joints let it.

    Args:
        hand: The hand and the object.
        qpos: (*batch, nq), grasps.
        clearance: m.
    """
    return close_fingers(hand, qpos, depth=-clearance)
