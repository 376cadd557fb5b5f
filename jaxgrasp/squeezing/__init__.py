"""Squeezes for grasps of files: joint targets that close the gap and then press, and the forces for which they do."""

from jaxgrasp.squeezing.squeeze_grasps import squeeze_grasps

__all__ = ["squeeze_grasps"]
