"""Built-in scenes: a hand and a free object in front of it, as MuJoCo specifications."""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from jaxgrasp.geometry.mesh import MESH_ENDINGS, Mesh

OBJECTS = ("sphere", "capsule", "box", "cylinder", "ellipsoid", "mesh")
_MASS = 0.1
_FRICTION = 0.8
_HALF_WIDTH = 0.025
_MESH_VERTICES = 32
_COUPLED_FINGERS = ("FF", "MF", "RF", "LF")


def shadow_hand(
    object: str | Path = "sphere", size: float | None = None, coupled_tendons: bool = False
) -> mujoco.MjSpec:
    """The right Shadow Hand that comes with the package mujoco-mjx, its palm up, and an object above the palm.

    The forearm lies along x, the palm faces +z; the object floats free above the roots of the fingers.

    Args:
        object: One of `OBJECTS`, or a mesh file: see `four_fingers`.
        size: As in `four_fingers`.
        coupled_tendons: Whether the two outer joints of each of the four fingers hang on one tendon and are driven by
            one actuator, as in the real hand: tendons `rh_FFJ0` (and MF, RF, LF) with the sum of the joint
            angles J2 + J1, position actuators `rh_A_FFJ0` ... with kp 0.5 N m/rad and at most 1 N m.
            Otherwise each joint has its own.

    Returns:
        The specification, with a free body named "object".

    Raises:
        ValueError: The object is unknown, or the size is not positive.
        FileNotFoundError: The hand's file is missing in the installed mujoco-mjx.
    """
    spec = mujoco.MjSpec.from_file(str(_shadow_hand_file()))
    if coupled_tendons:
        for finger in _COUPLED_FINGERS:
            _couple(spec, finger)
    return _finish(spec, object, size, position=(0.355, -0.005, 0.085))


def four_fingers(object: str | Path = "sphere", size: float | None = None) -> mujoco.MjSpec:
    """A ring of four fingers with three joints each and spherical tips of 8 mm, and an object between the tips.

    The joints of finger i are `f{i}_base`, `f{i}_flex1` and `f{i}_flex2`; each has a position actuator of its name.
    The tips' geoms are `f{i}_tip`. The file `four_fingers.xml` has the axes, ranges, gains and limits.

    Args:
        object: "sphere", "capsule" (upright), "box" (a cube), "cylinder" (upright), "ellipsoid" or "mesh" (a rounded
            cuboid of 32 vertices), all 0.1 kg; or the path of a mesh file (.stl, .obj, .ply; m), whose
            centre of mass becomes the body's origin and whose convex hull is what touches.
        size: Half the object's width along x, m. Where None, 0.025, or what a mesh file says.

    Returns:
        The specification, with a free body named "object".

    Raises:
        ValueError: The object is unknown, or the size is not positive.
    """
    spec = mujoco.MjSpec.from_file(str(_four_fingers_file()))
    return _finish(spec, object, size, position=(0.0, 0.0, 0.085))


def _shadow_hand_file() -> Path:
    # Found without being imported: mjx takes seconds.
    found = importlib.util.find_spec("mujoco.mjx")
    folders = found.submodule_search_locations if found else None
    paths = [Path(folder, "test_data", "shadow_hand", "right_hand.xml") for folder in folders or ()]
    for path in paths:
        if path.is_file():
            return path
    where = f"{paths[0]} is missing" if paths else "mujoco-mjx is not installed"
    raise FileNotFoundError(f"the Shadow Hand comes with the package mujoco-mjx, but {where}: pip install mujoco-mjx")


def _four_fingers_file() -> Path:
    return Path(__file__).with_name("four_fingers.xml")


HAND_FILES = {"shadow_hand": _shadow_hand_file, "four_fingers": _four_fingers_file}
"""Where the files of the built-in hands are, by name."""


def _couple(spec: mujoco.MjSpec, finger: str) -> None:
    tendon = spec.add_tendon(name=f"rh_{finger}J0")
    for joint in ("J2", "J1"):
        tendon.wrap_joint(f"rh_{finger}{joint}", 1.0)
        spec.delete(spec.actuator(f"rh_A_{finger}{joint}"))
    actuator = spec.add_actuator(
        name=f"rh_A_{finger}J0",
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        target=tendon.name,
        ctrlrange=(0.0, 3.1415),
        forcerange=(-1.0, 1.0),
    )
    actuator.set_to_position(kp=0.5)


def _finish(
    spec: mujoco.MjSpec, object: str | Path, size: float | None, position: tuple[float, float, float]
) -> mujoco.MjSpec:
    """Adds the object and the settings of the simulation: those with which held objects stay."""
    if size is not None and not (np.isfinite(size) and size > 0.0):
        raise ValueError(f"size: got {size}, wanted a positive number of metres")
    body = spec.worldbody.add_body(name="object", pos=position)
    body.add_freejoint(name="object")
    geom = body.add_geom(name="object", mass=_MASS, rgba=(0.86, 0.79, 0.64, 1.0))
    _shape(spec, geom, object, size)
    # The object's contact parameters count wherever it touches. It meets all masks that the hands' geoms have.
    geom.priority = 1
    geom.contype, geom.conaffinity = 7, 1
    geom.condim = 3
    geom.friction = (_FRICTION, 0.005, 0.0001)
    geom.solref = (0.005, 1.0)
    option = spec.option
    option.timestep = 1e-3
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # With 1, MuJoCo's default, the weight of a held object makes it creep out of the grasp.
    option.impratio = 100.0
    option.iterations, option.ls_iterations = 100, 50
    return spec


def _shape(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, object: str | Path, size: float | None) -> None:
    half_width = _HALF_WIDTH if size is None else size
    primitives = {
        "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, (1.0, 0.0, 0.0)),
        "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, (1.0, 0.8, 0.0)),
        "box": (mujoco.mjtGeom.mjGEOM_BOX, (1.0, 1.0, 1.0)),
        "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, (1.0, 1.2, 0.0)),
        "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, (1.0, 0.8, 1.3)),
    }
    if object in primitives:
        geom.type, proportions = primitives[str(object)]
        geom.size = half_width * np.array(proportions)
        return
    geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, "object"
    if object == "mesh":
        spec.add_mesh(name="object", uservert=_rounded_cuboid(half_width).ravel())
    elif Path(object).suffix.lower() in MESH_ENDINGS:
        mesh = Mesh.from_file(object)
        vertices = mesh.vertices - mesh.centroid
        if size is not None:
            vertices *= 2.0 * size / np.ptp(vertices[:, 0])
        asset = spec.add_mesh(name="object", uservert=vertices.ravel(), userface=mesh.faces.ravel())
        asset.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT
    else:
        raise ValueError(
            f"object: got {str(object)!r}, wanted one of {', '.join(OBJECTS)} or a file {', '.join(MESH_ENDINGS)}"
        )


def _rounded_cuboid(half_width: float) -> Float[np.ndarray, "vertices 3"]:
    """Points with |x/a|^4 + |y/b|^4 + |z/c|^4 = 1 in directions spread evenly, each with its opposite."""
    number = np.arange(_MESH_VERTICES // 2)
    height = (number + 0.5) / len(number)
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * number
    ring = np.sqrt(1.0 - height**2)
    directions = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=-1)
    directions = np.concatenate([directions, -directions])
    semi_axes = half_width * np.array([1.0, 0.9, 1.2])
    return directions * ((directions / semi_axes) ** 4).sum(-1, keepdims=True) ** -0.25
