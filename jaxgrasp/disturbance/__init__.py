"""What may happen to the object: sets of disturbance wrenches that answer `support(direction)`."""

from jaxgrasp.disturbance.sets import DisturbanceSet

__all__ = ["DisturbanceSet"]
