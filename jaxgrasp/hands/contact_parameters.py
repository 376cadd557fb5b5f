"""Friction, dimension, margin and gap of contacts, as MuJoCo combines them of the two geoms."""

import warnings
from typing import NamedTuple

import mujoco
import numpy as np

_NO_WEIGHT = 1e-15


class ContactParameters(NamedTuple):
    """Of one pair of geoms."""

    friction: float
    """Coulomb's coefficient, the smaller one of the two tangents; 0 where condim is 1."""
    widest: float
    """The larger one."""
    margin: float
    """Contacts push up to this distance, m."""
    condim: int
    torsional: float
    """The torsional coefficient, m; 0 where condim is below 4."""
    solref: np.ndarray
    """(2,), MuJoCo's."""
    solimp: np.ndarray
    """(5,)."""


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
                condim, margin = model.pair_dim[number], model.pair_margin[number]
                solver = model.pair_solref[number], model.pair_solimp[number]
                found[pair] = _parameters(model.pair_friction[number], margin, condim, *solver)
    if model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        # The scene's options count in place of all geoms and pairs.
        option = model.opt
        given = option.o_friction, option.o_margin
        solver = option.o_solref, option.o_solimp
        found = {pair: _parameters(*given, own.condim, *solver) for pair, own in found.items()}
    if not found:
        raise ValueError(
            "scene: no geom of the hand can touch a geom of the object; "
            "wanted contype and conaffinity that let some of them collide"
        )
    return found


def coulomb(friction: np.ndarray, condim: np.ndarray | int) -> np.ndarray:
    """Coulomb's coefficient of MuJoCo's (..., 5): the smaller one of the two tangents, none where condim is 1."""
    return np.where(np.asarray(condim) == 1, 0.0, friction[..., :2].min(-1))


def torsion(friction: np.ndarray, condim: np.ndarray | int) -> np.ndarray:
    """The torsional coefficient of MuJoCo's (..., 5), m: none where condim is below 4."""
    return np.where(np.asarray(condim) < 4, 0.0, friction[..., 2])


def _combined(model: mujoco.MjModel, a: int, b: int) -> ContactParameters:
    """Of the geom with the higher priority, the larger ones where these are equal; margins add up."""
    rows = [a, b]
    if model.geom_priority[a] != model.geom_priority[b]:
        rows = [a if model.geom_priority[a] > model.geom_priority[b] else b]
    sliding, twisting, _ = model.geom_friction[rows].max(0)
    margin = model.geom_margin[[a, b]].sum()
    return _parameters(
        np.array([sliding, sliding, twisting]), margin, model.geom_condim[rows].max(), *_solver(model, rows)
    )


def _solver(model: mujoco.MjModel, rows: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Of geoms with the same priority: their weighted mean, or the smaller one of numbers that are stiffnesses."""
    mix = model.geom_solmix[rows]
    # Where all weights are zero they count alike.
    weights = mix / mix.sum() if mix.sum() > _NO_WEIGHT else np.full(len(rows), 1 / len(rows))
    solref = model.geom_solref[rows]
    mixed = weights @ solref if (solref[:, 0] > 0).all() else solref.min(0)
    return mixed, weights @ model.geom_solimp[rows]


def _parameters(
    friction: np.ndarray, margin: float, condim: int, solref: np.ndarray, solimp: np.ndarray
) -> ContactParameters:
    least, most = coulomb(friction, condim), -coulomb(-friction, condim)
    coefficients = float(least), float(most), float(margin), int(condim), float(torsion(friction, condim))
    return ContactParameters(*coefficients, np.array(solref), np.array(solimp))


def warn_of_simplifications(model: mujoco.MjModel, found: dict[tuple[int, int], ContactParameters]) -> None:
    """Warns of what of the contacts is not modelled."""
    if any(parameters.condim > 4 for parameters in found.values()):
        warnings.warn(
            "scene: contacts have condim 6, whose rolling friction is left out: margins are those of condim 4",
            stacklevel=3,
        )
    for pair, parameters in found.items():
        if parameters.friction != parameters.widest:
            names = " and ".join(repr(model.geom(g).name or f"number {g}") for g in pair)
            warnings.warn(
                f"scene: contacts of geoms {names}, for example, have two tangential friction coefficients, "
                f"{parameters.friction:g} and {parameters.widest:g}, of which the smaller one counts in all "
                "directions: margins are those of a narrower cone",
                stacklevel=3,
            )
            break
