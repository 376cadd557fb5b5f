"""Hands as MuJoCo reads them: by file, by name, or as a specification, on a base that is free, fixed or mocap."""

import xml.etree.ElementTree as ElementTree
from os import PathLike
from pathlib import Path

import mujoco
import numpy as np

from jaxgrasp.hands.bodies import one_line
from jaxgrasp.hands.files import compile_file
from jaxgrasp.hands.hand_names import hand_file

BASES = ("free", "fixed", "mocap")
BASE = "hand-base"
"""Name of the body that the hand's file stands on, and of its free joint."""
_DRIVER = "hand-base-mocap"
_STATIC = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
# A base without geoms needs some inertia to move in MuJoCo, kg and kg m^2; contacts and margins do not see it.
_LEAST_MASS, _LEAST_INERTIA = 1e-3, 1e-6


def hand_on_base(hand: str | PathLike | mujoco.MjSpec, base: str) -> mujoco.MjSpec:
    """A specification in which the whole world of a hand's file stands on a base.

    Args:
        hand: An MJCF or URDF file, a specification, or a name that `hand_names.hand_file` knows.
        base: "free" (a body with a free joint), "fixed" (as in the file), or "mocap" (a free body that is welded to a
            mocap body).

    Raises:
        ValueError: The hand cannot be read, or stands on a base already.
    """
    if base not in BASES:
        raise ValueError(f"base: got {base!r}, wanted one of {', '.join(BASES)}")
    name = "the specification" if isinstance(hand, mujoco.MjSpec) else str(hand)
    spec = hand_spec(hand)
    try:
        with_absolute_paths(spec)
        for key in list(spec.keys):
            # Their configurations lack the joints of base and object.
            spec.delete(key)
        model = spec.compile()
        if base == "fixed":
            return spec
        if model.jnt_type.tolist().count(int(mujoco.mjtJoint.mjJNT_FREE)):
            raise ValueError("it has a free joint of its own; wanted a hand without one, or base 'fixed'")
        if np.isin(model.geom_type, _STATIC).any():
            raise ValueError("it has a plane or a height field, which cannot move; wanted none, or base 'fixed'")
        wrapped = _on_body(spec.to_xml(), bare=not model.body_mass[model.body_weldid == 0].sum())
        out = mujoco.MjSpec.from_string(wrapped, assets=spec.assets)
    except (ValueError, ElementTree.ParseError) as error:
        raise ValueError(f"hand: {name} cannot be used: {one_line(error)}") from error
    body = out.body(BASE)
    body.add_freejoint(name=BASE)
    if base == "mocap":
        out.worldbody.add_body(name=_DRIVER, mocap=True)
        weld = out.add_equality(name=_DRIVER, type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
        weld.name1, weld.name2 = _DRIVER, BASE
        # Anchor, relative pose (that of the reference) and torque scale: the specification's own has an anchor 1 m off.
        weld.data[:11] = [0.0] * 10 + [1.0]
    return out


def hand_spec(hand: str | PathLike | mujoco.MjSpec) -> mujoco.MjSpec:
    """The specification of a hand; a copy of one that is given.

    Args:
        hand: An MJCF or URDF file, a specification, or a name that `hand_names.hand_file` knows.

    Raises:
        ValueError: The hand cannot be read.
    """
    return hand.copy() if isinstance(hand, mujoco.MjSpec) else read_spec("hand", hand_file(hand))


def read_spec(argument: str, path: Path) -> mujoco.MjSpec:
    """The specification of an MJCF or URDF file.

    Raises:
        ValueError: It cannot be read; `argument` is what named it.
    """
    try:
        # What MuJoCo's compiler does not survive is found in a process of its own.
        compile_file(path)
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise ValueError(f"{argument}: {path} cannot be read: {one_line(error)}") from error


def with_absolute_paths(spec: mujoco.MjSpec) -> None:
    """Makes the files that a specification names independent of where it is saved."""
    root = Path(spec.modelfiledir or ".").resolve()
    for folder, assets in ((spec.meshdir, [*spec.meshes, *spec.hfields]), (spec.texturedir, spec.textures)):
        for asset in assets:
            if asset.file and asset.file not in spec.assets:
                asset.file = str(root / folder / asset.file)
    spec.meshdir = spec.texturedir = ""


def _on_body(xml: str, bare: bool) -> str:
    """MJCF with everything that is in its world put into one body; `bare` says that nothing of it has mass."""
    root = ElementTree.fromstring(xml)
    for world in root.iter("worldbody"):
        body = ElementTree.Element("body", name=BASE)
        if bare:
            inertia = " ".join([str(_LEAST_INERTIA)] * 3)
            ElementTree.SubElement(body, "inertial", pos="0 0 0", mass=str(_LEAST_MASS), diaginertia=inertia)
        body.extend(list(world))
        world[:] = [body]
    for group in root.iter("equality"):
        for constraint in group:
            if "body1" in constraint.attrib and constraint.get("body2", "world") == "world":
                constraint.set("body2", BASE)
    for pair in root.iter("exclude"):
        for side in ("body1", "body2"):
            if pair.get(side) == "world":
                pair.set(side, BASE)
    return ElementTree.tostring(root, encoding="unicode")
