"""A hand and an object from MJCF: from joint angles to contacts and to what the actuators can do."""

from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, safe_norm
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Actuation, Contacts, required_wrench
from jaxgrasp.hands.actuators import Actuators, read_actuators
from jaxgrasp.hands.bodies import bodies_below, body_named, read_model
from jaxgrasp.hands.couplings import Couplings, read_couplings
from jaxgrasp.hands.grasps import HandGrasps
from jaxgrasp.hands.kinematics import FREE, HINGE, SLIDE, Kinematics, Poses, matrices, place
from jaxgrasp.hands.tendons import spatial_transmission
from jaxgrasp.hands.touching import PairTable, Points, merged_point, pair_table, touching_points

# Quaternions are normalised; farther from 1 than this they are taken for a mistake.
_QUATERNION_TOLERANCE = 1e-3
# Configurations at a time on CPUs.
_TILE = 512


@dataclass(frozen=True, eq=False, kw_only=True)
class HandObject:
    """A scene with a hand and an object, made with `from_mjcf`. Its methods work under jit, vmap and grad."""

    model: mujoco.MjModel
    """The scene."""
    object_body: int
    """The object's body."""
    joints: np.ndarray
    """The hand's joints, hinges and slides; free joints count as held where they are."""
    dofs: np.ndarray
    """Their degrees of freedom."""
    contact_distance: float
    """m; see `from_mjcf`, as for what follows."""
    max_contacts: int
    max_force: float
    friction: float | None
    merge: float | None
    kinematics: Kinematics
    _table: PairTable
    _actuators: Actuators
    couplings: Couplings

    @classmethod
    def from_mjcf(
        cls,
        scene: str | PathLike | mujoco.MjSpec | mujoco.MjModel,
        object_body: str,
        *,
        hand_body: str | None = None,
        contact_distance: float = 1e-3,
        max_contacts: int = 8,
        max_force: float = 10.0,
        friction: float | None = None,
        merge: float | None = None,
    ) -> "HandObject":
        """A hand and an object from a scene.

        Args:
            scene: An MJCF file, a specification or a model.
            object_body: Name of the object's body, free or fixed; all geoms of it and of bodies fixed to it count.
            hand_body: Name of the hand's first body, with all bodies below it; None is every other body but the world.
            contact_distance: Geoms no farther apart than this touch, m.
            max_contacts: How many contacts a grasp keeps, the nearest ones.
            max_force: Largest normal force of every contact, N.
            friction: Coulomb's coefficient for all contacts; None is what MuJoCo makes of the geoms'.
            merge: Where several points on one link of the hand touch, the points no farther than this from the nearest
                one, m, become one contact at their mean, and the link's other points count no more; None keeps all.

        Raises:
            ValueError: The scene cannot be read, there is no such body, the object or a joint of the hand is of a kind
                that is not covered, or a pair of geoms can touch whose distance is not known.
        """
        if not (np.isfinite(max_force) and max_force > 0):
            raise ValueError(f"max_force: got {max_force}, wanted a finite positive number")
        for name, value in (("contact_distance", contact_distance), ("friction", friction), ("merge", merge)):
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: got {value}, wanted a finite number, at least 0")
        if max_contacts < 1:
            raise ValueError(f"max_contacts: got {max_contacts}, wanted at least 1")
        model = read_model(scene)
        body = body_named(model, "object_body", object_body)
        of_object = bodies_below(model, body)
        if np.any(model.body_jntnum[of_object[1:]]):
            raise ValueError(f"object_body: got {object_body!r}, with joints inside; wanted a rigid object")
        hand = (
            np.arange(1, model.nbody)
            if hand_body is None
            else bodies_below(model, body_named(model, "hand_body", hand_body))
        )
        hand = np.setdiff1d(hand, of_object)
        joints = np.flatnonzero(np.isin(model.jnt_bodyid, hand))
        joints = joints[np.isin(model.jnt_type[joints], (HINGE, SLIDE))]
        dofs = model.jnt_dofadr[joints]
        return cls(
            model=model,
            object_body=body,
            joints=joints,
            dofs=dofs,
            contact_distance=float(contact_distance),
            max_contacts=int(max_contacts),
            max_force=float(max_force),
            friction=friction,
            merge=merge,
            kinematics=Kinematics(model),
            _table=pair_table(model, hand, of_object),
            _actuators=read_actuators(model, dofs),
            couplings=read_couplings(model, dofs),
        )

    @property
    def nq(self) -> int:
        """Length of a configuration."""
        return self.model.nq

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints of `HandGrasps.actuation`, in order."""
        return tuple(self.model.joint(self.joints[i]).name for i in self.couplings.free)

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """The actuators of `HandGrasps.actuation`, in order."""
        return tuple(self.model.actuator(a).name for a in self.actuators)

    @property
    def actuators(self) -> np.ndarray:
        """The numbers of `actuator_names` in the model."""
        return self._actuators.numbers

    @property
    def object_mass(self) -> float:
        """Mass of the object, kg."""
        return float(self.model.body_mass[bodies_below(self.model, self.object_body)].sum())

    @property
    def constant_transmission(self) -> bool:
        """Whether actuators pull at the joints in the same way in every configuration."""
        return self._actuators.transmission is not None and self.couplings.linear

    def grasps(self, qpos: ArrayLike) -> HandGrasps:
        """What the hand does in a batch of configurations.

        Args:
            qpos: (*batch, nq), as MuJoCo lays configurations out: rad, m, and unit quaternions (w, x, y, z).

        Returns:
            The grasps. A configuration that is not finite, or has a quaternion whose norm is not 1 to 0.001, becomes a
            grasp that the programs answer with `Status.INVALID_INPUT`.

        Raises:
            ValueError: qpos has another length.

        Derivatives:
            Of everything but `links` and counts with respect to qpos; kinks where the nearest features of two geoms
            change.
        """
        qpos = as_float("qpos", qpos, (self.nq,))
        batch = qpos.shape[:-1]
        flat = self._compiled(qpos.reshape(-1, self.nq).astype(jnp.result_type(float)))
        return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), flat)

    def controls(self, grasps: HandGrasps, efforts: ArrayLike) -> Float[Array, "*batch actuators"]:
        """Commands with which the actuators exert the efforts while the hand rests in the grasps' configurations.

        A position servo is sent beyond where it is, to squeeze. The limits of commands are not applied here: they are
        part of the limits of `HandGrasps.actuation`. Nor is the hand's own weight, which J'f = B u leaves out: where it
        counts, give `gravcomp` to the hand's bodies, or add to the efforts what `qfrc_bias` needs of each actuator.

        Args:
            grasps: Of the configurations.
            efforts: (*batch, n_u), `Solution.actuator_efforts` for example, N or N m.

        Returns:
            The part of MuJoCo's `ctrl` that belongs to `actuator_names`; NaN for actuators without gain.
        """
        efforts = as_float("efforts", efforts, (len(self._actuators.numbers),))
        return self._actuators.command_for(efforts, grasps.actuator_lengths)

    def compliance(self, grasps: HandGrasps, tip_stiffness: ArrayLike) -> Float[Array, "*batch rows rows"]:
        """The compliance Q = J K^+ J' + K_tip^-1 of the contacts, for (14), from joint and fingertip stiffness.

        Directions that no stiffness reaches are left to N'J'f = 0, so this belongs with `grasps.actuation`.

        Args:
            grasps: Of the configurations.
            tip_stiffness: Of every fingertip, N/m: scalar, or (*batch, n_c).

        Returns:
            (*batch, 3 n_c, 3 n_c), m/N, contact frames.

        Raises:
            ValueError: An actuator without stiffness, a motor for example.
        """
        soft = self._actuators.slope >= 0
        if soft.any():
            names = ", ".join(repr(n) for n, s in zip(self.actuator_names, soft, strict=True) if s)
            raise ValueError(f"compliance: actuators {names} have no stiffness; wanted position servos")
        stiffness = as_float("tip_stiffness", tip_stiffness, ())
        jacobian = grasps.actuation.jacobian
        flexible = jnp.linalg.pinv(grasps.joint_stiffness, rtol=1e-9)
        tall = jacobian.reshape(*jacobian.shape[:-3], 3 * jacobian.shape[-3], jacobian.shape[-1])
        tips = jnp.broadcast_to(1 / stiffness, jacobian.shape[:-2]) if stiffness.ndim == 0 else 1 / stiffness
        tips = jnp.broadcast_to(jnp.repeat(tips, 3, -1), tall.shape[:-1])
        return tall @ flexible @ jnp.swapaxes(tall, -1, -2) + tips[..., None] * jnp.eye(
            tall.shape[-2], dtype=tall.dtype
        )

    @property
    def slot_links(self) -> np.ndarray:
        """(slots,), the body of the hand of every point that `points` looks at."""
        return self._table.link

    @property
    def slot_friction(self) -> np.ndarray:
        """(slots,), Coulomb's coefficient of every such point."""
        return self._table.friction if self.friction is None else np.full(len(self._table.link), self.friction)

    @property
    def touching_geoms(self) -> np.ndarray:
        """Numbers of the geoms of hand and object that can touch."""
        return self._table.geoms

    @cached_property
    def moved_bodies(self) -> np.ndarray:
        """(bodies, joints), bool: which of `joints` move a body."""
        moved = np.zeros((self.model.nbody, len(self.joints)), bool)
        for body in range(1, self.model.nbody):
            moved[body] = moved[self.model.body_parentid[body]] | (self.model.jnt_bodyid[self.joints] == body)
        return moved

    def approach(self, qpos: Float[Array, "n nq"]) -> tuple[Points, Float[Array, "n slots joints"]]:
        """All points where geoms touch or come near, and how fast each joint moves them apart.

        Returns:
            Points (n, slots, ...), world frame, and d distance / d joint position, m/rad or 1, while the object rests.
        """
        poses = self.kinematics.poses(qpos.T)
        points = self.points(poses)
        velocity = self.point_velocities(poses, points.position, self.moved_bodies[self.slot_links])
        return points, jnp.einsum("nsvi,nsi->nsv", velocity, points.normal)

    def frames(self, qpos: Float[Array, "n nq"]) -> tuple[Poses, Array, Array]:
        """Poses of all bodies, and the object's frame (n, 3, 3) and centre of mass (n, 3), m, world frame."""
        poses = self.kinematics.poses(qpos.T)
        return poses, jnp.moveaxis(poses.rotations[:, :, self.object_body], -1, 0), self._mass_centre(poses)

    def points(self, poses: Poses) -> Points:
        """All points where geoms touch or come near, (n, slots, ...)."""
        table, model = self._table, self.model
        bodies, offsets = model.geom_bodyid[table.geoms], model.geom_pos[table.geoms].T
        rotations, positions = place(
            poses.rotations[:, :, bodies], poses.positions[:, bodies], offsets, matrices(model.geom_quat[table.geoms])
        )
        return Points(*[jnp.moveaxis(x, -1, 0) for x in touching_points(table, positions, rotations)])

    @cached_property
    def _compiled(self):
        return compiled(self._in_tiles)

    def _in_tiles(self, qpos: jax.Array) -> HandGrasps:
        """On CPUs, tiles that stay in the cache; and searches among their lanes do not wait for the slowest of all."""
        count = len(qpos)
        if count <= _TILE or jax.default_backend() != "cpu":
            return self._grasps(qpos)
        tiles = -(-count // _TILE)
        padded = jnp.pad(qpos, [(0, tiles * _TILE - count), (0, 0)], mode="edge")
        found = lax.map(self._grasps, padded.reshape(tiles, _TILE, -1))
        return jax.tree.map(lambda x: x.reshape(tiles * _TILE, *x.shape[2:])[:count], found)

    def _grasps(self, qpos: jax.Array) -> HandGrasps:
        """For (n, nq)."""
        admissible = self._admissible(qpos)
        safe = jnp.where(admissible[:, None], qpos, jnp.asarray(self.model.qpos0, qpos.dtype))
        poses, rotation, centre = self.frames(safe)
        points, friction, links = self._points(poses)
        touching = points.distance <= self.contact_distance
        distances, chosen = lax.top_k(-points.distance, min(self.max_contacts, points.distance.shape[-1]))
        pick = lambda x: jnp.take_along_axis(x, chosen[..., None], 1)  # noqa: E731
        world, normal, distances = pick(points.position), pick(points.normal), -distances
        links = jnp.asarray(links)[chosen]
        position = jnp.einsum("nji,ncj->nci", rotation, world - centre[:, None])
        # A grasp that is not admissible has one contact that is not, either.
        position = jnp.where(admissible[:, None, None], position, jnp.nan)
        contacts = Contacts.from_normals(
            position,
            jnp.einsum("nji,ncj->nci", rotation, normal),
            friction=jnp.asarray(friction, qpos.dtype)[chosen] if self.friction is None else self.friction,
            max_force=self.max_force,
            active=(distances <= self.contact_distance) | ~admissible[:, None],
        )
        gravity = jnp.einsum("nji,j->ni", rotation, jnp.asarray(self.model.opt.gravity, qpos.dtype))
        weight = required_wrench(self.object_mass, gravity=gravity)
        lengths, actuation, stiffness = self.transmission(safe, poses, world, rotation, contacts.frames, links)
        return HandGrasps(
            contacts=contacts,
            distances=distances,
            links=links,
            touching=touching.sum(-1),
            penetration=jnp.maximum(0, -points.distance.min(-1)),
            required_wrench=jnp.where(admissible[:, None], weight, jnp.nan),
            actuation=actuation,
            actuator_lengths=lengths,
            joint_stiffness=stiffness,
            object_position=centre,
            object_rotation=rotation,
        )

    def _admissible(self, qpos: jax.Array) -> jax.Array:
        fine = jnp.isfinite(qpos).all(-1)
        for joint in np.flatnonzero(self.model.jnt_type == FREE):
            start = self.model.jnt_qposadr[joint] + 3
            fine &= jnp.abs(safe_norm(qpos[:, start : start + 4]) - 1) <= _QUATERNION_TOLERANCE
        return fine

    def _mass_centre(self, poses: Poses) -> jax.Array:
        """(n, 3)."""
        bodies = bodies_below(self.model, self.object_body)
        # An object that is fixed to the world may have no mass.
        masses = np.maximum(self.model.body_mass[bodies], 1e-12)
        offsets, turns = self.model.body_ipos[bodies].T, np.repeat(np.eye(3)[..., None], len(bodies), -1)
        centres = place(poses.rotations[:, :, bodies], poses.positions[:, bodies], offsets, turns)[1]
        return jnp.einsum("b,ibn->ni", jnp.asarray(masses / masses.sum(), centres.dtype), centres)

    def _points(self, poses: Poses) -> tuple[Points, np.ndarray, np.ndarray]:
        """Points (n, slots, ...), and friction and link of every slot."""
        table, points = self._table, self.points(poses)
        if self.merge is None:
            return points, table.friction, table.link
        merged, friction, links = [], [], np.unique(table.link)
        for link in links:
            rows = np.flatnonzero(table.link == link)
            merged.append(merged_point(Points(*[x[:, rows] for x in points]), self.merge, self.contact_distance))
            friction.append(table.friction[rows].min())
        stacked = [jnp.stack(parts, 1) for parts in zip(*merged, strict=True)]
        return Points(*stacked), np.array(friction), links

    def transmission(
        self,
        qpos: jax.Array,
        poses: Poses,
        world: jax.Array,
        rotation: jax.Array,
        frames: jax.Array,
        links: jax.Array,
    ) -> tuple[jax.Array, Actuation, jax.Array]:
        """Actuator lengths, actuation and joint stiffness; `world` (n, n_c, 3) are the contacts."""
        model, dtype = self.model, qpos.dtype
        velocity = self.point_velocities(poses, world, jnp.asarray(self.moved_bodies)[links])
        turned = jnp.einsum("nji,ncvj->ncvi", rotation, velocity)
        # Contacts that are not admissible have no frames.
        jacobian = jnp.einsum("ncia,ncvi->ncav", jnp.where(jnp.isnan(frames), 0, frames), turned)
        joints = qpos[:, model.jnt_qposadr[self.joints]]
        lengths, transmission = self._lengths(qpos, joints)
        springs = jnp.diag(jnp.asarray(model.jnt_stiffness[self.joints], dtype))
        if len(self.couplings.follower):
            free = self.couplings.velocities(joints)
            jacobian = jacobian @ free[:, None]
            transmission = jnp.swapaxes(free, -1, -2) @ transmission
            springs = jnp.swapaxes(free, -1, -2) @ springs @ free
            if self.constant_transmission:
                transmission = np.asarray(
                    self.couplings.velocities(jnp.zeros(len(self.dofs))).T @ self._actuators.transmission
                )
        least, most = self._actuators.limits(lengths)
        actuation = Actuation.from_jacobian(jacobian, transmission, least, most)
        servo = jnp.asarray(np.maximum(-self._actuators.slope, 0), dtype)
        through = jnp.asarray(transmission, dtype)
        stiffness = (through * servo) @ jnp.swapaxes(through, -1, -2) + springs
        spread = lambda x, event: jnp.broadcast_to(x, (len(qpos), *x.shape[x.ndim - event :]))  # noqa: E731
        whole = {name: spread(getattr(actuation, name), 2) for name in ("transmission", "inverse")}
        if actuation.unreached is not None:
            whole["unreached"] = spread(actuation.unreached, 2)
        return lengths, replace(actuation, **whole), spread(stiffness, 2)

    def point_velocities(self, poses: Poses, points: jax.Array, moved: jax.Array | np.ndarray) -> jax.Array:
        """Velocities (n, k, joints, 3) of points (n, k, 3) on the hand, by the joints that move them."""
        axes, anchors = (x[:, self.joints].T[:, None] for x in (poses.axes, poses.anchors))
        hinge = jnp.asarray(self.model.jnt_type[self.joints] == HINGE)[:, None]
        turning = jnp.cross(axes, points[:, :, None] - anchors)
        return jnp.where(jnp.asarray(moved)[..., None], jnp.where(hinge, turning, axes), 0)

    def _lengths(self, qpos: jax.Array, joints: jax.Array) -> tuple[jax.Array, jax.Array | np.ndarray]:
        """Lengths (n, actuators) and B, (joints, actuators) where it is the same everywhere."""
        numbers, constant = self._actuators.numbers, self._actuators.transmission
        if constant is not None:
            data = mujoco.MjData(self.model)
            mujoco.mj_forward(self.model, data)
            start = jnp.asarray(data.actuator_length[numbers], qpos.dtype)
            rest = jnp.asarray(self.model.qpos0[self.model.jnt_qposadr[self.joints]], qpos.dtype)
            return start + (joints - rest) @ jnp.asarray(constant, qpos.dtype), constant

        lengths, moments = jax.vmap(spatial_transmission(self.model))(qpos)
        return lengths[:, numbers], jnp.swapaxes(moments[:, numbers][:, :, self.dofs], -1, -2)
