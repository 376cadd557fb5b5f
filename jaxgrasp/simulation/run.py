"""What a simulated hand is pushed with, and what became of it."""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float

# m.
_LOST = 0.01


@dataclass(frozen=True, kw_only=True)
class Push:
    """A wrench on the object for a while, one a lane."""

    wrench: Float[np.ndarray, "lanes 6"]
    """At the centre of mass, N and N m, world frame."""
    begin: float
    """s."""
    duration: float = 0.1
    """s."""

    def at(self, time: float) -> Float[np.ndarray, "lanes 6"]:
        """The wrench at a time, s."""
        return self.wrench if self.begin <= time < self.begin + self.duration else np.zeros_like(self.wrench)


@dataclass(frozen=True, kw_only=True)
class Run:
    """The course of a batch of simulations; steps lead, contacts are in the order of the fingers."""

    time: Float[np.ndarray, " steps"]
    """s."""
    qpos: Float[np.ndarray, "steps lanes nq"]
    position: Float[np.ndarray, "steps lanes 3"]
    """Of the object's centre of mass from where it began, m, world frame."""
    rotation: Float[np.ndarray, "steps lanes 3"]
    """Rotation vector from how the object began, rad, world frame."""
    wanted: Float[np.ndarray, "steps lanes 6"]
    """Where the object should have been, in the same coordinates."""
    touching: Bool[np.ndarray, "steps lanes contacts"]
    slip: Float[np.ndarray, "steps lanes contacts 2"]
    """How far the fingertip has slid along the object since the beginning, along t1 and t2, m."""
    normal_force: Float[np.ndarray, "steps lanes contacts"]
    """Of fingertip and object in MuJoCo, N, at least 0."""
    tangential_force: Float[np.ndarray, "steps lanes contacts"]
    """N, at least 0."""
    commanded: Float[np.ndarray, "steps lanes contacts 3"]
    """The contact forces that the controller asked for, contact frames, N."""
    engaged: Bool[np.ndarray, "lanes contacts"]
    """Which fingers take part in the grasp."""
    push: Push

    @property
    def error(self) -> tuple[Float[np.ndarray, "steps lanes"], Float[np.ndarray, "steps lanes"]]:
        """Distance, m, and angle, rad, of the object to where it should have been."""
        away = np.linalg.norm(self.position - self.wanted[..., :3], axis=-1)
        return away, np.linalg.norm(self.rotation - self.wanted[..., 3:], axis=-1)

    @property
    def lost(self) -> Bool[np.ndarray, " lanes"]:
        """Where the object went farther than 1 cm from where it should have been, or not all fingers hold it."""
        apart = ~self.touching[-1] & self.engaged
        return (self.error[0] > _LOST).any(0) | apart.any(-1) | ~np.isfinite(self.position).all((0, 2))

    @property
    def peak(self) -> Float[np.ndarray, " lanes"]:
        """Farthest from where the object should have been, m."""
        return self.error[0].max(0)

    def longest_loss(self) -> Float[np.ndarray, " lanes"]:
        """The longest time that a finger had no contact, once the push began, s."""
        counted = self.time >= self.push.begin
        longest = run = np.zeros(self.engaged.shape, int)
        for touching in self.touching[counted]:
            run = np.where(touching | ~self.engaged, 0, run + 1)
            longest = np.maximum(longest, run)
        return longest.max(-1) * (self.time[1] - self.time[0])

    def worst_slip(self) -> Float[np.ndarray, " lanes"]:
        """The farthest that a fingertip has slid since the push began, m."""
        counted = self.time >= self.push.begin
        return np.linalg.norm(self.slip[counted] - self.slip[counted][0], axis=-1).max((0, 2))

    def lanes(self, chosen: slice) -> "Run":
        """The course of some lanes."""
        shorter = {
            each.name: getattr(self, each.name)[:, chosen]
            for each in fields(self)
            if each.name not in ("time", "engaged", "push")
        }
        push = replace(self.push, wrench=self.push.wrench[chosen])
        return Run(time=self.time, engaged=self.engaged[chosen], push=push, **shorter)
