"""The four-finger hand with torque-driven joints in C MuJoCo, many experiments at once."""

import os
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as File

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from jaxgrasp.hands import HandGrasps, HandObject, close_fingers
from jaxgrasp.hands.scenes import four_fingers
from jaxgrasp.simulation.control import Controller, Goal, Impedance, Wanted, goal_of
from jaxgrasp.simulation.path import Path
from jaxgrasp.simulation.run import Push, Run
from jaxgrasp.simulation.state import State, by_finger, measure

_FINGERS = 4
# rad: base, flex1 and flex2 of a finger whose tip presses on a ball of 25 mm in the scene's place from the side.
_BENT = (0.0, -0.165, 1.124)
# No path that begins anew takes less than this, s.
_SHORTEST = 0.2
_GIVEN = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
# What a contact sensor reports: whether there is a contact, and its force.
_FOUND_AND_FORCE, _NEAREST = 1 | 2, 1


def torque_hand(
    object: str | File = "sphere",
    size: float | None = None,
    *,
    friction: float = 0.8,
    mass: float = 0.1,
    gravity: bool = True,
) -> mujoco.MjSpec:
    """The scene of `hands.scenes.four_fingers` with motors in place of servos, whose fingertips alone touch.

    Args:
        object: As in `four_fingers`.
        size: As in `four_fingers`, m.
        friction: Coulomb's coefficient of the object.
        mass: Of the object, kg.
        gravity: Whether there is any, along -z.

    Returns:
        The specification, with a sensor of the contact of every fingertip.
    """
    spec = four_fingers(object, size)
    ball = spec.geom("object")
    ball.friction[0], ball.mass = friction, mass
    if not gravity:
        spec.option.gravity = np.zeros(3)
    for actuator in spec.actuators:
        actuator.set_to_motor()
        actuator.ctrllimited, actuator.inheritrange = False, 0.0
    for geom in spec.geoms:
        if geom.name != "object" and not geom.name.endswith("_tip"):
            geom.contype = geom.conaffinity = 0
    for finger in range(1, _FINGERS + 1):
        spec.add_sensor(
            name=f"f{finger}_contact",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=f"f{finger}_tip",
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname="object",
            intprm=[_FOUND_AND_FORCE, _NEAREST, 1],
        )
    return spec


@dataclass(frozen=True, eq=False)
class Simulator:
    """The hand of `torque_hand` with one object."""

    hand: HandObject

    @classmethod
    def from_spec(cls, spec: mujoco.MjSpec, max_force: float = 2.0) -> "Simulator":
        """A simulator of a scene that `torque_hand` has made.

        Args:
            spec: The scene.
            max_force: Largest normal force that tightening forces may have, N.
        """
        return cls(HandObject.from_mjcf(spec, "object", max_contacts=_FINGERS, max_force=max_force))

    @cached_property
    def around(self) -> Float[np.ndarray, " nq"]:
        """The fingers closed around the object where the scene has it, their tips as high as its middle."""
        qpos = self.hand.model.qpos0.copy()
        qpos[: 3 * _FINGERS] = np.tile(_BENT, _FINGERS)
        return np.asarray(close_fingers(self.hand, qpos))

    def grasps(self, qpos: Float[np.ndarray, "lanes nq"]) -> HandGrasps:
        """Grasps with the contacts in the order of the fingers."""
        return by_finger(self.hand.grasps(qpos))

    def run(
        self,
        qpos: Float[np.ndarray, "lanes nq"],
        tightening: Float[np.ndarray, "lanes contacts 3"],
        controller: Controller,
        push: Push,
        seconds: float,
        *,
        impedance: Impedance | None = None,
        path: Path | None = None,
        friction: Float[np.ndarray, " lanes"] | None = None,
        replan: tuple[float, float] | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> Run:
        """Simulates all lanes at once, from rest.

        Args:
            qpos: Where they begin.
            tightening: f_0 in contact frames, N, in the order of the fingers; fingers with f_0 = 0 take no part.
            controller: What computes torques from what is measured, every step of 1 ms.
            push: What disturbs the object.
            seconds: How long.
            impedance: Of the object, for controllers that feed it back; None is `Impedance()`.
            path: The object's desired motion; None keeps it where it begins.
            friction: Of the object in each lane; None is the scene's.
            replan: A distance, m, and a time, s: once the object is farther than this from where it should be, and so
                much time has passed, its path begins anew where it then is, as fast as it should then be, and ends
                where and when it should have.
            progress: Called with the number of steps done.

        Returns:
            The course of all lanes.

        Raises:
            ValueError: Shapes that do not fit, or configurations, forces or friction that are no finite numbers.
        """
        qpos, tightening, model = np.asarray(qpos, float), np.asarray(tightening, float), self.hand.model
        lanes = len(qpos)
        path = Path.rest(lanes) if path is None else path
        impedance = Impedance() if impedance is None else impedance
        given = {"qpos": qpos, "tightening": tightening, "push": push.wrench, "path": path.coefficients}
        _check(model, lanes, given | ({} if friction is None else {"friction": np.asarray(friction, float)}))
        begun = self.grasps(qpos)
        origin, turned = np.asarray(begun.object_position), np.asarray(begun.object_rotation)
        engaged, forces = np.any(tightening != 0, -1), tightening.reshape(lanes, -1)
        state = np.zeros((lanes, mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))))
        state[:, 1 : 1 + model.nq] = qpos
        controls = np.zeros((lanes, 1, model.nu + 6 * model.nbody))
        wrench = model.nu + 6 * self.hand.object_body + np.arange(6)
        posture = qpos[:, model.jnt_qposadr[self.hand.joints]]
        replanning = None if replan is None else _Replanning(lanes, *replan)
        course: list[tuple] = []
        models, step = self._models(friction, lanes), model.opt.timestep
        with rollout.Rollout(nthread=len(self._data)) as pool:
            for number in range(round(seconds / step)):
                time = number * step
                place, speed, rate = path.at(time)
                wanted = Wanted(origin + place[:, :3], _rotations(place[:, 3:]) @ turned, speed, rate)
                now, moving = state[:, 1 : 1 + model.nq].copy(), state[:, 1 + model.nq : 1 + model.nq + model.nv]
                measured, goal, along = self._measured(impedance, now, moving, wanted, forces, posture, engaged)
                torque, commanded = _answered(controller, measured, goal)
                measured, torque, commanded = jax.tree.map(np.asarray, (measured, torque, commanded))
                posture = posture + step * np.asarray(along)
                controls[:, 0, : model.nu], controls[:, 0, wrench] = torque, push.at(time)
                states, sensed = pool.rollout(models, self._data, state, controls, control_spec=_GIVEN)
                state = states[:, 0]
                there = np.concatenate(
                    [measured.position - origin, _rotation_vectors(measured.rotation @ turned.swapaxes(-1, -2))], -1
                )
                course.append((time, now, there, place, measured.sliding, sensed[:, 0], commanded))
                if replanning is not None:
                    path = replanning.path(path, time, there, place, speed)
                if progress is not None:
                    progress(number + 1)
        time, qpos, there, place, sliding, sensed, commanded = map(np.array, zip(*course, strict=True))
        sensed = sensed.reshape(*sensed.shape[:2], _FINGERS, 4)
        return Run(
            time=time,
            qpos=qpos,
            position=there[..., :3],
            rotation=there[..., 3:],
            wanted=place,
            touching=sensed[..., 0] > 0,
            slip=np.cumsum(sliding * (sensed[..., :1] > 0), 0) * step,
            normal_force=np.abs(sensed[..., 1]),
            tangential_force=np.linalg.norm(sensed[..., 2:], axis=-1),
            commanded=commanded.reshape(*sliding.shape[:-1], 3),
            engaged=engaged,
            push=push,
        )

    @cached_property
    def _data(self) -> list[mujoco.MjData]:
        return [mujoco.MjData(self.hand.model) for _ in range(os.cpu_count() or 1)]

    def _models(self, friction: np.ndarray | None, lanes: int) -> list[mujoco.MjModel]:
        if friction is None:
            return [self.hand.model] * lanes
        geom, known = self.hand.model.geom("object").id, {}
        for value in np.unique(friction):
            known[value] = copy(self.hand.model)
            known[value].geom_friction[geom, 0] = value
        return [known[value] for value in friction]

    @cached_property
    def _measured(self) -> Callable[..., tuple[State, Goal, jax.Array]]:
        limit = self.hand.model.actuator_forcerange[:, 1]

        @jax.jit
        def measured(impedance, qpos, qvel, wanted, tightening, posture, engaged):
            state = measure(self.hand, qpos, qvel, engaged)
            return state, *goal_of(impedance, state, wanted, tightening, posture, limit)

        return measured


class _Replanning:
    """Gives each lane a new path once, a while after its object was found too far from the old one."""

    def __init__(self, lanes: int, distance: float, delay: float):
        self._distance, self._delay = distance, delay
        self._seen, self._done = np.full(lanes, np.inf), np.zeros(lanes, bool)

    def path(self, path: Path, time: float, there: np.ndarray, place: np.ndarray, speed: np.ndarray) -> Path:
        """The path from now on; there, place and speed are where the object is and should be, and how fast."""
        far = np.linalg.norm(there[:, :3] - place[:, :3], axis=-1) > self._distance
        self._seen = np.where(far & np.isinf(self._seen), time, self._seen)
        due = (time >= self._seen + self._delay) & ~self._done
        self._done |= due
        if not due.any():
            return path
        end = np.maximum(path.begin + path.duration, time + _SHORTEST)
        return path.replaced(due, Path.to(path.goal, np.full(len(due), time), end, there, speed))


def _check(model: mujoco.MjModel, lanes: int, given: dict[str, np.ndarray]) -> None:
    shapes = {
        "qpos": (lanes, model.nq),
        "tightening": (lanes, _FINGERS, 3),
        "push": (lanes, 6),
        "path": (lanes, 6, 6),
        "friction": (lanes,),
    }
    for name, array in given.items():
        if np.shape(array) != shapes[name]:
            raise ValueError(f"{name}: got shape {np.shape(array)}, wanted {shapes[name]}, one row a lane")
        wrong = ~np.isfinite(array).reshape(lanes, -1).all(-1)
        if name == "friction":
            wrong |= ~(array > 0)
        if wrong.any():
            hint = " (forces are NaN where (22) has no answer: leave these grasps out)" if name == "tightening" else ""
            wanted = "positive numbers" if name == "friction" else "finite numbers"
            raise ValueError(f"{name}: lanes {np.flatnonzero(wrong)[:5].tolist()} are not {wanted}{hint}")


@jax.jit
def _answered(controller: Controller, state: State, goal: Goal) -> tuple[jax.Array, jax.Array]:
    # A program of its own: with the measurement in one, jaxlib 0.10 deadlocks on CPUs with two threads, and controllers
    # would each compile it anew.
    torques, forces = controller(state, goal)
    return jnp.clip(torques, -goal.limit, goal.limit), forces


def _rotations(vectors: Float[np.ndarray, "lanes 3"]) -> Float[np.ndarray, "lanes 3 3"]:
    """Of rotation vectors, by Rodrigues' formula."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    skew = np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    # np.sinc has pi in it.
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (skew @ skew)


def _rotation_vectors(rotations: Float[np.ndarray, "lanes 3 3"]) -> Float[np.ndarray, "lanes 3"]:
    """The inverse, for angles below 180 degrees."""
    skew = 0.5 * (rotations - rotations.swapaxes(-1, -2))
    axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotations, axis1=-2, axis2=-1) - 1))
    return axis * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 1)[:, None]
