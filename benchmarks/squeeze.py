"""Whether a simulated hand squeezes as (22) says: `python -m benchmarks.squeeze`.

Grasps of the four-finger hand are ranked by (21); the commands for the tightening forces of the best are given to C
MuJoCo, and the forces between fingers and object at rest are compared with those. Writes squeeze.md beside this file.
"""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from pathlib import Path

import jax
import mujoco
import numpy as np
from jaxtyping import Float

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.hands import HandGrasps, HandObject  # noqa: E402
from jaxgrasp.hands.closing import sample_configurations  # noqa: E402
from jaxgrasp.hands.scenes import four_fingers  # noqa: E402

OBJECTS = ("sphere", "box", "cylinder")
SAMPLES, BEST, SHARE = 1024, 100, 0.75
# Deeper than this, m, a link is inside the object, and the simulation begins with a blow.
DEEPEST = 5e-4
SECONDS = 1.0
FINGERS = 4
# Farther than this, m, from where it began the object was lost.
LOST = 0.02
SERVOS, REST = "servos move", "the rest: contacts move, fingers turn"
LIGHT, HARD = "fingers without weight", "the same, contacts four times as hard"
QUANTILES = (0.25, 0.5, 0.75, 0.9, 0.99, 1.0)


@dataclass(frozen=True)
class Wanted:
    """Tightening forces of grasps, by finger in the object's frame, and the commands for them."""

    qpos: Float[np.ndarray, "n nq"]
    controls: Float[np.ndarray, "n actuators"]
    efforts: Float[np.ndarray, "n actuators"]
    forces: Float[np.ndarray, "n fingers 3"]
    normal: Float[np.ndarray, "n fingers"]
    contacts: Float[np.ndarray, "n fingers"]
    apart: Float[np.ndarray, " n"]
    """The farthest of the contacts that count, m; above 0 where one does not touch yet."""
    inverse: Float[np.ndarray, "n fingers 3 joints"]
    """What joint torques do to the force of a finger that has one contact, 1/m; of no meaning for others."""


@dataclass(frozen=True)
class Squeezed:
    """What the simulation has come to."""

    forces: Float[np.ndarray, "n fingers 3"]
    normal: Float[np.ndarray, "n fingers"]
    efforts: Float[np.ndarray, "n actuators"]
    weight: Float[np.ndarray, "n dofs"]
    """What gravity does to the hand's joints in the beginning, N m, with MuJoCo's sign of `qfrc_bias`."""
    moved: Float[np.ndarray, " n"]
    """How far the object went, m."""
    turned: Float[np.ndarray, " n"]
    """rad."""
    speed: Float[np.ndarray, " n"]
    """Fastest joint in the end, rad/s."""


def finger_of(model: mujoco.MjModel) -> np.ndarray:
    """(bodies,), from 0; -1 for bodies of no finger."""
    names = [model.body(b).name for b in range(model.nbody)]
    return np.array([int(n[1]) - 1 if n.startswith("f") and n[1].isdigit() else -1 for n in names])


def wanted(hand: HandObject, qpos: np.ndarray, grasps: HandGrasps, solution: jg.Solution) -> Wanted:
    """Sums the forces of the contacts of each finger."""
    finger = finger_of(hand.model)[np.asarray(grasps.links)]
    active = np.asarray(grasps.contacts.active)
    of = (finger[..., None] == np.arange(FINGERS)) & active[..., None]
    total = lambda values: np.einsum("ncf,nc...->nf...", of.astype(float), values)  # noqa: E731
    first = of.argmax(1)
    turned = np.einsum("ncab,ncbv->ncav", np.asarray(grasps.contacts.frames), np.asarray(grasps.actuation.jacobian))
    jacobian = np.take_along_axis(turned, first[..., None, None], 1)
    return Wanted(
        qpos=qpos,
        controls=np.asarray(hand.controls(grasps, solution.actuator_efforts)),
        efforts=np.asarray(solution.actuator_efforts),
        forces=total(np.asarray(solution.forces_in_object_frame(grasps.contacts))),
        normal=-total(np.asarray(solution.forces)[..., 2]),
        contacts=of.sum(1),
        apart=np.where(active, np.asarray(grasps.distances), -np.inf).max(1),
        inverse=np.linalg.pinv(np.swapaxes(jacobian, -1, -2)),
    )


def squeeze(model: mujoco.MjModel, goal: Wanted, seconds: float = SECONDS) -> Squeezed:
    """Simulates every grasp from rest under its commands."""
    data, body, finger = mujoco.MjData(model), model.body("object").id, finger_of(model)
    hand = np.flatnonzero(finger[model.dof_bodyid] >= 0)
    rows = []
    for qpos, controls in zip(goal.qpos, goal.controls, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.ctrl[:] = qpos, controls
        mujoco.mj_forward(model, data)
        weight = data.qfrc_bias[hand] - data.qfrc_gravcomp[hand]
        position, rotation = data.xipos[body].copy(), data.xmat[body].reshape(3, 3).copy()
        mujoco.mj_step(model, data, nstep=round(seconds / model.opt.timestep))
        mujoco.mj_forward(model, data)
        forces, normal = finger_forces(model, data, body, finger)
        turn = rotation.T @ data.xmat[body].reshape(3, 3)
        rows.append(
            (
                forces,
                normal,
                data.actuator_force.copy(),
                weight,
                np.linalg.norm(data.xipos[body] - position),
                np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)),
                np.abs(data.qvel[hand]).max(),
            )
        )
    return Squeezed(*map(np.array, zip(*rows, strict=True)))


def finger_forces(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, finger: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Forces of the fingers on a body in its frame (fingers, 3), and the sums of their normal parts."""
    forces, normal, wrench = np.zeros((FINGERS, 3)), np.zeros(FINGERS), np.zeros(6)
    for number, contact in enumerate(data.contact):
        bodies = model.geom_bodyid[contact.geom]
        if body not in bodies:
            continue
        other = finger[bodies[0] if bodies[1] == body else bodies[1]]
        if other < 0:
            continue
        mujoco.mj_contactForce(model, data, number, wrench)
        # MuJoCo's is the force of the first geom on the second, in a frame of rows.
        force = contact.frame.reshape(3, 3).T @ wrench[:3]
        forces[other] += data.xmat[body].reshape(3, 3).T @ (force if bodies[1] == body else -force)
        normal[other] += wrench[0]
    return forces, normal


def errors(goal: Wanted, found: Squeezed) -> tuple[np.ndarray, np.ndarray]:
    """|f - f_0| / |f_0|, and |n - n_0| / n_0 of the normal parts, (n, fingers); inf where f_0 leaves a finger out."""
    size = np.linalg.norm(goal.forces, axis=-1)
    vector = np.linalg.norm(found.forces - goal.forces, axis=-1)
    with np.errstate(divide="ignore"):
        return vector / size, np.abs(found.normal - goal.normal) / goal.normal


def parts(goal: Wanted, found: Squeezed) -> dict[str, np.ndarray]:
    """Why f is not f_0, as shares of |f_0|, (n, fingers); for fingers that have one contact."""
    change = found.forces - goal.forces
    by_torque = lambda torque: np.einsum("nfav,nv->nfa", goal.inverse, torque)  # noqa: E731
    servo, weight = by_torque(found.efforts - goal.efforts), by_torque(-found.weight)
    share = lambda force: np.linalg.norm(force, axis=-1) / np.linalg.norm(goal.forces, axis=-1)  # noqa: E731
    return {
        SERVOS: share(servo),
        "the fingers' weight": share(weight),
        REST: share(change - servo - weight),
    }


def tightened(object: str) -> tuple[mujoco.MjSpec, Wanted, dict]:
    """The best candidates on an object, and how they were found."""
    spec = four_fingers(object)
    hand = HandObject.from_mjcf(spec, "object", contact_distance=1e-3)
    qpos = sample_configurations(hand, SAMPLES)
    grasps = hand.grasps(qpos)
    pushes = jg.DisturbanceSet.forces(1.0)
    given = {"disturbances": pushes, "required_wrench": grasps.required_wrench, "actuation": grasps.actuation}
    first = jg.largest_disturbance(grasps.contacts, **given)
    # One program for all: (22) of what is not among the best is thrown away.
    second = jg.least_effort(grasps.contacts, margin=SHARE * np.maximum(first.margin, 0), **given)
    margin = np.where(np.asarray(second.status) == jg.Status.SOLVED, first.margin, -np.inf)
    clear = np.asarray(grasps.penetration) <= DEEPEST
    best = np.argsort(np.where(clear, -margin, np.inf), kind="stable")[:BEST]
    assert np.all(np.isfinite(margin[best])), "fewer candidates than wanted"
    told = {
        "inside": int(np.sum(~clear & (margin >= margin[best[-1]]))),
        "margins": (margin[best[0]], margin[best[-1]]),
    }
    take = jax.tree.map(lambda x: np.asarray(x)[best], (grasps, second))
    return spec, wanted(hand, qpos[best], *take), told


def variants(spec: mujoco.MjSpec) -> dict[str, mujoco.MjModel]:
    """The scene as it is, and changed to find out what its settings do."""
    light, hard = spec.copy(), spec.copy()
    for body in (*light.bodies, *hard.bodies):
        if body.name not in ("world", "object"):
            body.gravcomp = 1.0
    for geom in hard.geoms:
        geom.solref = (0.0025, 1.0)
    hard.option.timestep = 5e-4
    return {"as it is": spec.compile(), LIGHT: light.compile(), HARD: hard.compile()}


def measure(object: str) -> dict:
    spec, goal, told = tightened(object)
    result = {
        "told": told,
        "size": np.linalg.norm(goal.forces, axis=-1),
        "single": goal.contacts == 1,
        "touch": goal.apart <= 0,
    }
    for name, model in variants(spec).items():
        found = squeeze(model, goal)
        vector, normal = errors(goal, found)
        result[name] = {"vector": vector, "normal": normal, "parts": parts(goal, found), "found": found}
    return result


def quantiles(values: np.ndarray, counted: np.ndarray | None = None) -> str:
    values = values.ravel() if counted is None else values[counted]
    return " | ".join(f"{100 * v:.1f}" for v in np.quantile(values, QUANTILES)) if values.size else "| | | | |"


def text(results: dict[str, dict]) -> str:
    header = ["| 25 % | median | 75 % | 90 % | 99 % | worst |", "|---|---|---|---|---|---|---|---|"]
    lines = [
        "# Whether a simulated hand squeezes as (22) says",
        "",
        f"{BEST} grasps of the four-finger hand for each object, the best by (21) of {SAMPLES} random ones: six unit",
        "forces, the object's weight borne, efforts of the actuators limited. The tightening forces f_0 of (22) are",
        f"those at {SHARE:.0%} of the margin. C MuJoCo begins with the configuration at rest and is given the commands",
        f"of `HandObject.controls` at once; after {SECONDS:g} s, with gravity, the contact forces on the object are",
        "summed by finger, in the object's frame, and compared with f_0. Errors are |f - f_0| / |f_0| of each finger,",
        "in per cent; those of normal forces are relative to the normal part of f_0.",
        "",
        f"| object, {BEST * FINGERS} fingers | error of " + header[0],
        header[1],
    ]
    for name, r in results.items():
        lines.append(f"| {name} | f | {quantiles(r['as it is']['vector'])} |")
        lines.append(f"| {name} | normal part | {quantiles(r['as it is']['normal'])} |")
    lines += ["", "What the grasps were, and what became of them:", ""]
    lines += [
        "| object | margins, N | passed over: a link inside | median \\|f_0\\|, N | moved, mm: median, worst "
        "| turned, degrees: median, worst | lost | fastest joint in the end, rad/s: median, worst |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, r in results.items():
        found: Squeezed = r["as it is"]["found"]
        two = lambda x, digits: f"{np.median(x):.{digits}f}, {x.max():.{digits}f}"  # noqa: E731
        low, high = r["told"]["margins"][::-1]
        lines.append(
            f"| {name} | {low:.2f} to {high:.2f} | {r['told']['inside']} | {np.median(r['size']):.2f} "
            f"| {two(1e3 * found.moved, 2)} | {two(np.degrees(found.turned), 2)} | {np.sum(found.moved > LOST)} "
            f"| {two(found.speed, 4)} |"
        )
    lines += [
        "",
        "## Where the errors come from",
        "",
        "The same grasps with other settings of the simulation, then parts of the error of fingers with one contact,",
        "for which J'f = u has one answer, each as a share of |f_0| in per cent. A servo that gives way by the angle",
        "dq pushes by k_p dq more, one that goes on by dq so much less; the fingers' weight is not in J'f = B u.",
        "",
        "What moves the servos is that soft contacts give way, by another depth than the 0.1 mm at which the",
        "simulation begins. Along the line to a finger's joints forces have lever arms of a few millimetres: there",
        "k_p dq is a large force, tangential where the finger stands upright on the object. A part of the tail belongs",
        "to contacts within 1 mm of the object that do not touch: they count, so (21) and (22) load them, the",
        "simulated finger does not have them, and the whole grasp shifts until its servos balance it.",
        "",
        "| object | | " + header[0][2:],
        header[1],
    ]
    for name, r in results.items():
        for variant in (LIGHT, HARD):
            lines.append(f"| {name} | {variant} | {quantiles(r[variant]['vector'])} |")
            moved = quantiles(r[variant]["parts"][SERVOS], r["single"])
            lines.append(f"| {name} | {variant}, one contact: {SERVOS} | {moved} |")
        touching = r["touch"][:, None] & np.ones_like(r["single"])
        kinds = {
            "of grasps that touch with all contacts": touching,
            "of grasps with a contact within 1 mm that does not": ~touching,
            "with one contact": r["single"],
            "with several contacts": ~r["single"],
        }
        for kind, counted in kinds.items():
            lines.append(f"| {name} | {counted.sum()} fingers {kind} | {quantiles(r['as it is']['vector'], counted)} |")
        for part, values in r["as it is"]["parts"].items():
            lines.append(f"| {name} | one contact: {part} | {quantiles(values, r['single'])} |")
    lines += [
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}, jax {jax.__version__}, mujoco "
        f"{mujoco.__version__}, float64. Made by `python -m benchmarks.squeeze`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    results = {}
    for object in OBJECTS:
        results[object] = measure(object)
        print(object, quantiles(results[object]["as it is"]["vector"]), flush=True)
    answer = text(results)
    (Path(__file__).parent / "squeeze.md").write_text(answer)
    print(answer)


if __name__ == "__main__":
    main()
