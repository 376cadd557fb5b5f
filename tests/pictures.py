"""Whether pictures of scenes can be drawn here."""

from __future__ import annotations

from jaxgrasp.hands import scenes
from jaxgrasp.viewer import offscreen


def has_context() -> bool:
    try:
        with offscreen.offscreen(scenes.four_fingers().compile(), 16, 16):
            return True
    except RuntimeError:
        return False
