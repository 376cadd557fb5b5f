"""A scene from a hand, an object and a world, built with MuJoCo's specifications."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxgrasp.hands.bodies import bodies_below, one_line
from jaxgrasp.hands.hand_files import BASE, hand_on_base, read_spec, with_absolute_paths
from jaxgrasp.hands.hand_object import HandObject
from jaxgrasp.hands.object_files import OBJECT, add_object

_GRAVITY_OFF = int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
TABLE, ENVIRONMENT = "table", "environment"


class Parts(NamedTuple):
    """Configurations by parts; poses are position, m, and quaternion (w, x, y, z), world frame."""

    base: Float[np.ndarray, "batch 7"]
    """That of a base that is fixed is no turn and no shift."""
    joints: Float[np.ndarray, "batch joints"]
    """In the order of `Scene.joint_names`, rad or m."""
    object: Float[np.ndarray, "batch 7"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A hand, a free object and what is around them, made with `build`."""

    spec: mujoco.MjSpec
    """The scene as a specification, in which the object's body is named "object" and the hand's base "hand-base"."""
    model: mujoco.MjModel
    """The scene, compiled."""

    @classmethod
    def build(
        cls,
        *,
        hand: str | PathLike | mujoco.MjSpec,
        object: str | PathLike | mujoco.MjSpec,
        scale: float = 1.0,
        mass: float | None = None,
        density: float | None = None,
        friction: float | None = None,
        torsional_friction: float | None = None,
        condim: int | None = None,
        base: str = "free",
        gravity: tuple[float, float, float] | None = None,
        table: float | None = None,
        environment: str | PathLike | mujoco.MjSpec | None = None,
    ) -> "Scene":
        """Builds a scene.

        Args:
            hand: An MJCF or URDF file, a specification, or a name: see `hand_names.hand_file`.
            object: A folder of convex pieces, a mesh (.obj, .stl, .msh; its convex hull is what touches), an MJCF or
                URDF file or specification of a rigid object, or "sphere", "capsule", "box", "cylinder" or "ellipsoid",
                1 m wide along x. Its file's frame is the frame of its body.
            scale: Of the object's lengths.
            mass: The object's, kg; or
            density: kg/m^3. Without either an MJCF or URDF file's own, and that of water for others.
            friction: Sliding friction of every contact of hand and object; None keeps the models'.
            torsional_friction: Likewise, m.
            condim: MuJoCo's dimension of these contacts: 1, 3, 4 or 6.
            base: How the frame of the hand file's world, not that of its first body, stands in the scene's world:
                "free", "fixed" or "mocap" (free, and welded to a mocap body).
            gravity: m/s^2, world frame; None keeps that of the hand's file.
            table: Height of a horizontal plane that hand and object can touch, m; None for none.
            environment: An MJCF file or specification of what stands fixed in the world.

        Raises:
            ValueError: Something cannot be read or used; the argument is named.
        """
        _check(scale=scale, mass=mass, density=density, friction=friction, torsional_friction=torsional_friction)
        if mass is not None and density is not None:
            raise ValueError(f"mass: got {mass} and density {density}, wanted one of them")
        if condim not in (None, 1, 3, 4, 6):
            raise ValueError(f"condim: got {condim}, wanted 1, 3, 4 or 6")
        spec = hand_on_base(hand, base)
        clash = [kind for kind in (spec.body, spec.joint, spec.geom) if kind(OBJECT) is not None]
        if clash:
            raise ValueError(f"hand: it has a {clash[0](OBJECT).__class__.__name__[3:].lower()} named {OBJECT!r}")
        add_object(spec, object, scale, mass, density)
        _set_contacts(spec, friction, torsional_friction, condim)
        if gravity is not None:
            _set_gravity(spec, gravity)
        if table is not None:
            _add_table(spec, table)
        if environment is not None:
            _add_environment(spec, environment)
        try:
            return cls(spec=spec, model=spec.compile())
        except ValueError as error:
            raise ValueError(f"scene: MuJoCo refuses it: {one_line(error)}") from error

    def save(self, path: str | PathLike) -> None:
        """Writes the scene as MJCF, with the meshes where they are.

        Raises:
            OSError: The file cannot be written.
        """
        Path(path).write_text(self.spec.to_xml())

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The hand's hinges and slides, in the order of its file."""
        return tuple(self.model.joint(j).name for j in self._joints)

    def hand_object(self, **options) -> HandObject:
        """The hand and the object; `options` are those of `HandObject.from_mjcf`."""
        return HandObject.from_mjcf(self.model, OBJECT, **options)

    def qpos(
        self,
        *,
        base: ArrayLike | None = None,
        joints: ArrayLike | Mapping[str, ArrayLike] | None = None,
        object: ArrayLike | None = None,
    ) -> Float[np.ndarray, "batch nq"]:
        """Configurations by names.

        Args:
            base: Poses of the base, (7,) or (N, 7): position, m, and quaternion (w, x, y, z), world frame.
            joints: Positions of the hand's joints, rad or m: (n,) or (N, n) in the order of `joint_names`, or an array
                () or (N,) for each name.
            object: Poses of the object's frame, (7,) or (N, 7), world frame.

        Returns:
            (N, nq). What is not given is as in the scene's reference. Quaternions are normalised, so that those of
            float32 files count.

        Raises:
            ValueError: Names or shapes that do not fit.
        """
        parts: list[tuple[slice | int, np.ndarray]] = []
        for argument, name, value in (("base", BASE, base), ("object", OBJECT, object)):
            if value is not None:
                parts.append((self._pose(argument, name), _poses(argument, value)))
        places = self.model.jnt_qposadr[self._joints]
        for name, column in self._columns(joints).items():
            parts.append((int(places[self.joint_names.index(name)]), column))
        sizes = {len(part) for _, part in parts if len(part) != 1} or {1}
        if len(sizes) > 1:
            raise ValueError(f"qpos: got {' and '.join(map(str, sorted(sizes)))} configurations, wanted as many of all")
        qpos = np.tile(self.model.qpos0, (sizes.pop(), 1))
        for place, part in parts:
            qpos[:, place] = part
        return qpos

    def parts(self, qpos: ArrayLike) -> "Parts":
        """What `qpos` puts together, taken apart.

        Args:
            qpos: (N, nq).
        """
        qpos = np.asarray(qpos, float)
        poses = [np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(qpos), 1)) for _ in range(2)]
        for k, name in enumerate((BASE, OBJECT)):
            if mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0:
                poses[k] = qpos[:, self._pose(name, name)]
        return Parts(base=poses[0], joints=qpos[:, self.model.jnt_qposadr[self._joints]], object=poses[1])

    @cached_property
    def _joints(self) -> np.ndarray:
        of_object = bodies_below(self.model, self.model.body(OBJECT).id)
        kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        return np.flatnonzero(~np.isin(self.model.jnt_bodyid, of_object) & np.isin(self.model.jnt_type, kinds))

    def _pose(self, argument: str, name: str) -> slice:
        joint = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint < 0:
            raise ValueError(f"{argument}: got poses, but the scene's base is fixed; wanted none, or base 'free'")
        start = int(self.model.jnt_qposadr[joint])
        return slice(start, start + 7)

    def _columns(self, joints: ArrayLike | Mapping[str, ArrayLike] | None) -> dict[str, np.ndarray]:
        if joints is None:
            return {}
        names = self.joint_names
        if not isinstance(joints, Mapping):
            given = np.atleast_2d(np.asarray(joints, float))
            if given.ndim != 2 or given.shape[1] != len(names):
                raise ValueError(f"joints: got shape {given.shape}, wanted (N, {len(names)}): {', '.join(names)}")
            return dict(zip(names, given.T, strict=True))
        if unknown := [name for name in joints if name not in names]:
            raise ValueError(f"joints: got {', '.join(map(repr, unknown))}, wanted some of {', '.join(names)}")
        columns = {name: np.atleast_1d(np.asarray(value, float)) for name, value in joints.items()}
        for name, column in columns.items():
            if column.ndim != 1:
                raise ValueError(f"joints: got shape {column.shape} for {name!r}, wanted (N,)")
        return columns


def _check(**lengths: float | None) -> None:
    for name, value in lengths.items():
        least = "at least 0" if "friction" in name else "above 0"
        if value is not None and not (math.isfinite(value) and (value > 0 or value == 0 and "friction" in name)):
            raise ValueError(f"{name}: got {value}, wanted a finite number {least}")


def _poses(argument: str, value: ArrayLike) -> np.ndarray:
    poses = np.atleast_2d(np.asarray(value, float)).copy()
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise ValueError(f"{argument}: got shape {poses.shape}, wanted (N, 7), position and quaternion (w, x, y, z)")
    length = np.linalg.norm(poses[:, 3:], axis=-1, keepdims=True)
    # Farther from 1 than rounding of float32 makes them they are left as they are, and refused where they are used.
    poses[:, 3:] = np.where(np.abs(length - 1) <= 1e-3, poses[:, 3:] / np.where(length > 0, length, 1), poses[:, 3:])
    return poses


def _set_contacts(spec: mujoco.MjSpec, friction: float | None, torsional: float | None, condim: int | None) -> None:
    for geom in spec.geoms:
        values = np.array(geom.friction)
        for place, value in ((0, friction), (1, torsional)):
            if value is not None:
                values[place] = value
        geom.friction = values
        geom.condim = geom.condim if condim is None else condim
    for pair in spec.pairs:
        values = np.array(pair.friction)
        for places, value in ((slice(0, 2), friction), (2, torsional)):
            if value is not None:
                values[places] = value
        pair.friction = values
        pair.condim = pair.condim if condim is None else condim


def _set_gravity(spec: mujoco.MjSpec, gravity: tuple[float, float, float]) -> None:
    if np.shape(gravity) != (3,) or not np.all(np.isfinite(gravity)):
        raise ValueError(f"gravity: got {gravity}, wanted three finite numbers, m/s^2")
    spec.option.gravity = gravity
    spec.option.disableflags &= ~_GRAVITY_OFF


def _add_table(spec: mujoco.MjSpec, height: float) -> None:
    if not math.isfinite(height):
        raise ValueError(f"table: got {height}, wanted a finite height in metres")
    # Half a metre to each side is what is drawn; it has no end.
    kind = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name=TABLE, type=kind, size=(0.5, 0.5, 0.01), pos=(0, 0, height))


def _add_environment(spec: mujoco.MjSpec, environment: str | PathLike | mujoco.MjSpec) -> None:
    if isinstance(environment, mujoco.MjSpec):
        part = environment.copy()
    else:
        part = read_spec("environment", Path(environment))
    with_absolute_paths(part)
    for joint in list(part.joints):
        part.delete(joint)
    for name in (n for n in dir(spec.option) if not n.startswith("_")):
        setattr(part.option, name, getattr(spec.option, name))
    spec.worldbody.add_frame().attach_body(part.worldbody, f"{ENVIRONMENT}-", "")
