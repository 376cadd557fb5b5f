"""Hands from MJCF: contacts from joint angles, and what actuators can do with them, by MuJoCo."""

from jaxgrasp.hands.closing import close_fingers, sample_configurations
from jaxgrasp.hands.grasps import HandGrasps
from jaxgrasp.hands.hand_object import HandObject

__all__ = ["HandGrasps", "HandObject", "close_fingers", "sample_configurations"]
