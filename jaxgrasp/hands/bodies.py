"""The bodies of a scene."""

from os import PathLike

import mujoco
import numpy as np

from jaxgrasp.hands.files import compile_file


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
        raise ValueError(f"scene: {name} cannot be read: {' '.join(str(error).split())}") from error
    _refuse_infinite(model)
    return model


def _refuse_infinite(model: mujoco.MjModel) -> None:
    """MuJoCo reads "nan" as a number."""
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    numbers = {n: x for n, x in arrays.items() if isinstance(x, np.ndarray) and x.dtype.kind == "f"}
    bad = [name for name, values in numbers.items() if not np.isfinite(values).all()]
    if bad:
        raise ValueError(f"scene: got {', '.join(bad)} with entries that are not finite; wanted numbers")


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
