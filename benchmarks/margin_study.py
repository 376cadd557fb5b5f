"""Is the margin true? `python -m benchmarks.margin_study [--quick]`.

Random grasps of the four-finger hand are simulated in C MuJoCo while they are pushed with a share of their margin, and
the share of them that holds is drawn over the push. Writes margin_study.md and margin_study.png beside this file.
"""

from __future__ import annotations

import argparse
import os
import platform
import textwrap
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.progress import Progress
from scipy.stats import binomtest

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.contact.friction import pyramid_facets  # noqa: E402
from jaxgrasp.hands import HandGrasps, sample_configurations  # noqa: E402
from jaxgrasp.simulation import ComputedTorque, JointSprings, Push, Run, Simulator, torque_hand  # noqa: E402
from jaxgrasp.viewer import write_figure  # noqa: E402

OBJECTS = ("sphere", "box", "cylinder", "ellipsoid")
FRICTIONS = (0.4, 0.6, 0.8, 1.0)
GRASPS, QUICK_GRASPS = 75, 25
"""Of each object."""
STRENGTHS = np.arange(9) / 4
SHARE = 0.95
"""Of the margin, for which (22) finds the tightening forces."""
LEAST = 0.2
"""N: grasps with a smaller margin are left out, so that pushes are well above what the simulation resolves."""
BEGIN, PUSHED, AFTER = 0.05, 0.1, 0.1
SLIDING = 1e-3
"""m: with more slip than this a grasp was held by luck."""
STIFFNESS = 2.0
"""N m/rad of every joint."""
OPEN = -0.7
"""rad, where the first flexing joint of a finger that takes no part stands."""
SAFE = 0.9
BOUNDS = np.array([0, 0.25, 0.5, 0.7, 0.9, 1.0, 1.1, 1.3, 1.6, 2.0, np.inf])
DIRECTIONS = np.concatenate([np.eye(3), -np.eye(3)])


@dataclass(frozen=True)
class Arm:
    """One way to tighten and to answer."""

    name: str
    tightened: bool = True
    """By (22); else all fingers press alike, as hard in the mean."""
    joint_compliance: bool = False
    """Whether (21), (22) and the answer are those of Q = J J'/k in place of Q = I."""
    passive: bool = False
    """No feedback: springs in the joints alone."""


ARMS = (
    Arm("f_0 of (22), Q = I"),
    Arm("untightened, Q = I", tightened=False),
    Arm("f_0 of (22), Q = J J'/k", joint_compliance=True),
    Arm("passive, f_0 for Q = I", passive=True),
    Arm("passive, f_0 for Q = J J'/k", joint_compliance=True, passive=True),
)


@dataclass(frozen=True)
class Outcome:
    """Of every simulated push of an arm."""

    push: np.ndarray
    """Over the margin of (21)."""
    directional: np.ndarray
    """Over the largest push in its direction that the forces at rest withstand, with the Q of the answer."""
    other: np.ndarray
    """The same, with Q = I for the answer."""
    held: np.ndarray
    slid: np.ndarray
    stands: np.ndarray
    """Whether the grasp holds without a push."""


def grasps_on(object: str, count: int, seed: int) -> tuple[Simulator, np.ndarray, HandGrasps, np.ndarray]:
    """A simulator, configurations with three or four fingertips on the object, their grasps and friction."""
    sim = Simulator.from_spec(torque_hand(object, gravity=False))
    random = np.random.default_rng(seed)
    qpos = sample_configurations(sim.hand, 12 * count, seed=seed)
    # Every second grasp leaves a finger out.
    for lane in range(0, len(qpos), 2):
        finger = random.integers(4)
        qpos[lane, 3 * finger : 3 * finger + 3] = 0.0, OPEN, 0.0
    friction = random.choice(FRICTIONS, len(qpos))
    grasps = sim.grasps(qpos)
    contacts = replace(grasps.contacts, friction=jnp.broadcast_to(friction[:, None], grasps.contacts.friction.shape))
    found = jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0))
    good = (found.status == jg.Status.SOLVED) & (found.margin > LEAST) & (contacts.active.sum(-1) >= 3)
    chosen = np.flatnonzero(np.asarray(good))
    few = np.asarray(contacts.active.sum(-1))[chosen] == 3
    chosen = np.sort(np.concatenate([chosen[few][: count // 2], chosen[~few][: count - count // 2]]))
    assert len(chosen) == count, f"{object}: {few.sum()} of {len(few)} grasps have three contacts"
    pick = lambda tree: jax.tree.map(lambda x: x[chosen], tree)  # noqa: E731
    return sim, qpos[chosen], replace(pick(grasps), contacts=pick(contacts)), friction[chosen]


def stiff_compliance(grasps: HandGrasps) -> jax.Array:
    """Q = J J'/k, a little of the identity added where joints cannot move a contact."""
    jacobian = grasps.actuation.jacobian
    tall = jacobian.reshape(len(jacobian), -1, jacobian.shape[-1])
    return tall @ jnp.swapaxes(tall, -1, -2) / STIFFNESS + 1e-5 * jnp.eye(tall.shape[1])


def directional(contacts: jg.Contacts, forces: np.ndarray, pushes: np.ndarray, compliance: jax.Array) -> np.ndarray:
    """How often each push (n, k, 6) may act before a facet is reached, starting from forces (n, n_c, 3)."""
    blocking = np.asarray(jg.blocking_forces(contacts, pushes, compliance=compliance))
    facets = np.asarray(pyramid_facets(8))
    rows = facets * np.stack([*[np.ones_like(contacts.friction)] * 2, contacts.friction], -1)[:, :, None]
    reserve = -np.einsum("ncea,nca->nce", rows, forces)[:, None]
    used = np.einsum("ncea,nkca->nkce", rows, blocking)
    active = np.asarray(contacts.active)[:, None, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(active & (used > 1e-9), reserve / used, np.inf)
    return np.maximum(factor.min((-2, -1)), 0)


def run_arm(
    arm: Arm, sim: Simulator, qpos: np.ndarray, grasps: HandGrasps, friction: np.ndarray, seed: int
) -> tuple[Outcome, np.ndarray]:
    """Simulates all grasps and strengths, along a random axis each; also the margins."""
    contacts, unit = grasps.contacts, jg.DisturbanceSet.forces(1.0)
    identity = jnp.broadcast_to(jnp.eye(3 * contacts.n_c), (len(qpos), 3 * contacts.n_c, 3 * contacts.n_c))
    compliance = stiff_compliance(grasps) if arm.joint_compliance else identity
    margin = jg.largest_disturbance(contacts, unit, compliance=compliance).margin
    found = jg.least_effort(contacts, unit, SHARE * margin, compliance=compliance)
    margin, forces = np.asarray(margin), np.asarray(found.forces)
    assert np.all(np.asarray(found.status) == jg.Status.SOLVED)
    active = np.asarray(contacts.active)
    if not arm.tightened:
        mean = forces[..., 2].sum(-1) / active.sum(-1)
        forces = np.zeros_like(forces)
        forces[..., 2] = np.where(active, mean[:, None], 0)
    random = np.random.default_rng(seed)
    shape = (len(qpos), len(STRENGTHS))
    which = random.integers(0, 6, shape)
    # The pushes are along the object's axes, in which the set is given.
    pushes = np.zeros((*shape, 6))
    pushes[..., :3] = DIRECTIONS[which]
    pushes *= (STRENGTHS * margin[:, None])[..., None]
    rest = forces
    if not arm.tightened:
        G = np.asarray(jg.grasp_map(contacts))
        unbalanced = np.einsum("nwa,na->nw", G, forces.reshape(len(G), -1))[:, None]
        rest = forces + np.asarray(jg.blocking_forces(contacts, unbalanced, compliance=compliance))[:, 0]
    answer = stiff_compliance(grasps) if arm.passive else compliance
    factors = [directional(contacts, rest, pushes, Q) for Q in (answer, identity)]
    turned = np.einsum("nij,nkj->nki", np.asarray(grasps.object_rotation), pushes[..., :3])
    repeat = lambda x: np.repeat(np.asarray(x), len(STRENGTHS), 0)  # noqa: E731
    if arm.passive:
        controller = JointSprings(torques=repeat(grasps.actuation.joint_torques(forces)), stiffness=STIFFNESS)
    else:
        controller = ComputedTorque(compliance=repeat(answer))
    wrench = np.concatenate([turned, np.zeros_like(turned)], -1).reshape(-1, 6)
    course: Run = sim.run(
        repeat(qpos), repeat(forces), controller, Push(wrench=wrench, begin=BEGIN, duration=PUSHED),
        BEGIN + PUSHED + AFTER, friction=repeat(friction),
    )  # fmt: skip
    with np.errstate(divide="ignore"):
        over = [(1 / factor).ravel() for factor in factors]
    strength, held = np.broadcast_to(STRENGTHS, shape), ~course.lost.reshape(shape)
    stands = np.broadcast_to(held[:, :1], shape)
    return Outcome(strength.ravel(), *over, held.ravel(), course.worst_slip() > SLIDING, stands.ravel()), margin


def interval(held: int, count: int) -> tuple[float, float]:
    """Wilson's, 95 %."""
    found = binomtest(held, count).proportion_ci(method="wilson")
    return found.low, found.high


def told(held: np.ndarray) -> str:
    """Share in per cent with its interval, and of how many."""
    if len(held) == 0:
        return ""
    low, high = interval(int(held.sum()), len(held))
    return f"{100 * held.mean():.1f} ({100 * low:.1f}-{100 * high:.1f}) of {len(held)}"


def joined(parts: list[Outcome]) -> Outcome:
    return Outcome(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Outcome)))


def below(outcome: Outcome, which: np.ndarray) -> str:
    """Held below 0.9 of the directional margin."""
    return told(outcome.held[(which < SAFE) & (outcome.push > 0) & outcome.stands])


def bins(outcome: Outcome) -> np.ndarray:
    """The place of every push among `BOUNDS`; infinite where the forces at rest already pass a facet."""
    return np.minimum(np.digitize(outcome.directional, BOUNDS) - 1, len(BOUNDS) - 2)


def draw(results: dict[str, Outcome]) -> Figure:
    """Share that holds over the push over the margin, and over the directional margin."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained", dpi=150)
    axes = figure.subplots(1, 2, sharey=True)
    for number, (name, o) in enumerate(results.items()):
        style = {"label": name, "color": f"C{number}", "marker": "o", "ms": 3.5, "lw": 1.2, "capsize": 2}
        _curve(axes[0], o.push, o.held, np.unique(o.push), style)
        middle = np.append((BOUNDS[:-2] + BOUNDS[1:-1]) / 2, BOUNDS[-2] + 0.15)
        counted = o.stands & (o.push > 0)
        _curve(axes[1], middle[bins(o)][counted], o.held[counted], middle, style)
    axes[0].set(xlabel="push / margin of (21)", ylabel="share that holds", ylim=(-0.02, 1.02))
    axes[1].set(xlabel="push / largest push in its direction, given the forces at rest")
    axes[1].axvline(1.0, color="0.7", lw=0.8)
    for panel in axes:
        panel.grid(alpha=0.25)
    axes[0].legend(fontsize=7.5)
    return figure


def _curve(axes: Axes, over: np.ndarray, held: np.ndarray, places: np.ndarray, style: dict) -> None:
    rows = [(x, held[over == x]) for x in places if (over == x).any()]
    share = np.array([h.mean() for _, h in rows])
    spread = np.array([interval(int(h.sum()), len(h)) for _, h in rows]).T
    axes.errorbar([x for x, _ in rows], share, np.abs(spread - share), **style)


def wrapped(words: str) -> str:
    return textwrap.fill(words, 120)


def text(results: dict[str, Outcome], margins: dict[str, np.ndarray], seconds: float) -> str:
    count = sum(map(len, margins.values())) // len(margins)
    lines = [
        "# Is the margin true?",
        "",
        wrapped(
            f"{count} random grasps of the torque-driven four-finger hand, {count // len(OBJECTS)} on each of "
            f"{', '.join(OBJECTS)}, "
            f"half of them with three fingertips and half with four, friction from {min(FRICTIONS)} to "
            f"{max(FRICTIONS)}, no gravity, margins (21) of at least {LEAST} N under six unit forces with at most 2 N "
            f"a finger. In C MuJoCo each is pushed for {PUSHED:g} s by 0 to 2 times its margin along one of six axes, "
            "drawn anew every time. Held: never farther than 1 cm from its place, and all fingers on the object "
            f"{AFTER:g} s after the push. f_0 is "
            "that of "
            f"(22) at {SHARE:g} of the margin; untightened, all fingers press alike, as hard in the mean as f_0. Q "
            f"is the compliance of (21), (22) and the answer; passive hands answer by springs of {STIFFNESS:g} N "
            f"m/rad in their joints alone, whose Q is J J'/k. Shares are in per cent with 95 % intervals (Wilson)."
        ),
        "",
        "| push / margin | " + " | ".join(results) + " |",
        "|---" * (len(results) + 1) + "|",
    ]
    for strength in STRENGTHS:
        row = [told(o.held[o.push == strength]) for o in results.values()]
        lines.append(f"| {strength:g} | " + " | ".join(row) + " |")
    lines.append("| median margin, N | " + " | ".join(f"{np.median(margins[name]):.2f}" for name in results) + " |")
    lines += [
        "",
        wrapped(
            "Over the **directional margin**: the largest push in the same direction that the forces at rest and "
            "the blocking forces of the Q of the answer withstand in the friction pyramid. Grasps that are lost "
            "without any push (first row above) are left out here."
        ),
        "",
        "| push / directional margin | " + " | ".join(results) + " |",
        "|---" * (len(results) + 1) + "|",
    ]
    for place, low in enumerate(BOUNDS[:-1]):
        row = [told(o.held[(bins(o) == place) & o.stands & (o.push > 0)]) for o in results.values()]
        name = f"{low:g} to {BOUNDS[place + 1]:g}" if place + 2 < len(BOUNDS) else f"{low:g} and more"
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    lines.append(f"| all below {SAFE:g} | " + " | ".join(below(o, o.directional) for o in results.values()) + " |")
    lines.append(
        f"| all below {SAFE:g} of that with Q = I | " + " | ".join(below(o, o.other) for o in results.values()) + " |"
    )
    lines += ["", "| held, but a fingertip slid by more than 1 mm | " + " | ".join(
        f"{100 * (o.held & o.slid)[o.push > 0].mean():.1f} %" for o in results.values()) + " |",
        "|---" * (len(results) + 1) + "|"]  # fmt: skip
    lines += [
        "",
        f"{seconds / 60:.1f} min on {platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}, mujoco "
        f"{mujoco.__version__}. Made by `python -m benchmarks.margin_study`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a third of the grasps, and nothing is written")
    quick = parser.parse_args().quick
    begun = time.perf_counter()
    outcomes: dict[str, list[Outcome]] = {arm.name: [] for arm in ARMS}
    margins: dict[str, list[np.ndarray]] = {arm.name: [] for arm in ARMS}
    with Progress() as progress:
        task = progress.add_task("simulating", total=len(OBJECTS) * len(ARMS))
        for seed, object in enumerate(OBJECTS):
            grasps = grasps_on(object, QUICK_GRASPS if quick else GRASPS, seed)
            for arm in ARMS:
                outcome, margin = run_arm(arm, *grasps, seed)
                outcomes[arm.name].append(outcome)
                margins[arm.name].append(margin)
                progress.advance(task)
    results = {name: joined(parts) for name, parts in outcomes.items()}
    found = {name: np.concatenate(parts) for name, parts in margins.items()}
    answer = text(results, found, time.perf_counter() - begun)
    if not quick:
        here = Path(__file__).parent
        (here / "margin_study.md").write_text(answer)
        write_figure(draw(results), here / "margin_study.png")
    print(answer)


if __name__ == "__main__":
    main()
