"""Grasps in a browser: a list, sliders, and each grasp in 3D.

What needs viser, an optional package, is in `server` alone.
"""

from jaxgrasp.viewer.browser.viewed import Viewed
from jaxgrasp.viewer.browser.what_if import Answer, Change, Reasons, answer, reasons

__all__ = ["Answer", "Change", "Reasons", "Viewed", "answer", "reasons"]
