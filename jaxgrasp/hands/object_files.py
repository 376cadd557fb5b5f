"""Objects of scenes: a mesh, a folder of convex pieces, the bodies of an MJCF or URDF file, or a primitive."""

import math
from os import PathLike
from pathlib import Path

import mujoco
import numpy as np

from jaxgrasp.hands.bodies import one_line
from jaxgrasp.hands.hand_files import read_spec, with_absolute_paths

OBJECT = "object"
"""Name of the object's body and of its free joint."""
# MuJoCo decodes these itself.
MESHES = (".obj", ".stl", ".msh")
PRIMITIVES = {
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, (0.5, 0.0, 0.0)),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, (0.5, 0.4, 0.0)),
    "box": (mujoco.mjtGeom.mjGEOM_BOX, (0.5, 0.5, 0.5)),
    "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, (0.5, 0.6, 0.0)),
    "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, (0.5, 0.4, 0.65)),
}
"""Sizes at which a primitive is 1 wide along x."""
_WATER = 1000.0


def add_object(
    spec: mujoco.MjSpec,
    object: str | PathLike | mujoco.MjSpec,
    scale: float,
    mass: float | None,
    density: float | None,
) -> None:
    """Adds a free object to a scene.

    Args:
        spec: The scene, written.
        object: As in `Scene.build`.
        scale: Of lengths.
        mass: kg, spread evenly over the object's volume; or
        density: kg/m^3; without either, an MJCF or URDF file's own, and that of water for others.

    Raises:
        ValueError: It cannot be read, has no volume, or has joints.
    """
    body = spec.worldbody.add_body(name=OBJECT)
    body.add_freejoint(name=OBJECT)
    if isinstance(object, mujoco.MjSpec) or Path(object).suffix.lower() in (".xml", ".mjcf", ".urdf"):
        geoms = _add_bodies(spec, body, object, scale)
    else:
        masks = 1
        for geom in spec.geoms:
            masks |= geom.contype | geom.conaffinity
        geoms = _add_geoms(spec, body, object, scale)
        for geom in geoms:
            # It meets whatever collides, whichever masks the hand has for itself.
            geom.contype = geom.conaffinity = masks
        density = _WATER if mass is None and density is None else density
    if mass is None and density is None:
        return
    for other in (body, *body.find_all("body")):
        other.explicitinertial = False
    for geom in geoms:
        geom.mass, geom.density = math.nan, _WATER if density is None else density
    if density is None:
        assert mass is not None
        # Masses go with volumes: one compilation tells these.
        whole = _mass_of(spec, object)
        for geom in geoms:
            geom.density = _WATER * mass / whole


def _add_geoms(spec: mujoco.MjSpec, body: mujoco.MjsBody, object: str | PathLike, scale: float) -> list[mujoco.MjsGeom]:
    """Geoms of a primitive or of meshes, every one by its convex hull."""
    if str(object) in PRIMITIVES:
        kind, size = PRIMITIVES[str(object)]
        return [body.add_geom(name=OBJECT, type=kind, size=scale * np.array(size))]
    path = Path(object)
    files = sorted(f for f in path.iterdir() if f.suffix.lower() in MESHES) if path.is_dir() else [path]
    if not files:
        raise ValueError(f"object: {path} has no meshes; wanted a folder with convex pieces, {', '.join(MESHES)}")
    if path.suffix.lower() not in MESHES and not path.is_dir():
        raise ValueError(
            f"object: got {str(object)!r}, wanted a folder of convex pieces, a mesh {', '.join(MESHES)}, an MJCF or "
            f"URDF file, or one of {', '.join(PRIMITIVES)}"
        )
    geoms = []
    for number, file in enumerate(files):
        if not file.is_file():
            raise ValueError(f"object: got {str(object)!r}, and there is no such file")
        mesh = spec.add_mesh(name=f"{OBJECT}-{number}", file=str(file.resolve()), scale=[scale] * 3)
        # What collides is the convex hull, so that is what has the mass.
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        geoms.append(body.add_geom(name=mesh.name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name))
    return geoms


def _add_bodies(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, object: str | PathLike | mujoco.MjSpec, scale: float
) -> list[mujoco.MjsGeom]:
    """The bodies of a file, without the free joint that they may have."""
    if isinstance(object, mujoco.MjSpec):
        part = object.copy()
    elif Path(object).is_file():
        part = read_spec("object", Path(object))
    else:
        raise ValueError(f"object: got {str(object)!r}, and there is no such file")
    with_absolute_paths(part)
    for joint in list(part.joints):
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"object: it has a joint {joint.name!r} inside; wanted a rigid object")
        part.delete(joint)
    for key in list(part.keys):
        part.delete(key)
    for name in (n for n in dir(spec.option) if not n.startswith("_")):
        # The hand's options count.
        setattr(part.option, name, getattr(spec.option, name))
    for mesh in part.meshes:
        mesh.scale = scale * np.array(mesh.scale)
    for geom in part.geoms:
        geom.pos, geom.size = scale * geom.pos, scale * geom.size
        geom.fromto = scale * geom.fromto
    for inner in part.bodies[1:]:
        inner.pos, inner.ipos = scale * inner.pos, scale * inner.ipos
    for site in part.sites:
        site.pos, site.size = scale * site.pos, scale * site.size
    body.add_frame().attach_body(part.worldbody, f"{OBJECT}-", "")
    return list(body.find_all("geom"))


def _mass_of(spec: mujoco.MjSpec, object: object) -> float:
    """The object's mass as the scene has it, kg."""
    try:
        model = spec.copy().compile()
    except ValueError as error:
        raise ValueError(f"object: {object} cannot be used: {one_line(error)}") from error
    mass = float(model.body_subtreemass[model.body(OBJECT).id])
    if not mass > 0:
        raise ValueError(f"object: {object} has no volume; wanted a solid")
    return mass
