"""Candidate grasps sampled on a built-in object, for trying things without any file."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxgrasp.candidates.candidates import Candidates


@dataclass(frozen=True, kw_only=True)
class Superquadric:
    """A rounded box: the points with |x/a|^p + |y/b|^p + |z/c|^p = 1, its centre of mass at the origin."""

    semi_axes: tuple[float, float, float] = (0.035, 0.025, 0.055)
    """a, b and c, m."""

    exponent: float = 4.0
    """p: 2 is an ellipsoid, larger is boxier."""

    mass: float = 0.25
    """kg."""

    def surface(
        self, directions: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 3"], Float[np.ndarray, "*batch 3"]]:
        """Finds the surface points in the given directions from the centre.

        Args:
            directions: Directions of any length but zero.

        Returns:
            Positions (m) and outward unit normals there.
        """
        scaled = directions / np.array(self.semi_axes)
        radius = (np.abs(scaled) ** self.exponent).sum(-1, keepdims=True) ** (-1.0 / self.exponent)
        positions = directions * radius
        unit = positions / np.array(self.semi_axes)
        gradient = np.sign(unit) * np.abs(unit) ** (self.exponent - 1.0) / np.array(self.semi_axes)
        return positions, gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)


def sample_grasps(
    count: int = 10_000,
    *,
    shape: Superquadric | None = None,
    friction: float = 0.6,
    max_force: float = 10.0,
    spread: float = 0.5,
    seed: int = 0,
) -> Candidates:
    """Samples grasps with a thumb and three fingers that face it across the object.

    The thumb's direction from the centre is uniform on the sphere; those of the three fingers are its opposite plus a
    normally distributed vector of standard deviation `spread` per axis. About two thirds of the default
    ones are force closures.

    Args:
        count: How many.
        shape: The object; the default `Superquadric()` where None.
        friction: Coulomb's coefficient of every contact.
        max_force: Largest normal force of every contact, N.
        spread: How far the fingers scatter.
        seed: Seed of NumPy's default generator: the same seed, the same grasps.

    Returns:
        Candidates with four contacts each and the object's mass.
    """
    shape = shape or Superquadric()
    generator = np.random.default_rng(seed)
    thumb = generator.normal(size=(count, 1, 3))
    thumb /= np.linalg.norm(thumb, axis=-1, keepdims=True)
    fingers = -thumb + spread * generator.normal(size=(count, 3, 3))
    positions, normals = shape.surface(np.concatenate([thumb, fingers], axis=1))
    return Candidates(
        positions=positions,
        outward_normals=normals,
        friction=np.broadcast_to(friction, positions.shape[:2]),
        max_force=np.broadcast_to(max_force, positions.shape[:2]),
        active=np.broadcast_to(True, positions.shape[:2]),
        mass=np.broadcast_to(shape.mass, (count,)),
        columns={"object_name": np.full(count, "superquadric")},
        sources=("superquadric",),
        source=np.zeros(count, dtype=np.int32),
        index=np.arange(count, dtype=np.int64),
    )
