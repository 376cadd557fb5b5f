"""How fast configurations of hands become margins, and where the time goes: `python -m benchmarks.hands`.

Writes hands.md beside this file.
"""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path

import jax
import mujoco
import numpy as np
from jax.sharding import Mesh, PartitionSpec

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite.clock import by_turns, warn_if_busy  # noqa: E402
from jaxgrasp.hands import HandObject, sample_configurations, scenes  # noqa: E402

BATCH = 4096
ROUNDS = 5


def rough_shadow_hand() -> mujoco.MjSpec:
    """18 actuators, of which four drive two joints each, dry friction of 0.02 N m in 22 joints, and no wrist."""
    spec = scenes.shadow_hand("sphere", coupled_tendons=True)
    for wrist in ("rh_WRJ2", "rh_WRJ1"):
        for actuator in [a for a in spec.actuators if a.target == wrist]:
            spec.delete(actuator)
        spec.delete(spec.joint(wrist))
    for joint in spec.joints:
        if joint.name != "object":
            joint.frictionloss = 0.02
    return spec


CASES = {
    "four fingers, sphere": lambda: HandObject.from_mjcf(scenes.four_fingers("sphere"), "object"),
    "Shadow Hand, sphere": lambda: HandObject.from_mjcf(scenes.shadow_hand("sphere"), "object"),
    "Shadow Hand, coupled, dry friction": lambda: HandObject.from_mjcf(rough_shadow_hand(), "object", max_contacts=8),
}
STAGES = ("kinematics", "points", "grasps", "margins", "plain margins")


def measure(hand: HandObject) -> dict:
    """Seconds of every stage for the whole batch, and what came out."""
    qpos = sample_configurations(hand, BATCH)
    mesh, lanes = Mesh(np.array(jax.devices()), ("lanes",)), PartitionSpec("lanes")
    pushes = jg.DisturbanceSet.forces(1.0)

    def spread(function):
        return jax.jit(jax.shard_map(function, mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=False))

    def margins(grasps, limited):
        actuation = grasps.actuation if limited else None
        found = jg.largest_disturbance(
            grasps.contacts, pushes, required_wrench=grasps.required_wrench, actuation=actuation
        )
        return found.margin, found.status

    # Only what a stage returns is computed; sums keep the rest from being copied.
    poses = lambda q: jax.tree.map(lambda x: x.sum(tuple(range(x.ndim - 1))), hand._kinematics.poses(q.T))  # noqa: E731
    stages = {
        "kinematics": (spread(poses), qpos),
        "points": (spread(lambda q: hand.approach(q)[0].distance), qpos),
        "grasps": (spread(hand.grasps), qpos),
    }
    grasps = stages["grasps"][0](qpos)
    stages["margins"] = (spread(lambda g: margins(g, True)), grasps)
    stages["plain margins"] = (spread(lambda g: margins(g, False)), grasps)
    first = {}
    for name, (function, data) in stages.items():
        start = time.perf_counter()
        jax.block_until_ready(function(data))
        first[name] = time.perf_counter() - start

    def job(name):
        function, data = stages[name]
        jax.block_until_ready(function(data))

    jobs = {name: lambda name=name: job(name) for name in stages}
    timings = by_turns(jobs, ROUNDS)
    margin, status = (np.asarray(x) for x in stages["margins"][0](grasps))
    return {
        "contacts": float(np.asarray(grasps.touching).mean()),
        "holds": float((np.nan_to_num(margin, nan=-1) > 0).mean()),
        "answered": float(np.isin(status, (jg.Status.SOLVED, jg.Status.INFEASIBLE)).mean()),
        "first": first,
        "seconds": {name: timing.seconds for name, timing in timings.items()},
        "cpu": timings["margins"].cpu_per_wall,
    }


def text(results: dict[str, dict], load: float) -> str:
    lines = [
        "# From configurations of hands to margins",
        "",
        f"{BATCH:,} configurations with closed fingers, at most eight contacts, eight edges, six unit forces, the",
        "weight borne, float64, spread over two cores, warm, best of five. `points` are distances, points and normals",
        "of all pairs of geoms; `rest` chooses contacts and makes frames, Jacobians and limits; `margins` is (21) with",
        "the actuators' efforts, of which `holds` is the share with a margin above zero; `unlimited` is (21) without.",
        "",
        "| scene | pairs | contacts | holds | answered | configurations / s | kinematics | points | rest | margins |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, r in results.items():
        s = r["seconds"]
        total = s["grasps"] + s["margins"]
        parts = (s["kinematics"], s["points"] - s["kinematics"], s["grasps"] - s["points"], s["margins"])
        lines.append(
            f"| {name} | {r['pairs']} | {r['contacts']:.1f} | {r['holds']:.1%} | {r['answered']:.1%} | "
            f"{BATCH / total:,.0f} | " + " | ".join(f"{max(part, 0) / total:.1%}" for part in parts) + " |"
        )
    lines += [
        "",
        "| scene | grasps / s | margins / s | unlimited margins / s | first call: grasps, s | first call: margins, s |",
        "|---|---|---|---|---|---|",
    ]
    for name, r in results.items():
        s, first = r["seconds"], r["first"]
        lines.append(
            f"| {name} | {BATCH / s['grasps']:,.0f} | {BATCH / s['margins']:,.0f} | "
            f"{BATCH / s['plain margins']:,.0f} | {r['compiled']:.1f} | {first['margins']:.1f} |"
        )
    lines += [
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}, jax {jax.__version__}, mujoco "
        f"{mujoco.__version__}, load average at the start {load:.1f}. Made by `python -m benchmarks.hands`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    load, results = warn_if_busy(), {}
    for name, make in CASES.items():
        print(name, flush=True)
        hand = make()
        start = time.perf_counter()
        jax.block_until_ready(hand.grasps(np.tile(hand.model.qpos0, (BATCH, 1))))
        compiled = time.perf_counter() - start
        results[name] = measure(hand) | {"pairs": len(hand.slot_links), "compiled": compiled}
    answer = text(results, load)
    (Path(__file__).parent / "hands.md").write_text(answer)
    print(answer)


if __name__ == "__main__":
    main()
