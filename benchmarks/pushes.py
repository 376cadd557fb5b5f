"""The pushes of section V, as printed and beside it, over the weight w and f_0's share: `python -m benchmarks.pushes`.

The four-finger hand of the examples in C MuJoCo, both controllers, and what bounding |f| in place of |f_n| changes.
Writes pushes.md beside this file.
"""

from __future__ import annotations

import argparse
import os
import platform
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path as File

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich.progress import Progress

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import chain  # noqa: E402
from benchmarks.suite.unreduced import quartiles  # noqa: E402
from jaxgrasp.simulation import ComputedTorque, ForceOptimization, Path, Push, Run, Simulator, torque_hand  # noqa: E402

WEIGHTS = (0.05, 0.06, 0.07, 0.08, 0.1, 0.15, 0.2, 0.5, 1.0, 10.0)
SHARES = (0.75, 0.76, 0.77, 0.78, 0.79, 0.8, 0.85, 0.9)
QUICK = (0.1, 1.0)
PUSH = 0.75
"""The force of a push, as a share of lambda."""
FRICTION, MAX_FORCE = 0.8, 2.0
BASELINE = np.tile([0.0, 0.0, -0.5], (4, 1))
AT_REST, CARRIED = 0.4, 4.0
"""Seconds that are simulated."""


@dataclass(frozen=True)
class Case:
    """A row of a table: what the fingers press with, and the controller."""

    name: str
    tightening: np.ndarray
    w: float | None = None
    """None is computed torque."""
    force: float = 0.0
    """The force of the push, N; only for `in_motion`."""
    replan: tuple[float, float] | None = None
    """The distance off the path, m, and the time, s, after which it begins anew, as in `Simulator.run`."""


def plan(sim: Simulator, share: float, required_wrench: jax.Array | None = None) -> tuple[float, np.ndarray]:
    """lambda of (21), N, and f_0 of (22) at a share of it."""
    contacts, unit = sim.grasps(sim.around[None]).contacts, jg.DisturbanceSet.forces(1.0)
    largest = jg.largest_disturbance(contacts, unit, required_wrench=required_wrench)
    hold = jg.least_effort(contacts, unit, share * largest.margin, required_wrench=required_wrench)
    return float(largest.margin[0]), np.asarray(hold.forces[0])


def controller(cases: list[Case], lanes: int) -> ComputedTorque | ForceOptimization:
    """That of cases that all have one, or none; each has some lanes."""
    if cases[0].w is None:
        return ComputedTorque()
    weights = jnp.repeat(jnp.array([case.w for case in cases]), lanes)
    return ForceOptimization(weight=weights, friction=jnp.full_like(weights, FRICTION))


def at_rest(sim: Simulator, cases: list[Case], margin: float, progress: Progress) -> dict[str, Run]:
    """V-A: six pushes of each case."""
    directions = np.stack([sign * axis for axis in np.eye(6)[:3] for sign in (1, -1)])
    push = Push(wrench=np.tile(PUSH * margin * directions, (len(cases), 1)), begin=0.1)
    forces = np.repeat([case.tightening for case in cases], 6, 0)
    start = np.tile(sim.around, (len(forces), 1))
    task = progress.add_task(f"{len(forces)} pushes at rest", total=round(1e3 * AT_REST))
    seen = lambda step: progress.update(task, completed=step)  # noqa: E731
    run = sim.run(start, forces, controller(cases, 6), push, AT_REST, progress=seen)
    return {case.name: run.lanes(slice(6 * k, 6 * k + 6)) for k, case in enumerate(cases)}


def in_motion(sim: Simulator, cases: list[Case], progress: Progress) -> dict[str, Run]:
    """V-B: each case pushed and not; all with the same `replan`."""
    lanes = 2 * len(cases)
    wrench = np.zeros((lanes, 6))
    wrench[::2, 0] = [case.force for case in cases]
    goal = np.tile([0.0, -0.02, 0.0, 0.0, 0.0, 0.0], (lanes, 1))
    path = Path.to(goal, np.full(lanes, 1.0), np.full(lanes, 3.0))
    task = progress.add_task(f"{lanes} balls carried", total=round(1e3 * CARRIED))
    run = sim.run(
        np.tile(sim.around, (lanes, 1)),
        np.repeat([case.tightening for case in cases], 2, 0),
        controller(cases, 2),
        Push(wrench=wrench, begin=2.0),
        CARRIED,
        path=path,
        replan=cases[0].replan,
        progress=lambda step: progress.update(task, completed=step),
    )
    return {case.name: run.lanes(slice(2 * k, 2 * k + 2)) for k, case in enumerate(cases)}


def table_at_rest(runs: dict[str, Run]) -> list[str]:
    """The worst of six pushes."""
    lines = [
        "| | held | lost along | moved, mm | in the end, mm / degrees | slip, mm | contact lost, ms |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        lost = " ".join(np.array(["+x", "-x", "+y", "-y", "+z", "-z"])[run.lost])
        away, angle = run.error
        figures = [f"{int((~run.lost).sum())} of 6", lost, _far(run.peak.max())]
        figures.append(f"{_far(away[-1].max())} / {np.degrees(angle[-1].max()):.2f}")
        figures += [f"{1e3 * run.worst_slip().max():.2f}", f"{1e3 * run.longest_loss().max():.0f}"]
        lines.append(f"| {name} | " + " | ".join(figures) + " |")
    return lines


def table_in_motion(runs: dict[str, Run]) -> list[str]:
    lines = [
        "| | held | the push moves it, mm | off in the end, mm: pushed / not pushed | slip, mm | contact lost, ms |",
        "|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        moved = np.linalg.norm(run.position[:, 0] - run.position[:, 1], axis=-1).max()
        off = " / ".join(_far(end) for end in run.error[0][-1])
        slip, loss = 1e3 * run.worst_slip()[0], 1e3 * run.longest_loss()[0]
        figures = ["no" if run.lost[0] else "yes", _far(moved), off, f"{slip:.2f}", f"{loss:.0f}"]
        lines.append(f"| {name} | " + " | ".join(figures) + " |")
    return lines


def _far(metres: float) -> str:
    return f"{1e3 * metres:.3f}" if metres < 1e-3 else f"{1e3 * metres:.2f}" if metres < 0.1 else "dropped"


def peak_of_the_answer(sim: Simulator, run: Run, margin: float) -> float:
    """The largest force that the controller asks of the fingers while all pushes last, over the push."""
    G = np.asarray(jg.grasp_map(sim.grasps(sim.around[None]).contacts))[0]
    asked = np.einsum("wa,sna->snw", G, run.commanded.reshape(*run.commanded.shape[:2], -1))
    return float(np.linalg.norm(asked[..., :3], axis=-1).max()) / (PUSH * margin)


def table_of_bounds(sim: Simulator) -> list[str]:
    """Margins with a bound on |f| over those with one on |f_n|."""
    lines = [
        "| grasps | (12), free answers | (12), blocking forces | (21) with f_max / sqrt(1 + mu^2) |",
        "|---|---|---|---|",
    ]
    families = {"the ball of V-A, without weight": None, "random, four contacts": chain.sample(77, 1000, 4, 6)}
    for name, batch in families.items():
        if batch is None:
            contacts, load, W = sim.grasps(sim.around[None]).contacts, None, jg.DisturbanceSet.forces(1.0)
        else:
            frames = dict(friction=batch.friction, max_force=batch.max_force)
            contacts = jg.Contacts.from_frames(batch.positions, batch.frames, **frames)
            load, W = batch.load, jg.DisturbanceSet.vertices(batch.wrenches)
        smaller = jg.Contacts.from_frames(
            contacts.positions,
            contacts.frames,
            friction=contacts.friction,
            max_force=contacts.max_force / jnp.sqrt(1 + contacts.friction**2),
            active=contacts.active,
        )
        pairs = []
        for formulation in ("12", "12_fixed"):
            pairs.append(
                [
                    jg.formulation_margin(contacts, W, formulation, load, force_bound=b).margin
                    for b in ("normal", "norm")
                ]
            )
        pairs.append([jg.largest_disturbance(c, W, required_wrench=load).margin for c in (contacts, smaller)])
        columns = []
        for normal, norm in np.asarray(pairs):
            some = (normal > 1e-3) & np.isfinite(norm)
            columns.append(three(np.maximum(norm[some], 0) / normal[some]) if batch else f"{(norm / normal)[0]:.4f}")
        lines.append(f"| {name} | " + " | ".join(columns) + " |")
    return lines


def three(values: np.ndarray) -> str:
    return " / ".join(f"{value:.3f}" for value in quartiles(values))


def sweeps(weights: tuple[float, ...], shares: tuple[float, ...]) -> list[str]:
    """All tables, as lines."""
    light = Simulator.from_spec(torque_hand("sphere", friction=FRICTION, gravity=False), max_force=MAX_FORCE)
    heavy = Simulator.from_spec(torque_hand("sphere", friction=FRICTION), max_force=MAX_FORCE)
    weight = heavy.grasps(heavy.around[None]).required_wrench
    margin, printed = plan(light, PUSH)
    loaded, ours = plan(heavy, 0.85, weight)
    same_share = plan(heavy, PUSH, weight)[1]
    push, smaller = PUSH * margin, PUSH * loaded
    with Progress(transient=True) as progress:
        optimised = at_rest(light, [Case(f"w = {w:g}", printed, w) for w in weights], margin, progress)
        baseline = at_rest(light, [Case(f"w = {w:g}", BASELINE, w) for w in weights], margin, progress)
        cases = [Case(f"f_0 at {share:g} lambda", plan(light, share)[1]) for share in shares]
        computed = at_rest(light, [*cases, Case("0.5 N a finger", BASELINE)], margin, progress)

        as_printed = in_motion(heavy, [Case(f"w = {w:g}", printed, w, push) for w in weights], progress)
        anew = (2e-3, 0.12)
        as_printed |= in_motion(heavy, [Case("w = 0.1, path begun anew", printed, 0.1, push, anew)], progress)
        as_printed |= in_motion(heavy, [Case("computed torque", printed, None, push)], progress)
        carried = in_motion(heavy, [Case(f"w = {w:g}", BASELINE, w, push) for w in weights], progress)
        carried |= in_motion(heavy, [Case("computed torque", BASELINE, None, push)], progress)
        cases = [Case(f"f_0 at 0.85 lambda, w = {w:g}", ours, w, smaller) for w in weights]
        cases += [Case(f"f_0 at 0.75 lambda, w = {w:g}", same_share, w, smaller) for w in weights]
        loads = in_motion(heavy, cases, progress)
        cases = [Case("f_0 at 0.85 lambda, computed torque", ours, None, smaller)]
        cases += [Case("f_0 at 0.75 lambda, computed torque", same_share, None, smaller)]
        loads |= in_motion(heavy, cases, progress)
    peak = peak_of_the_answer(light, computed[f"f_0 at {max(shares):g} lambda"], margin)
    return [
        f"## At rest (V-A): lambda = {margin:.3f} N, pushes of {PUSH:g} lambda",
        "",
        f"**As printed**: optimisation, f_0 of (22) at {PUSH:g} lambda.",
        "",
        *table_at_rest(optimised),
        "",
        "**The paper's baseline**: optimisation, 0.5 N a finger.",
        "",
        *table_at_rest(baseline),
        "",
        "**Computed torque**, which the paper does not use here. What it asks of the fingers rises to "
        f"{peak:.3f} of the push, since it also",
        "brakes the ball, and f_0 at 0.75 lambda is just enough for the push. The optimisation asks for no less, but",
        "shares it out anew within the cones.",
        "",
        *table_at_rest(computed),
        "",
        f"## In motion (V-B): pushed along +x by {push:.3f} N",
        "",
        "**As printed**: everything as in V-A, so lambda and f_0 are those of a ball without weight.",
        "",
        *table_in_motion(as_printed),
        "",
        "**The paper's baseline**: 0.5 N a finger.",
        "",
        *table_in_motion(carried),
        "",
        f"**With the weight** in (21) and (22): lambda = {loaded:.3f} N, pushed by {smaller:.3f} N.",
        "",
        *table_in_motion(loads),
        "",
        "## What a bound on |f| in place of |f_n| changes",
        "",
        "Margins over those with |f_n| <= f_max, quartiles where there are several. f_max / sqrt(1 + mu^2) is the",
        "bound on |f_n| that keeps |f| below f_max whatever friction does.",
        "",
        *table_of_bounds(light),
    ]


HOW = """
The four-finger hand of `examples/04_push_at_rest.py` and `05_push_in_motion.py` in C MuJoCo, around a ball of 5 cm and
0.1 kg, friction 0.8, at most 2 N a finger. Pushes last 0.1 s. The optimisation weighs the object's motion by w against
contact forces and posture. Held: never 1 cm from its place, and all fingers on the ball in the end. At rest a row has
the worst of six pushes. "Moved" and "in the end" are from where the ball should be; "dropped" is 10 cm and more. In
motion the ball is to go 2 cm along -y from 1 to 3 s, under gravity, and is pushed at 2 s.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two weights and two shares, and nothing is written")
    quick = parser.parse_args().quick
    begun = time.perf_counter()
    lines = sweeps(QUICK, (0.75, 0.8)) if quick else sweeps(WEIGHTS, SHARES)
    minutes = (time.perf_counter() - begun) / 60
    where = f"{minutes:.1f} min on {platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__}, mujoco "
    where += f"{mujoco.__version__}. Made by `python -m benchmarks.pushes`."
    answer = "\n".join(
        ["# Pushed hands, over w and f_0's share", "", textwrap.dedent(HOW).strip(), "", *lines, "", where, ""]
    )
    if not quick:
        (File(__file__).parent / "pushes.md").write_text(answer)
    print(answer)


if __name__ == "__main__":
    main()
