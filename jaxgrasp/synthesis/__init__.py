"""Grasps made by gradient ascent on the robustness margin, from many random starts on an object's surface."""

from jaxgrasp.synthesis.grasps import Record, Synthesis, synthesize

__all__ = ["Record", "Synthesis", "synthesize"]
