"""Engine `mujoco`: C MuJoCo's collision, in a pool of threads with one MjData each."""

import copy
import os
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from jaxgrasp.hands.actuators import Actuators
from jaxgrasp.hands.contact_parameters import coulomb, torsion
from jaxgrasp.hands.engines import Geometry
from jaxgrasp.hands.link_contacts import RawPoints


class MujocoEngine:
    """Finds contacts of a hand and an object with C MuJoCo."""

    differentiable = False

    def __init__(
        self,
        model: mujoco.MjModel,
        hand: np.ndarray,
        object: np.ndarray,
        joints: np.ndarray,
        actuators: Actuators,
        contact_distance: float,
    ):
        """Takes a copy of the scene in which the object's geoms have the contact distance as margin, too.

        Args:
            model: The scene.
            hand: Bodies of the hand.
            object: Bodies of the object, the one that moves first.
            joints: The hand's joints, hinges and slides.
            actuators: Those that move the hand.
            contact_distance: Up to which points are wanted, m.
        """
        self._model = model = copy.copy(model)
        self._distance = contact_distance
        self._object, self._joints, self._actuators = object, joints, actuators.numbers
        self._dofs = model.jnt_dofadr[joints]
        self._is_hand, self._is_object = (np.isin(model.geom_bodyid, bodies) for bodies in (hand, object))
        # Margins of the two geoms add up; pairs that are spelt out have their own.
        model.geom_margin[self._is_object] += contact_distance
        model.pair_margin[:] += contact_distance
        model.opt.o_margin += contact_distance
        self._masses = np.maximum(model.body_mass[object], 1e-12)

    def find(self, qpos: np.ndarray) -> Geometry:
        """What is where in configurations (n, nq), which are finite."""
        workers = min(os.cpu_count() or 1, max(1, len(qpos) // 8))
        parts = np.array_split(qpos, workers)
        if workers == 1:
            return _joined([self._chunk(parts[0])])
        with ThreadPoolExecutor(workers) as pool:
            return _joined(list(pool.map(self._chunk, parts)))

    def _chunk(self, qpos: np.ndarray) -> list[list[np.ndarray]]:
        """Rows of configurations, one after the other; MuJoCo's functions leave Python to other threads."""
        model, data = self._model, mujoco.MjData(self._model)
        moment = np.zeros((model.nu, model.nv))
        rows = []
        for row in qpos:
            data.qpos = row
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_tendon(model, data)
            mujoco.mj_collision(model, data)
            mujoco.mj_transmission(model, data)
            mujoco.mj_passive(model, data)
            mujoco.mju_sparse2dense(
                moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
            )
            rows.append([*self._points(data), *self._state(data, moment)])
        return rows

    def _points(self, data: mujoco.MjData) -> list[np.ndarray]:
        """Of hand and object: position, normal, distance, link, friction, reach, torsional friction."""
        contact = data.contact
        geoms = contact.geom
        of_object, of_hand = self._is_object[geoms], self._is_hand[geoms]
        rows = np.flatnonzero(of_object.any(-1) & of_hand.any(-1))
        first = of_object[:, 0]
        first = first[rows]
        link = self._model.geom_bodyid[np.where(first, geoms[rows, 1], geoms[rows, 0])]
        # MuJoCo's normal points from the first geom to the second.
        normal = np.where(first, 1.0, -1.0)[:, None] * contact.frame[rows, :3]
        reach = np.maximum(self._distance, contact.includemargin[rows] - self._distance)
        friction, torsional = (each(contact.friction[rows], contact.dim[rows]) for each in (coulomb, torsion))
        return [contact.pos[rows], normal, contact.dist[rows], link, friction, reach, torsional]

    def _state(self, data: mujoco.MjData, moment: np.ndarray) -> list[np.ndarray]:
        return [
            data.xmat[self._object[0]].reshape(3, 3).copy(),
            self._masses @ data.xipos[self._object] / self._masses.sum(),
            data.xanchor[self._joints],
            data.xaxis[self._joints],
            data.actuator_length[self._actuators],
            moment[np.ix_(self._actuators, self._dofs)].T,
            data.qfrc_spring[self._dofs],
        ]


def _joined(chunks: list[list[list[np.ndarray]]]) -> Geometry:
    """All rows in one; those with fewer points are filled up with none."""
    rows = [row for chunk in chunks for row in chunk]
    columns = list(zip(*rows, strict=True))
    slots = max(1, max(len(distance) for distance in columns[2]))

    def padded(parts: tuple[np.ndarray, ...], filler: float) -> np.ndarray:
        out = np.full((len(parts), slots, *parts[0].shape[1:]), filler, np.result_type(parts[0]))
        for row, part in zip(out, parts, strict=True):
            row[: len(part)] = part
        return out

    fillers = (0, 0, np.inf, 0, 0, 0, 0)
    points = RawPoints(*(padded(parts, filler) for parts, filler in zip(columns[:7], fillers, strict=True)))
    return Geometry(points, *map(np.stack, columns[7:]))
