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
