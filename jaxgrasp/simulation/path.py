"""Where the object shall be: polynomials of the fifth degree in time, one a lane."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Rows: what a polynomial c_0 + c_1 s + ... + c_5 s^5 has as value, slope and curvature at 0, then at 1.
_ENDS = np.array(
    [
        [1, 0, 0, 0, 0, 0],
        [0, 1, 0, 0, 0, 0],
        [0, 0, 2, 0, 0, 0],
        [1, 1, 1, 1, 1, 1],
        [0, 1, 2, 3, 4, 5],
        [0, 0, 2, 6, 12, 20],
    ],
    float,
)


@dataclass(frozen=True, kw_only=True)
class Path:
    """A desired motion of the object, from rest or on the way, to rest.

    Its six coordinates are the displacement of the centre of mass (m, world frame) and the rotation vector (rad, world
    frame) from the pose in which the object began.
    """

    begin: Float[np.ndarray, " lanes"]
    """When the motion begins, s; before, the object stays at its first point."""
    duration: Float[np.ndarray, " lanes"]
    """s; afterwards the object rests at the last point."""
    coefficients: Float[np.ndarray, "lanes 6 6"]
    """Of the powers of the share of the duration that has passed, (powers, coordinates)."""

    @classmethod
    def rest(cls, lanes: int) -> "Path":
        """The object shall stay where it is."""
        return cls(begin=np.zeros(lanes), duration=np.ones(lanes), coefficients=np.zeros((lanes, 6, 6)))

    @classmethod
    def to(
        cls,
        goal: Float[np.ndarray, "lanes 6"],
        begin: Float[np.ndarray, " lanes"],
        end: Float[np.ndarray, " lanes"],
        start: Float[np.ndarray, "lanes 6"] | None = None,
        velocity: Float[np.ndarray, "lanes 6"] | None = None,
    ) -> "Path":
        """The smoothest motion to a goal: the integral of the squared jerk is least.

        Args:
            goal: Where the object comes to rest.
            begin: s.
            end: s.
            start: Where it begins; None is where the object began.
            velocity: With which it begins, m/s and rad/s; None is at rest. Its acceleration is zero there.
        """
        goal, begin, duration = np.asarray(goal, float), np.asarray(begin, float), np.subtract(end, begin)
        ends = np.zeros((len(goal), 6, 6))
        ends[:, 3] = goal
        if start is not None:
            ends[:, 0] = start
        if velocity is not None:
            ends[:, 1] = velocity * duration[:, None]
        return cls(begin=begin, duration=duration, coefficients=np.linalg.solve(_ENDS, ends))

    @property
    def goal(self) -> Float[np.ndarray, "lanes 6"]:
        """Where it ends."""
        return self.coefficients.sum(1)

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates, velocity and acceleration (lanes, 6) at a time, s."""
        share = (time - self.begin) / self.duration
        inside = np.clip(share, 0, 1)[:, None, None]
        powers, exponents = np.arange(6)[:, None], np.arange(6)[:, None]
        value = (self.coefficients * inside**powers).sum(1)
        slope = (self.coefficients * exponents * inside ** np.maximum(powers - 1, 0)).sum(1)
        curvature = (self.coefficients * exponents * (exponents - 1) * inside ** np.maximum(powers - 2, 0)).sum(1)
        moving = ((share >= 0) & (share <= 1))[:, None]
        duration = self.duration[:, None]
        return value, np.where(moving, slope / duration, 0), np.where(moving, curvature / duration**2, 0)

    def replaced(self, lanes: np.ndarray, other: "Path") -> "Path":
        """This path with that of some lanes exchanged.

        Args:
            lanes: (lanes,), bool: which.
            other: The path to take there, for all lanes.
        """
        return Path(
            begin=np.where(lanes, other.begin, self.begin),
            duration=np.where(lanes, other.duration, self.duration),
            coefficients=np.where(lanes[:, None, None], other.coefficients, self.coefficients),
        )
