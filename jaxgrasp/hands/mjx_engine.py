"""Engine `mjx`: MJX's kinematics and collision, for batches on accelerators and inside one jit.

MJX's functions for boxes, meshes and height fields tell how deep geoms penetrate, but not how far they are apart: this
engine answers for pairs that touch or penetrate. Pairs of the other kinds have distances, too.
"""

import copy
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import eval_jaxpr
from jax.interpreters import partial_eval

from jaxgrasp.hands.actuators import Actuators
from jaxgrasp.hands.contact_parameters import ContactParameters, hand_object_pairs
from jaxgrasp.hands.engines import Geometry
from jaxgrasp.hands.link_contacts import RawPoints
from jaxgrasp.hands.mjx_models import allowing_mjx, mjx_module, mjx_of
from jaxgrasp.hands.passive import spring_torques
from jaxgrasp.hands.tendons import transmission_of

_PLANE, _FIELD, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
# What MJX has functions for, the lower number of MuJoCo's kinds first.
_KNOWN = {
    _PLANE: {_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH},
    _FIELD: {_SPHERE, _CAPSULE, _BOX, _MESH},
    _SPHERE: {_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH},
    _CAPSULE: {_CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH},
    _ELLIPSOID: {_ELLIPSOID, _CYLINDER},
    _CYLINDER: {_CYLINDER},
    _BOX: {_BOX, _MESH},
    _MESH: {_MESH},
}
# Of these MJX says nothing while they are apart.
_ONLY_DEPTH = {_FIELD, _BOX, _MESH}
# MuJoCo's masks have as many bits.
_BITS = 31


class Slots(NamedTuple):
    """Places for contacts of hand and object."""

    numbers: np.ndarray
    """(slots,), where they are among all of MJX's."""
    pairs: list[tuple[int, int]]
    """The geoms of hand and object of each."""
    sign: np.ndarray
    """(slots,), 1 where MJX's normal points out of the object, -1 where into it."""


class MjxEngine:
    """Finds contacts of a hand and an object with MJX."""

    tile = 64
    """Configurations at a time on CPUs."""
    differentiable = False

    def __init__(
        self,
        model: mujoco.MjModel,
        hand: np.ndarray,
        object: np.ndarray,
        joints: np.ndarray,
        actuators: Actuators,
        contact_distance: float,
    ):
        """Takes a copy of the scene in which nothing but hand and object collides.

        Args:
            model: The scene.
            hand: Bodies of the hand.
            object: Bodies of the object, the one that moves first.
            joints: The hand's joints, hinges and slides.
            actuators: Those that move the hand.
            contact_distance: Up to which points count, m.

        Raises:
            ValueError: A pair of geoms can touch that MJX does not know, or whose distance it does not tell where that
                is wanted.
        """
        self._pairs = hand_object_pairs(model, hand, object)
        _refuse(model, self._pairs, contact_distance)
        self._model, self._scene = _without_others(model, self._pairs), model
        self._object, self._joints, self._actuators = object, joints, actuators
        self._distance = contact_distance
        masses = np.maximum(model.body_mass[object], 1e-12)
        self._shares = masses / masses.sum()

    def find(self, qpos: jax.Array) -> Geometry:
        """What is where in configurations (n, nq)."""
        slots = self.slots
        parameters = [self._pairs[pair] for pair in slots.pairs]
        names = ("friction", "margin", "torsional")
        friction, margin, torsional = (np.array([getattr(p, name) for p in parameters]) for name in names)
        reach = np.maximum(self._distance, margin)
        with allowing_mjx():
            device, data = mjx_of(self._model)
            found = jax.vmap(lambda row: self._one(device, data, row, slots.numbers))(qpos)
        distance, position, normal, rotation, centre, anchors, axes = (x.astype(qpos.dtype) for x in found)
        raw = RawPoints(
            position=position,
            normal=normal * slots.sign[:, None].astype(qpos.dtype),
            # What is apart has numbers that are no distances.
            distance=jnp.where(distance <= reach.astype(qpos.dtype), distance, jnp.inf),
            link=self._scene.geom_bodyid[[geom for geom, _ in slots.pairs]],
            friction=friction.astype(qpos.dtype),
            reach=reach.astype(qpos.dtype),
            torsional=torsional.astype(qpos.dtype),
        )
        lengths, moments = transmission_of(self._scene, self._joints, self._actuators, qpos)
        springs = spring_torques(self._scene, self._joints, qpos, jnp)
        return Geometry(raw, rotation, centre, anchors, axes, lengths, moments, springs)

    def _one(self, device, data, qpos: jax.Array, kept: np.ndarray) -> tuple[jax.Array, ...]:
        mjx = mjx_module()
        placed = mjx.kinematics(device, data.replace(qpos=qpos))
        contact = mjx.collision(device, placed)._impl.contact
        shares = jnp.asarray(self._shares, placed.xipos.dtype)
        return (
            contact.dist[kept],
            contact.pos[kept],
            contact.frame[kept, 0],
            placed.xmat[self._object[0]],
            shares @ placed.xipos[self._object],
            placed.xanchor[self._joints],
            placed.xaxis[self._joints],
        )

    @cached_property
    def slots(self) -> "Slots":
        """The contacts that MJX may find, the same ones in every configuration."""
        mjx = mjx_module()
        with allowing_mjx(), jax.ensure_compile_time_eval():
            device, data = mjx_of(self._model)
            traced = jax.make_jaxpr(lambda data: mjx.collision(device, data)._impl.contact.geom)(data)
            # What is left without all that does not make these numbers takes no compiler.
            bare, used = partial_eval.dce_jaxpr(traced.jaxpr, [True])
            inputs = [x for x, needed in zip(jax.tree.leaves(data), used, strict=True) if needed]
            geoms = np.asarray(eval_jaxpr(bare, traced.consts, *inputs)[0])
        first_is_object = np.isin(self._model.geom_bodyid[geoms[:, 0]], self._object)
        pairs = np.where(first_is_object[:, None], geoms[:, ::-1], geoms)
        # Pairs that are spelt out are found, too, where they are none of hand and object.
        numbers = np.flatnonzero([tuple(pair) in self._pairs for pair in pairs.tolist()])
        return Slots(
            numbers=numbers,
            pairs=[(hand, object) for hand, object in pairs[numbers].tolist()],
            # MJX's normal points from the first geom to the second.
            sign=np.where(first_is_object[numbers], 1.0, -1.0),
        )


def _refuse(model: mujoco.MjModel, pairs: dict[tuple[int, int], ContactParameters], contact_distance: float) -> None:
    """Raises a ValueError for what MJX cannot answer."""
    for geoms, parameters in pairs.items():
        kinds = sorted(int(model.geom_type[g]) for g in geoms)
        names = " and ".join(
            f"{model.geom(g).name or f'number {g}'!r} ({mujoco.mjtGeom(model.geom_type[g]).name[7:].lower()})"
            for g in geoms
        )
        if kinds[1] not in _KNOWN.get(kinds[0], ()):
            raise ValueError(f"engine: MJX has no collision of geoms {names}; wanted engine 'mujoco' or 'distance'")
        reach = max(contact_distance, parameters.margin)
        if reach > 0 and _ONLY_DEPTH & set(kinds):
            raise ValueError(
                f"engine: MJX finds geoms {names} only where they penetrate, and contacts up to {reach:g} m apart are "
                "wanted; wanted a contact distance (and margins) of 0, or engine 'mujoco' or 'distance'"
            )


def _without_others(model: mujoco.MjModel, pairs: dict[tuple[int, int], ContactParameters]) -> mujoco.MjModel:
    """A copy in which masks let hand and object collide alone: a bit for all geoms that meet the same others."""
    model = copy.copy(model)
    sides = [{}, {}]
    for pair in pairs:
        for side, (one, other) in zip(sides, (pair, pair[::-1]), strict=True):
            side.setdefault(one, set()).add(other)
    rows = min(
        (list(zip(s, map(frozenset, s.values()), strict=True)) for s in sides), key=lambda r: len({x for _, x in r})
    )
    bits = {met: bit for bit, met in enumerate(dict.fromkeys(met for _, met in rows))}
    if len(bits) > _BITS:
        raise ValueError(f"engine: MJX would need {len(bits)} masks for this scene, wanted at most {_BITS}")
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    for geom, met in rows:
        model.geom_contype[geom] = 1 << bits[met]
        for other in met:
            model.geom_conaffinity[other] |= 1 << bits[met]
    # Distances are told whatever the margins are, and limits of how many contacts there are would hide some.
    model.geom_margin[:] = model.geom_gap[:] = model.pair_margin[:] = model.pair_gap[:] = 0
    for number in range(model.nnumeric):
        if model.numeric(number).name in ("max_geom_pairs", "max_contact_points"):
            model.numeric_data[model.numeric_adr[number]] = -1
    return model
