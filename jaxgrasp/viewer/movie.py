"""Moving pictures of simulated hands that are pushed, and of grasps on trial."""

from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from jaxgrasp.simulation import Run
from jaxgrasp.storage import atomic_write
from jaxgrasp.viewer.offscreen import offscreen
from jaxgrasp.viewer.scene import add_arrow, add_background, for_pictures

_PIXELS = 300
_FRAME = 0.05
# m a newton, of the push's arrow.
_ARROW = 0.015
# m, of a load's arrow.
_SHOWN = 0.06
_PUSH, _RING = (0.80, 0.15, 0.15, 1.0), 0.0025
_AZIMUTH, _ELEVATION, _DISTANCE = 130.0, -22.0, 0.34


def write_movie(
    path: Path | str,
    model: mujoco.MjModel,
    runs: Sequence[tuple[str, Run, int]],
    *,
    begin: float = 0.0,
    end: float = np.inf,
    slower: float = 1.0,
) -> None:
    """Renders lanes of runs beside each other and writes them as an animated GIF; pushes are red arrows.

    Args:
        path: The file, `.gif`.
        model: Hand and object of all of them.
        runs: Title, run and lane of every panel.
        begin: Of what is shown, s.
        end: s.
        slower: How many times slower than in the world.

    Raises:
        RuntimeError: No OpenGL context can be had; the message names the remedy.
        OSError: The file cannot be written.
    """
    time = runs[0][1].time
    moments = np.arange(max(begin, time[0]), min(end, time[-1]) + 1e-9, _FRAME / slower)
    steps = np.minimum(np.searchsorted(time, moments - 1e-9), len(time) - 1)
    model, frames = for_pictures(model, pixels=_PIXELS), []
    data = mujoco.MjData(model)
    data.qpos[:] = runs[0][1].qpos[0, runs[0][2]]
    mujoco.mj_forward(model, data)
    centre = data.body("object").xipos.copy()
    with offscreen(model, _PIXELS, _PIXELS) as render:
        for step in steps:
            panels = [
                _panel(model, data, render, run.qpos[step, lane], run.push.at(float(time[step]))[lane, :3], centre)
                for _, run, lane in runs
            ]
            frames.append(_labelled(panels, [title for title, _, _ in runs], float(time[step])))
    _write(path, frames)


def write_course_movie(
    path: Path | str,
    model: mujoco.MjModel,
    title: str,
    course: Sequence[tuple[float, Float[np.ndarray, " nq"], Float[np.ndarray, " 3"]]],
) -> None:
    """Renders a trial of a grasp and writes it as an animated GIF, in real time; loads are red arrows.

    Args:
        path: The file, `.gif`.
        model: Hand and object; the object's body is named "object".
        title: What stands above.
        course: Time, s, configuration and load, N, of `jaxgrasp.evaluation.film`.

    Raises:
        RuntimeError: No OpenGL context can be had; the message names the remedy.
        OSError: The file cannot be written.
    """
    time = np.array([moment for moment, _, _ in course])
    steps = np.minimum(np.searchsorted(time, np.arange(time[0], time[-1] + 1e-9, _FRAME) - 1e-9), len(time) - 1)
    model = for_pictures(model, pixels=_PIXELS)
    data = mujoco.MjData(model)
    data.qpos[:] = course[0][1]
    mujoco.mj_forward(model, data)
    centre, frames = data.body("object").xipos.copy(), []
    with offscreen(model, _PIXELS, _PIXELS) as render:
        for step in steps:
            moment, qpos, load = course[step]
            # A load of any size is an arrow of one length.
            force = load / max(float(np.linalg.norm(load)), 1e-12) * (_SHOWN / _ARROW)
            frames.append(_labelled([_panel(model, data, render, qpos, force, centre)], [title], moment))
    _write(path, frames)


def _write(path: Path | str, frames: list[Image.Image]) -> None:
    options = {"save_all": True, "duration": round(1e3 * _FRAME), "loop": 0, "optimize": True}
    with atomic_write(path) as stream:
        frames[0].save(stream, format="GIF", append_images=frames[1:], **options)


def _panel(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    render: Callable[[mujoco.MjvScene], UInt8[np.ndarray, "height width 3"]],
    qpos: np.ndarray,
    force: np.ndarray,
    centre: np.ndarray,
) -> UInt8[np.ndarray, "height width 3"]:
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = centre - [0, 0, 0.02], _DISTANCE
    camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        scene.flags[flag] = 0
    add_background(scene)
    if force.any():
        tip = data.body("object").xipos
        add_arrow(scene, tip - _ARROW * force, tip, _RING, _PUSH)
    return render(scene)


def _labelled(panels: list[np.ndarray], titles: list[str], time: float) -> Image.Image:
    picture = Image.fromarray(np.concatenate(panels, 1))
    pen = ImageDraw.Draw(picture)
    for number, title in enumerate(titles):
        pen.text((number * _PIXELS + 8, 6), title, fill=(0, 0, 0))
    pen.text((8, _PIXELS - 18), f"{time:.2f} s", fill=(90, 90, 90))
    return picture
