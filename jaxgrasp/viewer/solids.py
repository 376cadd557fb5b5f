"""The surfaces of a hand and an object in MuJoCo, as triangles."""

import mujoco
import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.hands import HandObject
from jaxgrasp.hands.bodies import bodies_below
from jaxgrasp.viewer.held import Held

_AROUND, _ALONG = 24, 12
# Radius and height of a cylinder's outline, and, with four sides, of a box's.
_DRUM = np.array([[0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0]])


def held_by(hand: HandObject, qpos: Float[np.ndarray, " nq"], engine: str | None = None) -> Held:
    """The hand and the object in one configuration, by the geoms that can touch, and the links of the contacts.

    Args:
        hand: The hand and the object.
        qpos: The configuration.
        engine: What finds the contacts, see `HandObject.grasps`.
    """
    model = hand.model
    grasps = hand.grasps(qpos, engine)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    turn, middle = np.asarray(grasps.object_rotation), np.asarray(grasps.object_position)

    def surfaces(bodies: np.ndarray) -> list[np.ndarray]:
        parts = []
        for geom in touching_geoms(model, bodies):
            world = triangles_of(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            parts.append((world - middle) @ turn)
        return parts

    return Held(
        hand=surfaces(hand.bodies),
        object=surfaces(bodies_below(model, hand.object_body)),
        links=[model.body(body).name or f"body {body}" for body in np.asarray(grasps.links).tolist()],
    )


def touching_geoms(model: mujoco.MjModel, bodies: Int[np.ndarray, " bodies"]) -> list[int]:
    """The geoms of some bodies that can touch, by their numbers."""
    collide = (model.geom_contype | model.geom_conaffinity) != 0
    collide[np.concatenate([model.pair_geom1, model.pair_geom2])] = True
    return np.flatnonzero(collide & np.isin(model.geom_bodyid, bodies)).tolist()


def triangles_of(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "triangles 3 3"]:
    """The surface of one geom in its own frame, m, counterclockwise from outside; none of planes and height fields."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _hull(model, int(model.geom_dataid[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return surface_of_revolution(_DRUM, 4, np.pi / 4) * size * [np.sqrt(2), np.sqrt(2), 1]
    angles = np.linspace(-np.pi / 2, np.pi / 2, _ALONG + 1)
    round_ends = np.stack([np.cos(angles), np.sin(angles)], -1)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return size[0] * surface_of_revolution(round_ends, _AROUND)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return size * surface_of_revolution(round_ends, _AROUND)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        halves = np.repeat(round_ends, [1] * (_ALONG // 2) + [2] + [1] * (_ALONG // 2), 0) * size[0]
        halves[:, 1] += np.repeat([-size[1], size[1]], len(halves) // 2)
        return surface_of_revolution(halves, _AROUND)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return surface_of_revolution(_DRUM, _AROUND) * [size[0], size[0], size[1]]
    return np.zeros((0, 3, 3))


def surface_of_revolution(
    profile: Float[np.ndarray, "points 2"], around: int, start: float = 0.0
) -> Float[np.ndarray, "triangles 3 3"]:
    """The surface that a profile makes by turning about z, corners counterclockwise from outside.

    Args:
        profile: Radius and height of points, from below upwards.
        around: The number of corners of each ring.
        start: The angle of the first corner, rad.
    """
    angles = start + 2 * np.pi * np.arange(around + 1) / around
    circle = np.stack([np.cos(angles), np.sin(angles)], -1)
    rings = np.concatenate([profile[:, None, :1] * circle, np.repeat(profile[:, None, 1:], around + 1, 1)], -1)
    a, b, c, d = rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]
    return np.concatenate([np.stack([a, b, c], -2), np.stack([a, c, d], -2)]).reshape(-1, 3, 3)


def _hull(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """The convex hull of a mesh, which is what touches, or the mesh itself where MuJoCo keeps none."""
    first = model.mesh_vertadr[mesh]
    vertices = np.asarray(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], float)
    start = model.mesh_graphadr[mesh]
    if start < 0:
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    else:
        graph = model.mesh_graph[start:]
        corners, count = graph[:2]
        faces = graph[2 + 3 * corners + 3 * count :][: 3 * count].reshape(-1, 3)
    return vertices[faces]
