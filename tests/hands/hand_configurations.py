"""Configurations of hands near contact, and what C MuJoCo says about contacts in them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial

import jax
import mujoco
import numpy as np
from test_scenes import reach

from jaxgrasp.hands import HandGrasps, HandObject
from jaxgrasp.hands.scenes import four_fingers, shadow_hand

SCENES = {"four_fingers": four_fingers, "shadow_hand": partial(shadow_hand, coupled_tendons=True)}
COUNT = 1000
SLOTS = 48
"""More than any configuration fills within the margin."""
MARGIN = 0.002
"""C reports contacts up to this far apart, m."""


def model_of(scene: str, name: str) -> mujoco.MjModel:
    """A built-in scene in which C finds contacts as exactly as it can, and near ones too."""
    spec = SCENES[scene](name)
    spec.geom("object").gap = MARGIN
    model = spec.compile()
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-12, 500
    # By default C adds points, beside the nearest, where flat sides lie on each other.
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    return model


def near_contact(model: mujoco.MjModel, count: int, seed: int) -> np.ndarray:
    """(count, nq): the hand closed around the object, joints and object a little moved, some lowered."""
    rng = np.random.default_rng(seed)
    closed = reach(model)[0].qpos
    qpos = np.repeat(closed[None], count, 0)
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    low, high = model.jnt_range[hinges].T
    places = model.jnt_qposadr[hinges]
    moved = qpos[:, places] + rng.uniform(-0.06, 0.06, (count, len(hinges)))
    qpos[:, places] = np.clip(moved, low, high)
    start = model.jnt_qposadr[model.body("object").jntadr[0]]
    qpos[:, start : start + 3] += rng.uniform(-0.002, 0.002, (count, 3))
    # Every fourth object comes down to the palm.
    lowest = 0.055 if model.nu == 12 else 0.04
    qpos[::4, start + 2] -= rng.uniform(0.5, 1.0, len(qpos[::4])) * lowest
    turn = qpos[:, start + 3 : start + 7] + 0.3 * rng.normal(size=(count, 4))
    qpos[:, start + 3 : start + 7] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    return qpos


@dataclass(frozen=True)
class Found:
    """Contacts of hand and object, (n, ...), in the object's frame about its centre of mass; normals outward."""

    lane: np.ndarray
    link: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    distance: np.ndarray
    friction: np.ndarray
    kinds: np.ndarray
    """Of the two geoms, in C's contacts."""


def by_mujoco(model: mujoco.MjModel, qpos: np.ndarray, body: str = "object") -> Found:
    """C's contacts between the object and anything else."""
    data = mujoco.MjData(model)
    number = model.body(body).id
    inside = np.array([_is_below(model, b, number) for b in range(model.nbody)])
    rows = []
    for lane, configuration in enumerate(qpos):
        data.qpos = configuration
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        rotation, centre = data.xmat[number].reshape(3, 3), data.subtree_com[number]
        for contact in data.contact:
            links = model.geom_bodyid[contact.geom]
            ours = inside[links]
            if ours.all() or not ours.any():
                continue
            # C's normal points from the first geom to the second.
            outward = contact.frame[:3] if ours[0] else -contact.frame[:3]
            rows.append(
                (
                    lane,
                    links[~ours][0],
                    rotation.T @ (contact.pos - centre),
                    rotation.T @ outward,
                    contact.dist,
                    contact.friction[0],
                    "-".join(sorted(mujoco.mjtGeom(model.geom_type[g]).name[7:].lower() for g in contact.geom)),
                )
            )
    return Found(*(np.array(column) for column in zip(*rows, strict=True)))


def ours(grasps) -> Found:
    """The same of a batch of grasps, all slots with a point."""
    lane, slot = np.nonzero(np.isfinite(grasps.distances))
    take = lambda x: np.asarray(x)[lane, slot]  # noqa: E731
    contacts = grasps.contacts
    return Found(
        lane,
        take(grasps.links),
        take(contacts.positions),
        take(contacts.frames)[..., 2],
        take(grasps.distances),
        take(contacts.friction),
        np.full(len(lane), ""),
    )


def partners(of: Found, among: Found) -> np.ndarray:
    """(n,): for each contact the nearest of the others on the same link of the same grasp, -1 where there is none.

    Nearest in position, normal and distance taken together, normals as if of 10 mm.
    """
    out = np.full(len(of.lane), -1)
    groups: dict[tuple, list[int]] = {}
    for i, key in enumerate(zip(among.lane.tolist(), among.link.tolist(), strict=True)):
        groups.setdefault(key, []).append(i)
    for i, key in enumerate(zip(of.lane.tolist(), of.link.tolist(), strict=True)):
        candidates = groups.get(key)
        if candidates:
            apart = np.linalg.norm(among.position[candidates] - of.position[i], axis=-1)
            apart += 0.01 * np.linalg.norm(among.normal[candidates] - of.normal[i], axis=-1)
            apart += np.abs(among.distance[candidates] - of.distance[i])
            out[i] = candidates[int(apart.argmin())]
    return out


def differences(of: Found, among: Found) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Differences (n,) in position (m), normal and distance (m) to the partners, inf where there is none."""
    at = partners(of, among)
    there = at >= 0
    norm = lambda x: np.where(there, np.linalg.norm(x, axis=-1), np.inf)  # noqa: E731
    return (
        norm(of.position - among.position[at]),
        norm(of.normal - among.normal[at]),
        np.where(there, np.abs(of.distance - among.distance[at]), np.inf),
        at,
    )


def _is_below(model: mujoco.MjModel, body: int, top: int) -> bool:
    while body > top:
        body = model.body_parentid[body]
    return body == top


@dataclass(frozen=True)
class Case:
    """A scene in many configurations, ours and C's contacts; `slot` says in which slot each of ours is."""

    model: mujoco.MjModel
    qpos: np.ndarray
    hand: HandObject
    grasps: HandGrasps
    ours: Found
    slot: np.ndarray
    theirs: Found


@cache
def case(scene: str, name: str) -> Case:
    """Computed once a process."""
    model = model_of(scene, name)
    qpos = near_contact(model, COUNT, seed=1)
    options = {"contact_distance": 0.0, "points_per_link": None, "max_contacts": SLOTS}
    # Jacobians of directions that are held would leave out what no actuator bears.
    hand = HandObject.from_mjcf(model, "object", unreached="free", **options)
    grasps = jax.tree.map(np.asarray, hand.grasps(qpos, "distance"))
    slot = np.nonzero(np.isfinite(grasps.distances))[1]
    return Case(model, qpos, hand, grasps, ours(grasps), slot, by_mujoco(model, qpos))
