"""Scenes and hands from MJCF and URDF: contacts from joint angles, and what actuators can do with them, by MuJoCo."""

from jaxgrasp.hands.closing import close_fingers, sample_configurations
from jaxgrasp.hands.grasps import HandGrasps
from jaxgrasp.hands.hand_object import HandObject
from jaxgrasp.hands.scene import Scene

__all__ = ["HandGrasps", "HandObject", "Scene", "close_fingers", "sample_configurations"]
