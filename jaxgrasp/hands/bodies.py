"""The bodies of a scene."""

from os import PathLike

import mujoco
import numpy as np


def one_line(error: BaseException) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split())


def read_model(scene: str | PathLike | mujoco.MjSpec | mujoco.MjModel) -> mujoco.MjModel:
    """The model of a file or a specification.

    Raises:
        ValueError: It cannot be read.
    """
    if isinstance(scene, mujoco.MjModel):
        return scene
    try:
        return scene.compile() if isinstance(scene, mujoco.MjSpec) else mujoco.MjModel.from_xml_path(str(scene))
    except ValueError as error:
        name = "the specification" if isinstance(scene, mujoco.MjSpec) else scene
        raise ValueError(f"scene: {name} cannot be read: {one_line(error)}") from error


def body_named(model: mujoco.MjModel, argument: str, name: str) -> int:
    """The number of a body; `argument` is what named it, for the error.

    Raises:
        ValueError: There is none.
    """
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body <= 0:
        names = ", ".join(model.body(b).name for b in range(1, model.nbody) if model.body(b).name)
        raise ValueError(f"{argument}: got {name!r}, wanted one of the scene's bodies: {names}")
    return body


def bodies_below(model: mujoco.MjModel, body: int) -> np.ndarray:
    """A body and all bodies below it, itself first."""
    inside = {body}
    for other in range(body + 1, model.nbody):
        if int(model.body_parentid[other]) in inside:
            inside.add(other)
    return np.array(sorted(inside))


def hand_bodies(model: mujoco.MjModel, object: np.ndarray) -> np.ndarray:
    """The bodies of the hand where none is named: what its joints move, its root, and what is fixed to these.

    The root is the last body that all of the hand's hinges and slides hang on, or, where they hang on several bodies of
    the world, each of these. A body that is neither the object's nor the hand's, a table for example, is environment:
    it is no finger. In a scene without hinges and slides every body that is not the object's is the hand's.

    Args:
        model: The scene.
        object: Bodies of the object.
    """
    others = np.setdiff1d(np.arange(1, model.nbody), object)
    jointed = np.isin(model.jnt_type, (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)))
    jointed = np.setdiff1d(model.jnt_bodyid[jointed], object)
    if not len(jointed):
        return others
    chains = [_chain(model, int(model.body_parentid[body])) for body in jointed]
    shared = [body for body in chains[0] if all(body in chain for chain in chains)]
    if shared:
        above = _chain(model, shared[0])
        free = [body for body in above if model.jnt_bodyid[model.jnt_type == 0].tolist().count(body)]
        inside = np.union1d(bodies_below(model, free[-1] if free else shared[0]), above)
    else:
        tops = {_chain(model, int(body))[-1] for body in jointed}
        inside = np.concatenate([bodies_below(model, top) for top in tops])
    return np.intersect1d(inside, others)


def _chain(model: mujoco.MjModel, body: int) -> list[int]:
    """The body and those above it, without the world."""
    chain = []
    while body:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain


def gravity_of(model: mujoco.MjModel) -> np.ndarray:
    """(3,), m/s^2, world frame; zero where the scene switches it off."""
    return model.opt.gravity * (not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY))


def weighing_mass(model: mujoco.MjModel, object: np.ndarray) -> tuple[float, np.ndarray]:
    """The object's mass less what gravity compensation takes off, kg, and its first moment (3,), kg m.

    The moment is about the centre of all mass, in the object's frame.

    Args:
        model: The scene.
        object: Bodies of the object, which are fixed to the first one.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    masses = np.maximum(model.body_mass[object], 1e-12)
    centres = data.xipos[object] - masses @ data.xipos[object] / masses.sum()
    weighing = model.body_mass[object] * (1 - model.body_gravcomp[object])
    return float(weighing.sum()), weighing @ centres @ data.xmat[object[0]].reshape(3, 3)
