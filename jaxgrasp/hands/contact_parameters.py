"""Friction, dimension, margin and gap of contacts, as MuJoCo combines them of the two geoms."""

import warnings
from typing import NamedTuple

import mujoco
import numpy as np


class ContactParameters(NamedTuple):
    """Of one pair of geoms."""

    friction: float
    """Coulomb's coefficient; 0 where condim is 1."""
    margin: float
    """Contacts push up to this distance, m."""
    condim: int


def hand_object_pairs(
    model: mujoco.MjModel, hand: np.ndarray, object: np.ndarray
) -> dict[tuple[int, int], ContactParameters]:
    """Pairs (geom of the hand, geom of the object) that MuJoCo's filters let pass, and their contact parameters.

    Args:
        model: The scene.
        hand: Bodies of the hand.
        object: Bodies of the object.

    Raises:
        ValueError: Nothing of the hand can touch the object.
    """
    of_hand = np.flatnonzero(np.isin(model.geom_bodyid, hand)).tolist()
    of_object = np.flatnonzero(np.isin(model.geom_bodyid, object)).tolist()
    excluded = {tuple(sorted((s >> 16, s & 0xFFFF))) for s in model.exclude_signature.tolist()}
    found = {}
    for g in of_hand:
        for o in of_object:
            bodies = tuple(sorted((int(model.geom_bodyid[g]), int(model.geom_bodyid[o]))))
            meet = model.geom_contype[g] & model.geom_conaffinity[o] | model.geom_contype[o] & model.geom_conaffinity[g]
            # What is fixed to the same body, the world for example, does not collide.
            moving = model.body_weldid[bodies[0]] != model.body_weldid[bodies[1]]
            if meet and moving and bodies not in excluded:
                found[g, o] = _combined(model, g, o)
    # Pairs that are spelt out count whatever the masks say.
    for number, (one, other) in enumerate(zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)):
        for pair in ((one, other), (other, one)):
            if pair[0] in of_hand and pair[1] in of_object:
                condim = int(model.pair_dim[number])
                friction = coulomb(model.pair_friction[number], condim)
                found[pair] = ContactParameters(float(friction), float(model.pair_margin[number]), condim)
    if not found:
        raise ValueError(
            "scene: no geom of the hand can touch a geom of the object; "
            "wanted contype and conaffinity that let some of them collide"
        )
    _warn(model, found)
    return found


def coulomb(friction: np.ndarray, condim: np.ndarray | int) -> np.ndarray:
    """Coulomb's coefficient of MuJoCo's (..., 5): the smaller one of the two tangents, none where condim is 1."""
    return np.where(np.asarray(condim) == 1, 0.0, friction[..., :2].min(-1))


def _combined(model: mujoco.MjModel, a: int, b: int) -> ContactParameters:
    """Of the geom with the higher priority, the larger ones where these are equal; margins add up."""
    rows = [a, b]
    if model.geom_priority[a] != model.geom_priority[b]:
        rows = [a if model.geom_priority[a] > model.geom_priority[b] else b]
    condim = int(model.geom_condim[rows].max())
    friction = 0.0 if condim == 1 else float(model.geom_friction[rows, 0].max())
    return ContactParameters(friction, float(model.geom_margin[[a, b]].sum()), condim)


def _warn(model: mujoco.MjModel, found: dict[tuple[int, int], ContactParameters]) -> None:
    """Says what of the contacts is not modelled."""
    if any(parameters.condim > 3 for parameters in found.values()):
        warnings.warn(
            "scene: contacts have condim 4 or 6, whose torsional and rolling friction is left out: margins are those "
            "of condim 3",
            stacklevel=4,
        )
    two = model.pair_friction[:, 0] != model.pair_friction[:, 1]
    if np.any(two & (model.pair_dim > 1)):
        warnings.warn(
            "scene: contact pairs have two tangential friction coefficients, of which the smaller one counts in all "
            "directions",
            stacklevel=4,
        )
