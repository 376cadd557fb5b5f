"""Which geoms of a hand can touch which of an object, and where they do: one contact slot for every possible point."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxgrasp.geometry.pairs import Geom, Hull, slots, touch
from jaxgrasp.hands.contact_parameters import hand_object_pairs

KIND = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}


@dataclass(frozen=True)
class Group:
    """Pairs of geoms that one function of the table of pairs answers, all at once."""

    kinds: tuple[str, str]
    hand: np.ndarray
    """(pairs,), geoms of the hand, by their place in `PairTable.geoms`."""
    object: np.ndarray
    """(pairs,), geoms of the object."""
    hulls: tuple[Hull | None, Hull | None]


class Points(NamedTuple):
    """Where geoms touch or come near, in the world frame; slots lead, the batch trails."""

    position: jax.Array
    """(slots, 3, *lanes), midway between the surfaces, m."""
    normal: jax.Array
    """(slots, 3, *lanes), outward from the object, unit."""
    distance: jax.Array
    """(slots, *lanes), m, negative where they penetrate; inf in slots without a point."""


@dataclass(frozen=True)
class PairTable:
    """The pairs of a scene in groups, and what is known of every slot beforehand."""

    groups: tuple[Group, ...]
    geoms: np.ndarray
    """The geoms that take part, their numbers in the model."""
    sizes: np.ndarray
    """(geoms, 3), MuJoCo's sizes."""
    link: np.ndarray
    """(slots,), body of the hand."""
    friction: np.ndarray
    """(slots,), sliding friction by MuJoCo's rule."""
    margin: np.ndarray
    """(slots,), up to which distance MuJoCo's contacts push, m."""
    torsional: np.ndarray
    """(slots,), torsional coefficients, m."""


def pair_table(model: mujoco.MjModel, hand: np.ndarray, object: np.ndarray) -> PairTable:
    """Finds the pairs of geoms that MuJoCo lets collide.

    Args:
        model: The scene.
        hand: Bodies of the hand.
        object: Bodies of the object.

    Raises:
        ValueError: A pair of geoms that can touch has no function, or nothing of the hand can touch the object.
    """
    found: dict[tuple, list[tuple[int, int]]] = {}
    known = hand_object_pairs(model, hand, object)
    for pair in known:
        kinds = _kinds(model, *pair)
        meshes = tuple(int(model.geom_dataid[g]) if k == "mesh" else -1 for g, k in zip(pair, kinds, strict=True))
        found.setdefault((kinds, meshes), []).append(pair)
    groups, link, mu, margin, torsional = [], [], [], [], []
    used = np.unique([pair for pairs in found.values() for pair in pairs])
    for (kinds, meshes), pairs in found.items():
        geoms = np.array(pairs)
        of_hand, of_object = np.searchsorted(used, geoms).T
        hulls = [None if m < 0 else hull_of(model, m) for m in meshes]
        groups.append(Group(kinds, of_hand, of_object, (hulls[0], hulls[1])))
        count = slots(*kinds)
        link.append(np.tile(model.geom_bodyid[geoms[:, 0]], count))
        mu.append(np.tile([known[pair].friction for pair in pairs], count))
        margin.append(np.tile([known[pair].margin for pair in pairs], count))
        torsional.append(np.tile([known[pair].torsional for pair in pairs], count))
    slots_of = [np.concatenate(parts) for parts in (link, mu, margin, torsional)]
    return PairTable(tuple(groups), used, model.geom_size[used], *slots_of)


def touching_points(table: PairTable, positions: jax.Array, rotations: jax.Array) -> Points:
    """Points of all slots.

    Args:
        table: The pairs.
        positions: (3, geoms, *lanes), of the frames of `PairTable.geoms`, m, world frame.
        rotations: (3, 3, geoms, *lanes), columns are their axes.
    """
    found = []
    for group in table.groups:
        sides = [
            _geoms(table, positions, rotations, geoms, hull)
            for geoms, hull in zip((group.hand, group.object), group.hulls, strict=True)
        ]
        found.append(touch(*group.kinds, *sides))

    def lay_out(*parts: jax.Array) -> jax.Array:
        """(k, [3,] pairs, *lanes) each -> (slots, [3,] *lanes)."""
        event = parts[0].ndim - len(positions.shape[2:]) - 2
        flat = [jnp.moveaxis(p, 1 + event, 1) for p in parts]
        return jnp.concatenate([p.reshape(-1, *p.shape[2:]) for p in flat])

    position, normal, distance = (lay_out(*parts) for parts in zip(*found, strict=True))
    # MuJoCo's normal, and that of the pairs, points from the hand to the object: ours is the object's outward normal.
    return Points(position, -normal, distance)


def _geoms(table: PairTable, positions: jax.Array, rotations: jax.Array, geoms: np.ndarray, hull: Hull | None) -> Geom:
    lanes = positions.shape[2:]
    size = jnp.asarray(table.sizes[geoms].T, positions.dtype).reshape(3, len(geoms), *[1] * len(lanes))
    return Geom(
        position=positions[:, geoms],
        rotation=rotations[:, :, geoms],
        size=jnp.broadcast_to(size, (3, len(geoms), *lanes)),
        hull=hull,
    )


def _kinds(model: mujoco.MjModel, hand: int, object: int) -> tuple[str, str]:
    # Of a kind that has no name here there is no pair.
    one, other = (KIND.get(mujoco.mjtGeom(model.geom_type[g]), "") for g in (hand, object))
    try:
        slots(one, other)
    except (ValueError, KeyError):
        names = [f"{_name(model, g)} ({mujoco.mjtGeom(model.geom_type[g]).name[7:].lower()})" for g in (hand, object)]
        raise ValueError(
            f"scene: geoms {names[0]} and {names[1]} can touch, but no distance is known between their kinds; "
            f"wanted {', '.join(KIND.values())}, contype and conaffinity that keep them apart, or engine 'mujoco'"
        ) from None
    return one, other


def _name(model: mujoco.MjModel, geom: int) -> str:
    return repr(model.geom(geom).name) if model.geom(geom).name else f"number {geom}"


def hull_of(model: mujoco.MjModel, mesh: int) -> Hull:
    """The convex hull that MuJoCo keeps of a mesh."""
    start = model.mesh_graphadr[mesh]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = np.asarray(model.mesh_vert[first : first + count], float)
    if start < 0:
        raise ValueError(f"scene: mesh {model.mesh(mesh).name!r} has no convex hull; wanted one that can collide")
    graph = model.mesh_graph[start:]
    num_vertices, num_faces = graph[:2]
    kept = graph[2 + num_vertices : 2 + 2 * num_vertices]
    edges = 2 + 3 * num_vertices + 3 * num_faces
    faces = graph[edges : edges + 3 * num_faces].reshape(-1, 3)
    number = {int(v): i for i, v in enumerate(kept)}
    return Hull.from_faces(vertices[kept], np.vectorize(number.__getitem__)(faces))
