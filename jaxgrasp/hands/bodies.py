"""The bodies of a scene."""

from os import PathLike
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from jaxgrasp.hands.files import compile_file

# Quaternions are normalised; farther from 1 than this they are taken for a mistake.
_QUATERNION_TOLERANCE = 1e-3


def one_line(error: BaseException) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split())


def read_model(scene: str | PathLike | mujoco.MjSpec | mujoco.MjModel) -> mujoco.MjModel:
    """The model of a file or a specification.

    Raises:
        ValueError: It cannot be read, or has numbers that are not finite.
    """
    try:
        if isinstance(scene, mujoco.MjSpec):
            model = scene.compile()
        else:
            model = scene if isinstance(scene, mujoco.MjModel) else compile_file(scene)
    except ValueError as error:
        name = "the specification" if isinstance(scene, mujoco.MjSpec) else scene
        raise ValueError(f"scene: {name} cannot be read: {one_line(error)}") from error
    _refuse_infinite(model)
    return model


def _refuse_infinite(model: mujoco.MjModel) -> None:
    """MuJoCo reads "nan" as a number."""
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    numbers = {n: x for n, x in arrays.items() if isinstance(x, np.ndarray) and x.dtype.kind == "f"}
    bad = [name for name, values in numbers.items() if not np.isfinite(values).all()]
    if bad:
        raise ValueError(f"scene: got {', '.join(bad)} with entries that are not finite; wanted numbers")


def check_length(model: mujoco.MjModel, shape: tuple[int, ...]) -> None:
    """Checks the shape (*batch, nq) of configurations.

    Raises:
        ValueError: It has another length.
    """
    if not shape or shape[-1] != model.nq:
        free = int(mujoco.mjtJoint.mjJNT_FREE)
        names = ", ".join(
            f"{model.joint(j).name or j}{' (7)' if model.jnt_type[j] == free else ''}" for j in range(model.njnt)
        )
        raise ValueError(f"qpos: got shape {shape}, wanted (*batch, {model.nq}), positions of joints {names}")


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


def admissible_configurations(model: mujoco.MjModel, qpos: Any, xp: ModuleType) -> Any:
    """Which configurations (n, nq) are finite and have unit quaternions, (n,)."""
    fine = xp.isfinite(qpos).all(-1)
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        start = model.jnt_qposadr[joint] + 3
        squared = (qpos[:, start : start + 4] ** 2).sum(-1)
        least, most = (1 - _QUATERNION_TOLERANCE) ** 2, (1 + _QUATERNION_TOLERANCE) ** 2
        fine = fine & (squared >= least) & (squared <= most)
    return fine


def wrench_against_weight(model: mujoco.MjModel, object: np.ndarray, rotation: Any, xp: ModuleType) -> Any:
    """What bears an object's weight less its gravity compensation, (n, 6), N and N m, in its frame.

    Args:
        model: The scene.
        object: Bodies of the object, which are fixed to the first one.
        rotation: (n, 3, 3), columns are the axes of the object's frame.
        xp: numpy or jax.numpy.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    # An object that is fixed to the world may have no mass.
    masses = np.maximum(model.body_mass[object], 1e-12)
    centres = data.xipos[object] - masses @ data.xipos[object] / masses.sum()
    weighing = model.body_mass[object] * (1 - model.body_gravcomp[object])
    lever = (weighing @ centres @ data.xmat[object[0]].reshape(3, 3)).astype(rotation.dtype)
    on = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    gravity = xp.einsum("nji,j->ni", rotation, (on * model.opt.gravity).astype(rotation.dtype))
    return -xp.concatenate([float(weighing.sum()) * gravity, xp.cross(lever, gravity)], -1)


def moved_by_joints(model: mujoco.MjModel, joints: np.ndarray) -> np.ndarray:
    """(bodies, joints), bool: which of the joints move a body."""
    moved = np.zeros((model.nbody, len(joints)), bool)
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]] | (model.jnt_bodyid[joints] == body)
    return moved
