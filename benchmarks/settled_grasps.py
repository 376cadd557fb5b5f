"""Do joint torques balance contact forces? `python -m benchmarks.settled_grasps [HAND.xml ...]`.

Hands without weight close on objects in C MuJoCo, and are then left alone for 5 s under one command. Then, with
MuJoCo's own contact points and forces, J'f = B u + tau is compared joint by joint: what is missing are damping, M qacc
and contacts of the hand with itself. Writes settled_grasps.md beside this file.
"""

from __future__ import annotations

import argparse
import platform
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np

jax.config.update("jax_enable_x64", True)

from jaxgrasp.hands import HandObject, Scene  # noqa: E402

HANDS = ("four_fingers", "shadow_hand")
OBJECTS = {"sphere": 0.06, "box": 0.055, "capsule": 0.055, "cylinder": 0.055}
"""Widths, m."""
COUNT, CLOSING, SECONDS, STEP = 200, 1.0, 5.0, 2e-3
CLOSED, LEFT = 1e-6, 2e-3
"""N m (N on slides): with everything, and without the three."""
LEAST_FORCE, MOST_DEPTH, AT_REST = 0.05, 1e-3, 0.01
"""N; m, in the beginning; rad/s or m/s, of the fastest joint in the end."""


class Balance(NamedTuple):
    """Of one grasp, torques (joints,)."""

    links: int
    given: np.ndarray
    """J'f."""
    taken: np.ndarray
    """B u + tau."""
    damping: np.ndarray
    inertia: np.ndarray
    """-M qacc."""
    own: np.ndarray
    """Of contacts of the hand with itself."""


class Trial:
    """One hand and one object."""

    def __init__(self, hand: str, object: str, width: float):
        """Builds the scene, without gravity."""
        self.scene = Scene.build(
            hand=hand, object=object, scale=width, mass=0.1, friction=0.8, condim=3, base="fixed", gravity=(0, 0, 0)
        )
        self.model = model = self.scene.model
        model.opt.timestep, model.opt.cone, model.opt.impratio = STEP, mujoco.mjtCone.mjCONE_ELLIPTIC, 10
        # Files for MJX save on these.
        model.opt.iterations, model.opt.ls_iterations = 100, 50
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.hand: HandObject = self.scene.hand_object(contact_distance=0.0, points_per_link=None, unreached="free")
        self.data = mujoco.MjData(model)
        self.joint = model.body(self.hand.object_body).jntadr[0]
        self.free = model.jnt_dofadr[self.joint] + np.arange(6)
        self.places = model.jnt_qposadr[self.hand.joints]
        self.middle = self._middle()

    def _middle(self) -> np.ndarray:
        """Where the outermost links are when the joints are half way, m."""
        model, data = self.model, self.data
        data.qpos[self.places] = model.jnt_range[self.hand.joints].mean(-1)
        mujoco.mj_kinematics(model, data)
        outermost = [b for b in self.hand.touching_links if b not in model.body_parentid]
        return data.xipos[outermost].mean(0)

    def settled(self, rng: np.random.Generator) -> Balance | None:
        """A random grasp at rest; None where fewer than two links hold, or something still moves."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        turn = rng.normal(size=4)
        start = model.jnt_qposadr[self.joint]
        data.qpos[start : start + 7] = np.r_[self.middle + rng.normal(scale=0.01, size=3), turn / np.linalg.norm(turn)]
        mujoco.mj_forward(model, data)
        if (data.contact.dist[self._of_object()] < -MOST_DEPTH).any():
            return None
        data.ctrl[:] = self._command(rng)
        # Something holds the object until the fingers are around it.
        model.dof_damping[self.free] = 100.0
        mujoco.mj_step(model, data, round(CLOSING / STEP))
        model.dof_damping[self.free] = 0.0
        if self._of_object().sum() < 2:
            return None
        mujoco.mj_step(model, data, round(SECONDS / STEP))
        moving = np.abs(data.qvel[self.hand.dofs]).max() > AT_REST
        if moving or any(warning.number for warning in data.warning):
            return None
        exactness = model.opt.tolerance, model.opt.iterations
        model.opt.tolerance, model.opt.iterations = 1e-15, 1000
        mujoco.mj_forward(model, data)
        model.opt.tolerance, model.opt.iterations = exactness
        return self.balance()

    def _command(self, rng: np.random.Generator) -> np.ndarray:
        """Joints that bend to one side close, most of them far; those that bend to both stay near their middle."""
        low, high = self.model.actuator_ctrlrange.T
        share = rng.beta(3, 1.5, len(low))
        share = np.where(-low > 0.4 * high, rng.uniform(0.4, 0.6, len(low)), share)
        return low + share * (high - low)

    def _of_object(self) -> np.ndarray:
        """Which of the contacts are the object's, (contacts,)."""
        return (self.model.geom_bodyid[self.data.contact.geom] == self.hand.object_body).any(-1)

    def balance(self) -> Balance | None:
        """The torques of the state as it is."""
        model, data, hand = self.model, self.data, self.hand
        object = model.geom_bodyid == hand.object_body
        # Ours come the nearest first.
        held = sorted(np.flatnonzero(self._of_object()).tolist(), key=lambda k: data.contact.dist[k])
        grasps = hand.grasps(data.qpos[None])
        actuation, contacts = grasps.actuation, grasps.contacts
        if not held or actuation is None or int(contacts.active.sum()) != len(held):
            return None
        rotation, frames = np.asarray(grasps.object_rotation[0]), np.asarray(contacts.frames[0])
        forces, links = np.zeros((frames.shape[0], 3)), set()
        for slot, k in enumerate(held):
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, k, force)
            contact = data.contact[k]
            # What the first geom does to the second.
            pushed = contact.frame.reshape(3, 3).T @ force[:3] * (1.0 if object[contact.geom[1]] else -1.0)
            forces[slot] = frames[slot].T @ rotation.T @ pushed
            if force[0] > LEAST_FORCE:
                links.add(int(grasps.links[0, slot]))
        if len(links) < 2:
            return None
        dofs, count = hand.dofs, len(hand.actuators)
        low, high = hand.stops(data.qpos[self.places])
        through = np.asarray(actuation.transmission[0])[:, :count]
        kinds = data.efc_type
        stop = self._torques(np.isin(kinds, (mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT,)))[dofs]
        rough = self._torques(np.isin(kinds, (mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF,)))[dofs]
        inertia = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, inertia, data.qacc)
        return Balance(
            links=len(links),
            given=np.einsum("cav,ca->v", np.asarray(actuation.jacobian[0]), forces),
            taken=through @ data.actuator_force[hand.actuators]
            + np.asarray(grasps.spring_torques[0])
            + rough
            + np.where(low, np.maximum(stop, 0), 0)
            + np.where(high, np.minimum(stop, 0), 0),
            damping=data.qfrc_damper[dofs].copy(),
            inertia=-(inertia + data.qfrc_bias)[dofs],
            own=self._torques(self._rows_of_own_contacts())[dofs],
        )

    def _torques(self, rows: np.ndarray) -> np.ndarray:
        """What some of the constraints do to all degrees of freedom."""
        found = np.zeros(self.model.nv)
        mujoco.mj_mulJacTVec(self.model, self.data, found, np.where(rows, self.data.efc_force, 0.0))
        return found

    def _rows_of_own_contacts(self) -> np.ndarray:
        data, contact = self.data, self.data.contact
        rows = np.zeros(data.nefc, bool)
        ours = np.flatnonzero(~self._of_object() & (contact.efc_address >= 0))
        elliptic = self.model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        for k in ours:
            dim, first = int(contact.dim[k]), int(contact.efc_address[k])
            rows[first : first + (dim if elliptic or dim == 1 else 2 * (dim - 1))] = True
        return rows


def study(hand: str, count: int) -> tuple[list[Balance], int]:
    """Settled grasps, as many of every object, and how many were tried."""
    rng = np.random.default_rng(0)
    found, tried = [], 0
    for object, width in OBJECTS.items():
        trial, wanted = Trial(hand, object, width), len(found) + count // len(OBJECTS)
        while len(found) < wanted:
            balance = trial.settled(rng)
            tried += 1
            if balance is not None:
                found.append(balance)
    return found, tried


def row(hand: str, count: int) -> str:
    """One row of the table."""
    found, tried = study(hand, count)
    most = lambda torques: np.array([np.abs(t).max() for t in torques])  # noqa: E731
    left = most([b.given - b.taken for b in found])
    closed = most([b.given - b.taken - b.damping - b.inertia - b.own for b in found])
    sizes = [most([getattr(b, name) for b in found]) for name in ("given", "damping", "inertia", "own")]
    name = Path(hand).parent.name if Path(hand).suffix else hand
    cells = [name, f"{len(found)} of {tried}", f"{np.mean([b.links for b in found]):.1f}", f"{sizes[0].max():.2f}"]
    cells += [f"{closed.max():.1e}", f"{(closed <= CLOSED).mean():.1%}", f"{np.median(left):.1e}"]
    apart = sizes[3] == 0
    cells += [f"{(left <= LEFT).mean():.1%}", f"{(left[apart] <= LEFT).mean():.1%} of {apart.sum()}"]
    cells += [f"{np.quantile(s, 0.95):.1e}" for s in sizes[1:]]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hands", nargs="*", help="more hands, MJCF files")
    parser.add_argument("--count", type=int, default=COUNT, help="grasps of a hand")
    options = parser.parse_args()
    lines = [
        "# Settled grasps",
        "",
        f"condim 3, hands without weight, {SECONDS:g} s after the last command, C MuJoCo {mujoco.__version__} "
        f"({platform.machine()}); at rest means that no joint is faster than {AT_REST:g} rad/s. Largest torque over "
        "the joints of a grasp, N m (N on slides). Made by `python -m benchmarks.settled_grasps`.",
        "",
        "| hand | settled of tried | links | largest J'f | J'f - B u - tau with the three, worst | to 1e-6 | without, "
        "median | to 2e-3 | to 2e-3, no finger on another | damping, 95 % | M qacc, 95 % | self-contact, 95 % |",
        "|" + "---|" * 12,
    ]
    for hand in (*HANDS, *options.hands):
        lines.append(row(hand, options.count))
        print(lines[-1], flush=True)
        Path(__file__).with_suffix(".md").write_text("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
