"""What is near a hand: its links and the object, its own other links; and where a hand could begin to grasp."""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from jaxgrasp.contact import Actuation, Contacts
from jaxgrasp.geometry.pairs import Geom, touch
from jaxgrasp.hands.bodies import bodies_below, body_named
from jaxgrasp.hands.hand_object import HandObject
from jaxgrasp.hands.kinematics import FREE, Poses
from jaxgrasp.hands.self_collision import SelfPairs, self_pairs
from jaxgrasp.hands.touching import KIND, hull_of


class Near(NamedTuple):
    """What is near in a batch of configurations; world frame."""

    position: Float[Array, "n links 3"]
    """The point of the object's surface that is nearest to each of the links that shall touch, m."""
    normal: Float[Array, "n links 3"]
    """The object's outward normal there."""
    distance: Float[Array, "n links"]
    """Of link and object, m, negative where they penetrate."""
    friction: Float[Array, "n links"]
    """Coulomb's coefficient there."""
    depths: Float[Array, "n slots"]
    """How deep geoms of the hand are in the object, m, at least 0."""
    self_distances: Float[Array, "n pairs"]
    """Of parts of the hand, m, negative where they are inside each other."""
    object_position: Float[Array, "n 3"]
    """The object's centre of mass, m."""
    object_rotation: Float[Array, "n 3 3"]
    """The object's frame: columns are its axes."""
    poses: Poses
    """Of all bodies."""


class Surroundings:
    """A hand, an object, and the links of the hand that shall touch it."""

    @classmethod
    def of(cls, hand: HandObject, links: Sequence[str] | None = None) -> "Surroundings":
        """The same one each time for the same hand and links, since programs are compiled for it; see `__init__`."""
        known = hand.__dict__.setdefault("_surroundings", {})
        key = None if links is None else tuple(links)
        if key not in known:
            known[key] = cls(hand, links)
        return known[key]

    def __init__(self, hand: HandObject, links: Sequence[str] | None = None):
        """Finds the links, and which parts of the hand can run into each other.

        Args:
            hand: The hand and the object.
            links: Names of the bodies that shall touch the object; None is the outermost one of every finger.

        Raises:
            ValueError: There is no such body, it has no geom that can touch, neither the hand nor the object is free to
                be moved, or a joint of the hand follows another by an equality constraint.
        """
        model = hand.model
        self.hand = hand
        for follower in hand.couplings.follower:
            name = model.joint(hand.joints[follower]).name
            raise ValueError(f"hand: joint {name!r} follows another one; wanted joints that all move on their own")
        self.links = _outermost(hand) if links is None else np.array([body_named(model, "links", n) for n in links])
        for link in self.links:
            if link not in hand.slot_links:
                raise ValueError(f"links: got {model.body(link).name!r}, which has no geom that can touch the object")
        if not len(self.links):
            raise ValueError("links: got none, wanted at least one body of the hand")
        self.free_joint, self.moves_object = _free_joint(hand)
        geoms = np.setdiff1d(hand.touching_geoms, self._object_geoms)
        joints = self.joints
        self.self_pairs: SelfPairs = self_pairs(model, hand.joints[joints], hand.moved_bodies[:, joints], geoms)

    @property
    def pose(self) -> int:
        """Where in qpos the seven numbers begin that place hand and object to each other."""
        return int(self.hand.model.jnt_qposadr[self.free_joint])

    @cached_property
    def palm(self) -> int:
        """The last body that all links that shall touch hang on."""
        above = [_ancestors(self.hand.model, int(link))[1:] for link in self.links]
        return next(body for body in above[0] if all(body in others for others in above))

    @cached_property
    def joints(self) -> np.ndarray:
        """Those of the hand's joints (places in `HandObject.joints`) that move fingers against the palm."""
        moved = self.hand.moved_bodies
        return np.flatnonzero(~moved[self.palm])

    @cached_property
    def approach(self) -> tuple[np.ndarray, np.ndarray, float]:
        """How the scene has palm and object: a point, a direction and a distance, world frame, m.

        The palm's point nearest to the object's mass centre, the direction from there to the object's nearest point,
        and how far away that is.
        """
        model = self.hand.model
        centre = self._reference.subtree_com[self.hand.object_body]
        geoms = [g for g in self.hand.touching_geoms if model.geom_bodyid[g] == self.palm]
        start = self._nearest(geoms, centre[None])[0][0] if geoms else self._reference.xpos[self.palm]
        way = self._nearest(self._object_geoms, start[None])[0][0] - start
        gap = float(np.linalg.norm(way))
        return start, way / gap if gap > 0 else np.array([0.0, 0.0, 1.0]), gap

    @cached_property
    def reach(self) -> float:
        """Radius of a ball about the object's mass centre with the whole object inside, m."""
        model, data = self.hand.model, self._reference
        centre = data.subtree_com[self.hand.object_body]
        return max(float(np.linalg.norm(data.geom_xpos[g] - centre) + model.geom_rbound[g]) for g in self._object_geoms)

    def put_object(self, qpos: np.ndarray, centre: np.ndarray, rotation: np.ndarray) -> None:
        """Writes into configurations where the object's mass centre and frame shall be.

        Where the object is fixed, the hand is moved instead: what it is to the object is the same.

        Args:
            qpos: (n, nq), written.
            centre: (n, 3), m, while the hand's base is where the scene has it; world frame.
            rotation: (n, 3, 3).
        """
        data, body, at = self._reference, self.hand.object_body, self.pose
        turned = rotation @ data.xmat[body].reshape(3, 3).T
        moved = centre - np.einsum("nij,j->ni", turned, data.subtree_com[body])
        if not self.moves_object:
            turned = np.swapaxes(turned, 1, 2)
            moved = -np.einsum("nij,nj->ni", turned, moved)
        first = self.hand.model.qpos0[at : at + 7]
        base, change = np.zeros(9), np.zeros(4)
        mujoco.mju_quat2Mat(base, first[3:])
        for row, turn, shift in zip(qpos, turned, moved, strict=True):
            mujoco.mju_mat2Quat(change, np.ravel(turn @ base.reshape(3, 3)))
            row[at : at + 3], row[at + 3 : at + 7] = turn @ first[:3] + shift, change

    def near(self, qpos: Float[Array, "n nq"]) -> Near:
        """What is near in configurations; differentiable with respect to them."""
        hand = self.hand
        poses, rotation, centre = hand.frames(qpos)
        points = hand.points(poses)
        friction = jnp.broadcast_to(jnp.asarray(hand.slot_friction, qpos.dtype), points.distance.shape)
        chosen = []
        for link in self.links:
            slots = np.flatnonzero(hand.slot_links == link)
            nearest = jnp.asarray(slots)[points.distance[:, slots].argmin(-1)]
            lane = jnp.arange(len(qpos))
            chosen.append([x[lane, nearest] for x in (points.position, points.normal, points.distance, friction)])
        position, normal, distance, friction = (jnp.stack(parts, 1) for parts in zip(*chosen, strict=True))
        return Near(
            position=position - 0.5 * distance[..., None] * normal,
            normal=normal,
            distance=distance,
            friction=friction,
            depths=jnp.maximum(-points.distance, 0),
            self_distances=jnp.moveaxis(self.self_pairs.distances(poses), 0, -1),
            object_position=centre,
            object_rotation=rotation,
            poses=poses,
        )

    def actuation(self, qpos: Float[Array, "n nq"], near: Near, contacts: Contacts) -> Actuation | None:
        """What the actuators can do at the points of `near`, whose contacts these are."""
        links = jnp.broadcast_to(jnp.asarray(self.links), near.distance.shape)
        frames, rotation = contacts.frames, near.object_rotation
        return self.hand.actuation_at(qpos, near.poses, near.position, rotation, frames, links)

    def surface_points(self, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
        """The points of the object's surface nearest to given ones, m, and its outward normals there.

        Args:
            points: m, object frame about the centre of mass.
        """
        turn = self._reference.xmat[self.hand.object_body].reshape(3, 3)
        centre = self._reference.subtree_com[self.hand.object_body]
        found, normal = self._nearest(self._object_geoms, centre + points @ turn.T)
        return (found - centre) @ turn, normal @ turn

    def _nearest(self, geoms: Sequence[int] | np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the surfaces of geoms in the reference configuration; points and normals (n, 3), world frame."""
        model, data = self.hand.model, self._reference
        lanes = jnp.asarray(points, float).T
        spread = lambda x: jnp.broadcast_to(jnp.asarray(x)[..., None], (*x.shape, lanes.shape[1]))
        own = Geom(lanes, spread(np.eye(3)), jnp.zeros_like(lanes))
        found = []
        for geom in geoms:
            kind = KIND[mujoco.mjtGeom(model.geom_type[geom])]
            hull = hull_of(model, int(model.geom_dataid[geom])) if kind == "mesh" else None
            rotation = data.geom_xmat[geom].reshape(3, 3)
            other = Geom(spread(data.geom_xpos[geom]), spread(rotation), spread(model.geom_size[geom]), hull)
            found.append(jax.tree.map(lambda x: np.asarray(x[0]), touch("sphere", kind, own, other)))
        distance = np.stack([touch.distance for touch in found])
        first, lane = distance.argmin(0), np.arange(len(points))
        # The normal of a touch points from the sphere to the geom, and its point is midway.
        normal = -np.stack([touch.normal for touch in found])[first, :, lane]
        middle = np.stack([touch.position for touch in found])[first, :, lane]
        return middle - 0.5 * distance.min(0)[:, None] * normal, normal

    @cached_property
    def _reference(self) -> mujoco.MjData:
        data = mujoco.MjData(self.hand.model)
        mujoco.mj_forward(self.hand.model, data)
        return data

    @cached_property
    def _object_geoms(self) -> np.ndarray:
        model = self.hand.model
        inside = np.isin(model.geom_bodyid, bodies_below(model, self.hand.object_body))
        return np.intersect1d(self.hand.touching_geoms, np.flatnonzero(inside))


def _outermost(hand: HandObject) -> np.ndarray:
    """The outermost body of every finger that can touch."""
    model, moved = hand.model, hand.moved_bodies
    can = np.unique(hand.slot_links[moved[hand.slot_links].any(-1)])
    below = lambda body: np.intersect1d(bodies_below(model, body), can)
    return np.array([body for body in can if len(below(int(body))) == 1], int)


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """The body itself first, the world last."""
    chain = [body]
    while chain[-1]:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def _free_joint(hand: HandObject) -> tuple[int, bool]:
    model = hand.model
    of_object = np.isin(model.jnt_bodyid, bodies_below(model, hand.object_body))
    for own in (True, False):
        found = np.flatnonzero((model.jnt_type == FREE) & (of_object == own))
        if len(found):
            return int(found[0]), own
    raise ValueError(
        "hand: neither the object nor the hand has a free joint; wanted one that places them to each other"
    )
