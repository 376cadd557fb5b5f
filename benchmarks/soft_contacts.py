"""Soft fingertips: what the polytope loses, whether MuJoCo agrees, what they cost and tell of published grasps.

    python -m benchmarks.soft_contacts [HAND FOLDER...]

writes soft_contacts.md beside itself. HAND and FOLDERs are as in `benchmarks.published_grasps`; without them the last
section is left out.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import mujoco  # noqa: E402
import numpy as np  # noqa: E402

import jaxgrasp as jg  # noqa: E402
from benchmarks import published_grasps  # noqa: E402
from benchmarks.suite import chain  # noqa: E402
from jaxgrasp.candidates import Candidates, concatenate  # noqa: E402
from jaxgrasp.hands import HandObject  # noqa: E402
from jaxgrasp.ranking import compare_metrics  # noqa: E402

GAMMA = 0.02
"""m, of the field's simulators, with friction 0.6."""
PAIRS, NEAR = 100, 0.05
"""Grasps that MuJoCo is asked about, and by how much the moment is less and more than they should bear."""
SECONDS, LOST = 4.0, (0.2, 0.01)
"""Seconds that the moment acts, and the angle (rad) and distance (m) beyond which the box counts as lost."""
BATCH, ROUNDS = 16_384, 9


def losses(count: int = 400) -> dict[str, np.ndarray]:
    """The margin of (13) over that of (12), by n_e, for hard and soft contacts; grasps with three and four contacts."""
    found = {}
    for edges in (8, 16):
        for name in ("hard", "soft"):
            shares = []
            for n_c in (3, 4):
                batch = chain.sample(50 + n_c, count, n_c, 6)
                contacts = jg.Contacts.from_frames(
                    batch.positions,
                    batch.frames,
                    friction=batch.friction,
                    max_force=batch.max_force,
                    torsional_friction=None if name == "hard" else GAMMA,
                )
                given = contacts, jg.DisturbanceSet.vertices(batch.wrenches)
                cones, polytopes = (
                    np.asarray(jg.formulation_margin(*given, program, batch.load, cone_edges=edges).margin)
                    for program in ("12", "13")
                )
                some = np.isfinite(polytopes) & (cones > 1e-3)
                shares.append(polytopes[some] / cones[some])
            found[f"{name}, {edges} edges"] = np.concatenate(shares)
    return found


def pair_scene(rng: np.random.Generator, loaded: bool) -> tuple[mujoco.MjModel, float]:
    """Two fingertips that slide towards each other with a constant force, and a box between them."""
    force, mu, gamma = rng.uniform(2, 10), rng.uniform(0.3, 1.0), np.exp(rng.uniform(np.log(0.005), np.log(0.03)))
    size, radius = rng.uniform(0.02, 0.04, 3), rng.uniform(0.005, 0.015)
    weight = rng.uniform(0.3, 0.9) * 2 * mu * force if loaded else 0.0
    stiff = 'solref="0.004 1" solimp="0.99 0.999 0.001"'
    fingers = motors = ""
    for name, side in (("left", 1), ("right", -1)):
        at = side * (size[0] + radius)
        fingers += (
            f'<body name="{name}" pos="{at} 0 0" gravcomp="1"><joint name="{name}" type="slide" axis="{-side} 0 0" '
            f'damping="5"/><geom type="sphere" size="{radius}" mass="0.05" {stiff}/></body>'
        )
        motors += f'<motor joint="{name}"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option cone="elliptic" impratio="100" timestep="0.001" gravity="0 0 {-weight / 0.1}"/>'
        f'<worldbody>{fingers}<body name="object"><freejoint/><geom type="box" size="{size[0]} {size[1]} {size[2]}" '
        f'mass="0.1" condim="4" priority="1" friction="{mu} {gamma} 0" {stiff}/></body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    return model, force


def is_held(model: mujoco.MjModel, force: float, moment: float) -> bool:
    """Test whether the box stays under a moment about the line between the contacts, N m, which rises for 0.2 s."""
    data = mujoco.MjData(model)
    body = model.body("object").id
    data.ctrl[:] = force
    for step in range(round(SECONDS / model.opt.timestep)):
        data.xfrc_applied[body, 3] = moment * min(1, step * model.opt.timestep / 0.2)
        mujoco.mj_step(model, data)
        turned = 2 * np.arccos(np.clip(abs(data.xquat[body, 0]), 0, 1))
        if turned > LOST[0] or np.linalg.norm(data.xpos[body]) > LOST[1]:
            return False
    return True


def thresholds(count: int = PAIRS) -> dict[str, np.ndarray]:
    """For every pair, the moments that (12) and (21) allow, N m, and whether MuJoCo holds 95 % and 105 % of (12)'s."""
    rng = np.random.default_rng(2)
    moments = jg.DisturbanceSet.vertices(np.array([[0, 0, 0, 1.0, 0, 0], [0, 0, 0, -1.0, 0, 0]]))
    rows: dict[str, list] = {"12": [], "21": [], "below": [], "above": [], "loaded": []}
    for k in range(count):
        loaded = bool(k % 2)
        model, force = pair_scene(rng, loaded)
        hand = HandObject.from_mjcf(model, "object", max_force=force)
        grasps = hand.grasps(model.qpos0, actuation=False)
        given = grasps.contacts, moments
        exact = float(jg.formulation_margin(*given, "12", grasps.required_wrench).margin)
        rows["12"].append(exact)
        rows["21"].append(float(jg.largest_disturbance(*given, grasps.required_wrench).margin))
        rows["below"].append(is_held(model, force, (1 - NEAR) * exact))
        rows["above"].append(is_held(model, force, (1 + NEAR) * exact))
        rows["loaded"].append(loaded)
    return {name: np.array(column) for name, column in rows.items()}


def speeds(batch: int = BATCH, rounds: int = ROUNDS) -> dict[str, tuple[float, float, float, float]]:
    """Margins a processor second, by precision: hard, soft, and the mean steps of both; by turns, the best of all."""
    found = {}
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(batch, 4, 3))
    positions = 0.05 * normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    pushes = jg.DisturbanceSet.forces(1.0)
    for dtype in (np.float64, np.float32):
        given = positions.astype(dtype), normals.astype(dtype)
        contacts = [
            jg.Contacts.from_normals(*given, friction=0.6, max_force=5.0, torsional_friction=gamma)
            for gamma in (None, GAMMA)
        ]
        steps = [float(jg.largest_disturbance(c, pushes).iterations.mean()) for c in contacts]
        best = [np.inf, np.inf]
        for _ in range(rounds):
            for k, c in enumerate(contacts):
                start = time.process_time()
                jg.largest_disturbance(c, pushes).margin.block_until_ready()
                best[k] = min(best[k], time.process_time() - start)
        found[dtype.__name__] = (batch / best[0], batch / best[1], *steps)
    return found


def hardened(found: Candidates) -> Candidates:
    """The same candidates without torsional friction."""
    jacobian = found.hand["jacobian"]
    return replace(found, torsional_friction=None, hand=found.hand | {"jacobian": jacobian[..., :3, :]})


def published(hand: str, folders: list[Path]) -> list[str]:
    """Compare, paired, how well margins with and without torsion tell which grasps held."""
    published_grasps.TRIAL |= {"condim": 4, "torsional_friction": GAMMA}
    found = [published_grasps.candidates(hand, folder) for folder in folders]
    soft = concatenate([candidates for candidates, _ in found])
    held = np.concatenate([table["succ_flag"].astype(bool) for _, table in found])
    lines = [
        f"{len(held)} grasps of {', '.join(folder.name for folder in folders)}, friction 0.6 and {GAMMA} m.",
        "",
        "| margin | AUC | 95 % | soft leads by | 95 % |",
        "|---|---|---|---|---|",
    ]
    for limited in (False, True):
        each = {"soft": soft, "hard": hardened(soft)}
        margins = {name: published_grasps.margins(candidates, limited) for name, candidates in each.items()}
        prediction = compare_metrics(margins, held).prediction
        assert prediction is not None
        rows = zip(margins, prediction.auc, prediction.interval, prediction.lead, strict=True)
        for name, area, (low, high), lead in rows:
            name = f"{name}{', with actuators' if limited else ''}"
            led = f"{lead[0]:+.3f} | {lead[1]:+.3f} to {lead[2]:+.3f}" if name.startswith("hard") else "|"
            lines.append(f"| {name} | {area:.3f} | {low:.3f} to {high:.3f} | {led} |")
    return lines


def report(hand: str | None, folders: list[Path]) -> str:
    """The tables, in Markdown."""
    lines = [
        "# Soft contacts",
        "",
        "What (13), with the inscribed polytope, keeps of (12), with cones or ellipsoids, over random grasps:",
        "",
    ]
    lines += ["| | median | worst |", "|---|---|---|"]
    lines += [f"| {name} | {np.median(left):.4f} | {left.min():.4f} |" for name, left in losses().items()]
    found = thresholds()
    right = found["below"] & ~found["above"]
    loaded = found["loaded"]
    kept = found["21"] / found["12"]
    lines += [
        "",
        f"C MuJoCo, elliptic cones, condim 4: {right.sum()} of {len(right)} pairs of fingertips hold {1 - NEAR:.0%} of "
        f"the moment about their line that (12) allows and lose {1 + NEAR:.0%} of it. Half of them bear a weight "
        f"across the line besides; for these (21) allows {np.median(kept[loaded]):.3f} of it in the median, for the "
        f"others {np.median(kept[~loaded]):.3f}.",
        "",
        "| margins a processor second | hard | soft | ratio | steps, hard and soft |",
        "|---|---|---|---|---|",
    ]
    for name, (hard, soft, *steps) in speeds().items():
        lines.append(f"| {name} | {hard:,.0f} | {soft:,.0f} | {soft / hard:.2f} | {steps[0]:.2f}, {steps[1]:.2f} |")
    if hand is not None:
        lines += ["", *published(hand, folders)]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("hand", nargs="?", help="MJCF or URDF file, or a name")
    parser.add_argument("folders", nargs="*", type=Path)
    given = parser.parse_args()
    text = report(given.hand, given.folders)
    print(text)
    Path(__file__).with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
