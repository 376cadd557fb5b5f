"""Engine `distance`: signed distances and kinematics in JAX, which have derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxgrasp.hands.actuators import Actuators
from jaxgrasp.hands.engines import Geometry
from jaxgrasp.hands.kinematics import Kinematics, Poses, matrices, place
from jaxgrasp.hands.link_contacts import RawPoints
from jaxgrasp.hands.passive import spring_torques
from jaxgrasp.hands.tendons import transmission_of
from jaxgrasp.hands.touching import Points, pair_table, touching_points


class DistanceEngine:
    """Finds contacts of a hand and an object by signed distances."""

    tile = 512
    """Configurations at a time on CPUs."""
    differentiable = True

    def __init__(
        self,
        model: mujoco.MjModel,
        hand: np.ndarray,
        object: np.ndarray,
        joints: np.ndarray,
        actuators: Actuators,
        contact_distance: float,
    ):
        """Finds the pairs of geoms.

        Args:
            model: The scene.
            hand: Bodies of the hand.
            object: Bodies of the object, the one that moves first.
            joints: The hand's joints, hinges and slides.
            actuators: Those that move the hand.
            contact_distance: Up to which points count, m.

        Raises:
            ValueError: A pair of geoms can touch whose distance is not known.
        """
        self._model, self._object, self._joints, self._actuators = model, object, joints, actuators
        self._distance = contact_distance
        self.kinematics = Kinematics(model)
        self.table = pair_table(model, hand, object)

    def find(self, qpos: jax.Array) -> Geometry:
        """What is where in configurations (n, nq)."""
        poses, rotation, centre = self.frames(qpos)
        near, table = self.points(poses), self.table
        reach = np.maximum(self._distance, table.margin).astype(qpos.dtype)
        friction, torsional = (x.astype(qpos.dtype) for x in (table.friction, table.torsional))
        raw = RawPoints(*near, table.link, friction, reach, torsional)
        return self.geometry(qpos, poses, rotation, centre, raw)

    def geometry(
        self, qpos: jax.Array, poses: Poses, rotation: jax.Array, centre: jax.Array, points: RawPoints
    ) -> Geometry:
        """What is where, with points that are known already."""
        axes, anchors = self.of_joints(poses)
        lengths, moments = transmission_of(self._model, self._joints, self._actuators, qpos)
        springs = spring_torques(self._model, self._joints, qpos, jnp)
        return Geometry(points, rotation, centre, anchors, axes, lengths, moments, springs)

    def frames(self, qpos: jax.Array) -> tuple[Poses, jax.Array, jax.Array]:
        """Poses of all bodies, and the object's frame (n, 3, 3) and centre of mass (n, 3), m, world frame."""
        poses = self.kinematics.poses(qpos.T)
        return poses, jnp.moveaxis(poses.rotations[:, :, self._object[0]], -1, 0), self._mass_centre(poses)

    def points(self, poses: Poses) -> Points:
        """All points where geoms touch or come near, (n, slots, ...)."""
        table, model = self.table, self._model
        bodies, offsets = model.geom_bodyid[table.geoms], model.geom_pos[table.geoms].T
        rotations, positions = place(
            poses.rotations[:, :, bodies], poses.positions[:, bodies], offsets, matrices(model.geom_quat[table.geoms])
        )
        return Points(*[jnp.moveaxis(x, -1, 0) for x in touching_points(table, positions, rotations)])

    def of_joints(self, poses: Poses) -> tuple[jax.Array, jax.Array]:
        """Axes and anchors of the hand's joints, (n, joints, 3)."""
        return poses.axes[:, self._joints].T, poses.anchors[:, self._joints].T

    def _mass_centre(self, poses: Poses) -> jax.Array:
        """(n, 3)."""
        bodies = self._object
        # An object that is fixed to the world may have no mass.
        masses = np.maximum(self._model.body_mass[bodies], 1e-12)
        offsets, turns = self._model.body_ipos[bodies].T, np.repeat(np.eye(3)[..., None], len(bodies), -1)
        centres = place(poses.rotations[:, :, bodies], poses.positions[:, bodies], offsets, turns)[1]
        return jnp.einsum("b,ibn->ni", jnp.asarray(masses / masses.sum(), centres.dtype), centres)
