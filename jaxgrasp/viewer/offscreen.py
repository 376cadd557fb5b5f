"""MuJoCo's renderer without a window."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
from jaxtyping import UInt8

_REMEDY = "on a machine without a display set MUJOCO_GL=egl and install EGL (Debian and Ubuntu: apt install libegl1)"


@contextmanager
def offscreen(
    model: mujoco.MjModel, width: int, height: int
) -> Iterator[Callable[[mujoco.MjvScene], UInt8[np.ndarray, "height width 3"]]]:
    """Opens a renderer for pictures of one model, closed at the end of the `with` block.

    MuJoCo's own `Renderer` takes the system that the environment variable MUJOCO_GL named when mujoco was imported, and
    a windowed one where it is unset. This one then takes EGL where there is no display.

    Args:
        model: The model; its buffer for pictures, `vis.global_.offwidth` times `offheight`, is large enough.
        width: Pixels.
        height: Pixels.

    Yields:
        What turns a scene into a picture, the top row first.

    Raises:
        RuntimeError: No OpenGL context can be had; the message names the remedy.
    """
    window = _open(width, height)
    try:
        target = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, target)
        rectangle = mujoco.MjrRect(0, 0, width, height)

        def render(scene: mujoco.MjvScene) -> UInt8[np.ndarray, "height width 3"]:
            picture = np.empty((height, width, 3), np.uint8)
            window.make_current()
            mujoco.mjr_render(rectangle, scene, target)
            mujoco.mjr_readPixels(picture, None, rectangle, target)
            return picture[::-1]

        try:
            yield render
        finally:
            target.free()
    finally:
        window.free()


def _open(width: int, height: int) -> Any:
    try:
        window = _system()(width, height)
        window.make_current()
    except Exception as error:  # missing libraries, drivers, devices: each system has its own exceptions
        raise RuntimeError(f"no OpenGL context for MuJoCo's renderer ({error}); {_REMEDY}") from error
    return window


def _system() -> Any:
    """The class of contexts to use."""
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    # Without a display a windowed context opens with no more than a warning, and what is made in it ends the process.
    if sys.platform == "linux" and not display and chosen not in ("egl", "osmesa"):
        if chosen:
            raise RuntimeError(f"MUJOCO_GL={chosen} opens nothing without a display")
        from mujoco.egl import GLContext

        return GLContext
    from mujoco.rendering.classic import gl_context

    return gl_context.GLContext
