"""A hand and an object from MJCF: from joint angles to contacts and to what the actuators can do."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from os import PathLike
from types import ModuleType

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp.arrays import as_float, frames_from_normals
from jaxgrasp.compiling import compiled
from jaxgrasp.contact import Actuation, Contacts
from jaxgrasp.hands.actuators import Actuators, read_actuators
from jaxgrasp.hands.bodies import (
    admissible_configurations,
    bodies_below,
    body_named,
    check_length,
    hand_bodies,
    moved_by_joints,
    read_model,
    wrench_against_weight,
)
from jaxgrasp.hands.contact_parameters import hand_object_pairs, warn_of_simplifications
from jaxgrasp.hands.couplings import Couplings, held_by_welds, read_couplings
from jaxgrasp.hands.distance_engine import DistanceEngine
from jaxgrasp.hands.engines import Engine, engine_for
from jaxgrasp.hands.grasps import HandGrasps, contact_compliance
from jaxgrasp.hands.kinematics import BALL, HINGE, SLIDE, Kinematics, Poses
from jaxgrasp.hands.link_contacts import ContactRule, RawPoints
from jaxgrasp.hands.mechanics import Mechanics, point_velocities
from jaxgrasp.hands.mjx_engine import MjxEngine
from jaxgrasp.hands.mujoco_engine import MujocoEngine
from jaxgrasp.hands.passive import read_passive
from jaxgrasp.hands.touching import Points

_ENGINES = {"mujoco": MujocoEngine, "distance": DistanceEngine, "mjx": MjxEngine}


@dataclass(frozen=True, eq=False, kw_only=True)
class HandObject:
    """A scene with a hand and an object, made with `from_mjcf` or `Scene.hand_object`."""

    model: mujoco.MjModel
    """The scene."""
    object_body: int
    """The object's body."""
    bodies: np.ndarray
    """The hand's bodies."""
    joints: np.ndarray
    """The hand's joints, hinges and slides; free and welded ones count as held where they are."""
    dofs: np.ndarray
    """Their degrees of freedom."""
    contact_distance: float
    """m; see `from_mjcf`, as for what follows."""
    rule: ContactRule
    max_force: float
    friction: float | None
    couplings: Couplings
    soft: bool
    """Whether some contacts have torsional friction (condim 4 or 6)."""
    touching_links: np.ndarray
    """The bodies of the hand that can touch the object."""
    _actuators: Actuators
    _mechanics: Mechanics
    _engines: dict[str, Engine] = field(default_factory=dict, init=False)
    _programs: dict[tuple[str, bool], Callable[[jax.Array], HandGrasps]] = field(default_factory=dict, init=False)

    @classmethod
    def from_mjcf(
        cls,
        scene: str | PathLike | mujoco.MjSpec | mujoco.MjModel,
        object_body: str,
        *,
        hand_body: str | None = None,
        environment: Sequence[str] = (),
        contact_distance: float = 5e-3,
        points_per_link: int | None = 1,
        max_contacts: int | None = None,
        max_force: float = 10.0,
        friction: float | None = None,
        unreached: str = "held",
    ) -> "HandObject":
        """A hand and an object from a scene.

        Args:
            scene: An MJCF file, a specification or a model.
            object_body: Name of the object's body, free or fixed; all geoms of it and of bodies fixed to it count.
            hand_body: Name of the hand's first body, with all bodies below it; None is what the joints that are not the
                object's move, and what that hangs on: see `hand_bodies`.
            environment: Names of bodies that are not the hand's, with all below them.
            contact_distance: Geoms no farther apart than this touch, m; where MuJoCo's margins are larger, these count.
                Grasps in files stand some millimetres off the surface.
            points_per_link: 1 makes one contact of each link, at the mean of its points that touch; more are as many
                points of each link, spread apart; None makes every point a contact.
            max_contacts: Of how many links a grasp keeps the contacts, the nearest ones; where every point is a
                contact, how many points, of all links in turn. None is all.
            max_force: Largest normal force of every contact, N.
            friction: Coulomb's coefficient for all contacts; None is what MuJoCo makes of the geoms'. Torsional
                coefficients are always the geoms', where condim asks for them.
            unreached: What joint directions do that neither an actuator nor a friction, a stop or a spring of a joint
                reaches: "held" bear any torque, "free" none.

        Raises:
            ValueError: The scene cannot be read, there is no such body, or the object, a joint or an actuator of the
                hand is of a kind that is not covered.
        """
        if not (np.isfinite(max_force) and max_force > 0):
            raise ValueError(f"max_force: got {max_force}, wanted a finite positive number")
        for name, value in (("contact_distance", contact_distance), ("friction", friction)):
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: got {value}, wanted a finite number, at least 0")
        for name, value in (("max_contacts", max_contacts), ("points_per_link", points_per_link)):
            if value is not None and value < 1:
                raise ValueError(f"{name}: got {value}, wanted at least 1")
        model = read_model(scene)
        body = body_named(model, "object_body", object_body)
        of_object = bodies_below(model, body)
        if np.any(model.body_jntnum[of_object[1:]]):
            raise ValueError(f"object_body: got {object_body!r}, with joints inside; wanted a rigid object")
        first = None if hand_body is None else body_named(model, "hand_body", hand_body)
        hand = hand_bodies(model, of_object) if first is None else bodies_below(model, first)
        for name in environment:
            hand = np.setdiff1d(hand, bodies_below(model, body_named(model, "environment", name)))
        hand = np.setdiff1d(hand, of_object)
        joints = np.flatnonzero(np.isin(model.jnt_bodyid, hand))
        for joint in joints[model.jnt_type[joints] == BALL]:
            raise ValueError(f"scene: joint {model.joint(joint).name!r} is a ball; wanted hinges and slides")
        joints = joints[np.isin(model.jnt_type[joints], (HINGE, SLIDE)) & ~np.isin(joints, held_by_welds(model))]
        dofs = model.jnt_dofadr[joints]
        warn_of_simplifications(model, pairs := hand_object_pairs(model, hand, of_object))
        couplings, actuators = read_couplings(model, dofs), read_actuators(model, dofs)
        return cls(
            model=model,
            object_body=body,
            bodies=hand,
            joints=joints,
            dofs=dofs,
            contact_distance=float(contact_distance),
            rule=ContactRule(points_per_link, max_contacts),
            max_force=float(max_force),
            friction=friction,
            couplings=couplings,
            soft=any(parameters.condim > 3 for parameters in pairs.values()),
            touching_links=np.unique(model.geom_bodyid[[geom for geom, _ in pairs]]),
            _actuators=actuators,
            _mechanics=Mechanics(model, joints, couplings, actuators, read_passive(model, joints), unreached),
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
        """Whether efforts act on the joints in the same way in every configuration."""
        return self._mechanics.constant

    def grasps(self, qpos: ArrayLike, engine: str | None = None, *, actuation: bool = True) -> HandGrasps:
        """What the hand does in a batch of configurations.

        Args:
            qpos: (*batch, nq), as MuJoCo lays configurations out: rad, m, and unit quaternions (w, x, y, z).
            engine: What finds the contacts: "mujoco", "distance", which is differentiable and compiled by JAX, or
                "mjx", compiled, too, for pairs that touch or penetrate. None chooses, see `engine_for`.
            actuation: Whether to find what the joints can do; False is faster and leaves out what `HandGrasps` says.

        Returns:
            The grasps. A configuration that is not finite, or has a quaternion whose norm is not 1 to 0.001, becomes a
            grasp that the programs answer with `Status.INVALID_INPUT`.

        Raises:
            ValueError: qpos has another length, or the engine cannot do it.

        Derivatives:
            With engine "distance", of everything but `links` and counts with respect to qpos; kinks where the nearest
            features of two geoms change. Stops of joints do not count there: what they bear jumps.
        """
        name = engine_for(engine, qpos)
        finder = self.engine(name)
        if name == "mujoco":
            qpos = np.asarray(qpos, float)
            check_length(self.model, qpos.shape)
            flat = self._found(finder, actuation, qpos.reshape(-1, self.nq), np)
        else:
            qpos = as_float("qpos", qpos, ())
            check_length(self.model, qpos.shape)
            flat = self._program(name, actuation)(qpos.reshape(-1, self.nq).astype(jnp.result_type(float)))
        return jax.tree.map(lambda x: x.reshape(*qpos.shape[:-1], *x.shape[1:]), flat)

    def stops(self, joints: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Which of `joints` lean on their lower stop, and on their upper one, at positions (*batch, joints)."""
        return self._mechanics.passive.stops(np.asarray(joints, float))

    def actuator_efforts(self, grasps: HandGrasps, efforts: ArrayLike) -> Float[Array, "*batch actuators"]:
        """What the actuators themselves exert: without what joints bear by themselves, and without springs.

        Args:
            grasps: Of the configurations.
            efforts: (*batch, n_u), of `grasps.actuation`, N or N m.
        """
        if grasps.spring_efforts is None:
            raise ValueError("grasps: got some without their actuation; wanted actuation=True")
        efforts = as_float("efforts", efforts, (grasps.spring_efforts.shape[-1],))
        return (efforts - grasps.spring_efforts)[..., : len(self._actuators.numbers)]

    def controls(self, grasps: HandGrasps, efforts: ArrayLike) -> Float[Array, "*batch actuators"]:
        """Commands with which the actuators exert the efforts while the hand rests in the grasps' configurations.

        A position servo is sent beyond where it is, to squeeze. The limits of commands are not applied here: they are
        part of the limits of `HandGrasps.actuation`. Nor is the hand's own weight, which J'f = B u + tau leaves out as
        if all of it were compensated: where it counts, add to the efforts what `qfrc_bias` needs of each actuator.

        Args:
            grasps: Of the configurations.
            efforts: (*batch, n_u), `Solution.actuator_efforts` for example, N or N m.

        Returns:
            The part of MuJoCo's `ctrl` that belongs to `actuator_names`; NaN for actuators without gain.
        """
        return self._actuators.command_for(self.actuator_efforts(grasps, efforts), grasps.actuator_lengths)

    def compliance(self, grasps: HandGrasps, tip_stiffness: ArrayLike) -> Float[Array, "*batch rows rows"]:
        """The compliance Q = J K^+ J' + K_tip^-1 of the contacts, for (14), from joint and fingertip stiffness.

        Directions that no stiffness reaches are left to N'J'f = 0, so this belongs with `grasps.actuation`.

        Args:
            grasps: Of the configurations.
            tip_stiffness: Of every fingertip, N/m: scalar, or (*batch, n_c).

        Returns:
            (*batch, 3 n_c, 3 n_c), m/N, contact frames. Of soft contacts (*batch, 4 n_c, 4 n_c), with moments about the
            normals; a fingertip then is k (gamma / mu)^2 N m/rad stiff against turning, as in MuJoCo.

        Raises:
            ValueError: An actuator without stiffness, a motor for example.
        """
        if grasps.actuation is None or grasps.joint_stiffness is None:
            raise ValueError("compliance: nothing acts on the hand; wanted actuators")
        soft = [repr(n) for n, s in zip(self.actuator_names, self._actuators.slope, strict=True) if s >= 0]
        if soft:
            raise ValueError(f"compliance: actuators {', '.join(soft)} have no stiffness; wanted position servos")
        stiffness = as_float("tip_stiffness", tip_stiffness, ())
        return contact_compliance(grasps.contacts, grasps.actuation.jacobian, grasps.joint_stiffness, stiffness)

    @property
    def slot_links(self) -> np.ndarray:
        """(slots,), the body of the hand of every point that `points` looks at."""
        return self._distances.table.link

    @property
    def slot_friction(self) -> np.ndarray:
        """(slots,), Coulomb's coefficient of every such point."""
        return self._distances.table.friction if self.friction is None else np.full(len(self.slot_links), self.friction)

    @property
    def touching_geoms(self) -> np.ndarray:
        """Numbers of the geoms of hand and object that can touch."""
        return self._distances.table.geoms

    @cached_property
    def moved_bodies(self) -> np.ndarray:
        """(bodies, joints), bool: which of `joints` move a body."""
        return moved_by_joints(self.model, self.joints)

    def approach(self, qpos: Float[Array, "n nq"]) -> tuple[Points, Float[Array, "n slots joints"]]:
        """All points where geoms touch or come near, and how fast each joint moves them apart.

        Returns:
            Points (n, slots, ...), world frame, and d distance / d joint position, m/rad or 1, while the object rests.
        """
        poses = self.kinematics.poses(qpos.T)
        points = self.points(poses)
        axes, anchors = self._distances.of_joints(poses)
        hinge, moved = self.model.jnt_type[self.joints] == HINGE, self.moved_bodies[self.slot_links]
        velocity = point_velocities(axes, anchors, hinge, points.position, moved, jnp)
        return points, jnp.einsum("nsvi,nsi->nsv", velocity, points.normal)

    def frames(self, qpos: Float[Array, "n nq"]) -> tuple[Poses, Array, Array]:
        """Poses of all bodies, and the object's frame (n, 3, 3) and centre of mass (n, 3), m, world frame."""
        return self._distances.frames(qpos)

    def points(self, poses: Poses) -> Points:
        """All points where geoms touch or come near, (n, slots, ...)."""
        return self._distances.points(poses)

    def _program(self, name: str, actuation: bool) -> Callable[[jax.Array], HandGrasps]:
        if (key := (name, actuation)) not in self._programs:
            self._programs[key] = compiled(partial(self._in_tiles, self.engine(name), actuation))
        return self._programs[key]

    def _in_tiles(self, engine: Engine, actuation: bool, qpos: jax.Array) -> HandGrasps:
        """On CPUs, tiles that stay in the cache; and searches among their lanes do not wait for the slowest of all."""
        assert isinstance(engine, DistanceEngine | MjxEngine)
        count, size = len(qpos), engine.tile
        if count <= size or jax.default_backend() != "cpu":
            return self._found(engine, actuation, qpos, jnp)
        tiles = -(-count // size)
        padded = jnp.pad(qpos, [(0, tiles * size - count), (0, 0)], mode="edge")
        found = lax.map(lambda tile: self._found(engine, actuation, tile, jnp), padded.reshape(tiles, size, -1))
        return jax.tree.map(lambda x: x.reshape(tiles * size, *x.shape[2:])[:count], found)

    def _found(self, engine: Engine, actuation: bool, qpos: Array | np.ndarray, xp: ModuleType) -> HandGrasps:
        """For (n, nq), by engine `mujoco` in NumPy, by others in JAX's arrays."""
        admissible = admissible_configurations(self.model, qpos, xp)
        safe = xp.where(admissible[:, None], qpos, self.model.qpos0.astype(qpos.dtype))
        geometry = engine.find(safe)
        found = self.rule.contacts(geometry.points, self.touching_links, xp)
        rotation, centre = geometry.object_rotation, geometry.object_position
        in_object = lambda x: xp.einsum("nji,ncj->nci", rotation, x)
        # A grasp that is not admissible has one contact that is not, either.
        position = xp.where(admissible[:, None, None], in_object(found.position - centre[:, None]), np.nan)
        contacts = Contacts.from_frames(
            position,
            frames_from_normals(in_object(found.normal)),
            friction=found.friction if self.friction is None else self.friction,
            max_force=self.max_force,
            active=found.active | ~admissible[:, None],
            torsional_friction=found.torsional if self.soft else None,
        )
        mechanics = dict.fromkeys(("actuation", "spring_torques", "spring_efforts", "joint_stiffness"))
        if actuation:
            moved, frames = xp.asarray(self.moved_bodies)[found.link], xp.asarray(contacts.frames)
            jacobian = self._mechanics.jacobians(geometry, found.position, moved, frames, rotation, self.soft, xp)
            joints = safe[:, self.model.jnt_qposadr[self.joints]]
            mechanics = self._mechanics.actuation(geometry, joints, jacobian, not engine.differentiable, xp)
        weight = wrench_against_weight(self.model, bodies_below(self.model, self.object_body), rotation, xp)
        as_float_array = lambda x: jnp.asarray(x, jnp.result_type(float) if xp is np else qpos.dtype)
        return HandGrasps(
            contacts=contacts,
            distances=as_float_array(found.distance),
            links=jnp.asarray(found.link),
            touching=jnp.asarray(found.touching),
            left_out=jnp.asarray(found.left_out),
            penetration=as_float_array(xp.maximum(0, -geometry.points.distance.min(-1))),
            required_wrench=as_float_array(xp.where(admissible[:, None], weight, np.nan)),
            actuator_lengths=as_float_array(geometry.lengths),
            object_position=as_float_array(centre),
            object_rotation=as_float_array(rotation),
            **mechanics,
        )

    def engine(self, name: str) -> Engine:
        """The engine of a name, made once."""
        if name not in self._engines:
            parts = self.bodies, bodies_below(self.model, self.object_body), self.joints, self._actuators
            self._engines[name] = _ENGINES[name](self.model, *parts, self.contact_distance)
        return self._engines[name]

    @cached_property
    def _distances(self) -> DistanceEngine:
        engine = self.engine("distance")
        assert isinstance(engine, DistanceEngine)
        return engine

    @property
    def kinematics(self) -> Kinematics:
        """Poses of all bodies, by JAX."""
        return self._distances.kinematics

    def actuation_at(
        self, qpos: jax.Array, poses: Poses, world: jax.Array, rotation: jax.Array, frames: jax.Array, links: jax.Array
    ) -> Actuation | None:
        """What the hand can do with hard contacts at given points (n, n_c, 3) of its links, m, world frame."""
        none = jnp.zeros((len(qpos), 0), qpos.dtype)
        points = RawPoints(world, world, none, none, none, none, none)
        geometry = self._distances.geometry(qpos, poses, rotation, world[:, 0], points)
        moved = jnp.asarray(self.moved_bodies)[links]
        jacobian = self._mechanics.jacobians(geometry, world, moved, frames, rotation, False, jnp)
        joints = qpos[:, self.model.jnt_qposadr[self.joints]]
        return self._mechanics.actuation(geometry, joints, jacobian, False, jnp)["actuation"]
