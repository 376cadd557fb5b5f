"""How much of what a fixed compliance costs its optimisation wins back: `python -m benchmarks.compliance`.

Writes compliance.md beside this file. The recorded grasps are taken where they are present.
"""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import problems  # noqa: E402
from benchmarks.suite.unreduced import quartiles, unreduced_margins  # noqa: E402
from jaxgrasp.synthesis import optimize_compliance  # noqa: E402

STEPS = 120
SHOWN = (0, 15, 30, 60, 120)
# In newtons a newton of disturbance; below this a grasp has no force closure, and ratios mean nothing.
LEAST = 1e-6
REAL = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "ycb_allegro_grasps.npz"

Family = tuple[jg.Contacts, jax.Array]


def families() -> dict[str, Family]:
    """Contacts and required wrenches by name."""
    found = {}
    for n_c, count in ((3, 512), (4, 512), (8, 256)):
        grasps = problems.sample(count, n_c)
        contacts = jg.Contacts.from_frames(grasps.positions, grasps.frames, friction=0.8, max_force=2.0)
        found[f"random, {n_c} contacts"] = contacts, jnp.zeros((count, 6))
    if REAL.exists():
        with np.load(REAL, allow_pickle=False) as data:
            friction = np.repeat(data["friction"][:, None], data["positions"].shape[1], 1)
            real = jg.Contacts.from_normals(
                data["positions"], data["outward_normals"], friction=friction, max_force=5.0
            )
            found["recorded"] = real, jnp.zeros((len(friction), 6))
            found["recorded, with their weight"] = real, jg.required_wrench(data["mass"])
    return found


def measure(contacts: jg.Contacts, load: jax.Array) -> dict:
    """Ratios to lambda_13 of the grasps that have a margin, and the seconds of a warm call."""
    directions = jnp.asarray(problems.SIX_FORCES)
    run = lambda: jax.block_until_ready(  # noqa: E731
        optimize_compliance(contacts, jg.DisturbanceSet.vertices(directions), load, steps=STEPS)
    )
    start = time.perf_counter()
    result = run()
    first = time.perf_counter() - start
    start = time.perf_counter()
    run()
    seconds = time.perf_counter() - start
    margins = np.asarray(result.margins)
    best = np.maximum.accumulate(np.where(np.isnan(margins), -np.inf, margins), -1)
    most = np.asarray(unreduced_margins(contacts, directions, load))
    counted = (np.asarray(result.before.status) == jg.Status.SOLVED) & (best[:, 0] > LEAST) & np.isfinite(most)
    before, after, most = np.asarray(result.before.margin)[counted], best[counted], most[counted]
    assert np.all(after[:, -1] <= most * (1 + 1e-6)), "lambda_21 above lambda_13"
    return {
        "grasps": len(counted),
        "counted": int(counted.sum()),
        "before": before / most,
        "after": np.asarray(result.after.margin)[counted] / most,
        "share": (after[:, -1] - before) / (most - before),
        "way": {k: float(np.median(after[:, k] / most)) for k in SHOWN},
        "first": first,
        "seconds": seconds,
    }


def text(results: dict[str, dict]) -> str:
    three = lambda values: " / ".join(f"{v:.3f}" for v in quartiles(values))  # noqa: E731
    lines = [
        "# What optimising the compliance wins back",
        "",
        "The margin of (21), lambda_21, is below that of the unreduced program (13), lambda_13, since the answer to a",
        "disturbance is fixed by the compliance Q. `optimize_compliance` seeks the best diagonal Q for each grasp.",
        "`before` (Q = I) and `after` are quartiles of lambda_21/lambda_13, `won back` those of",
        "(after - before)/(lambda_13 - before), over the grasps with a positive margin at Q = I.",
        f"{STEPS} steps, six unit forces, eight edges, float64; lambda_13 by `solve_qp`, one program a direction.",
        "",
        "| grasps | with a margin | before | after | won back |",
        "|---|---|---|---|---|",
    ]
    for name, r in results.items():
        columns = (f"{r['counted']} of {r['grasps']}", *(three(r[key]) for key in ("before", "after", "share")))
        lines.append(" | ".join([f"| {name}", *columns]) + " |")
    lines += [
        "",
        "Median ratio of the best so far, by step, and seconds for all grasps and steps:",
        "",
        "| grasps | " + " | ".join(map(str, SHOWN)) + " | seconds, warm | first call |",
        "|---|" + "---|" * (len(SHOWN) + 2),
    ]
    for name, r in results.items():
        way = " | ".join(f"{r['way'][k]:.3f}" for k in SHOWN)
        lines.append(f"| {name} | {way} | {r['seconds']:.1f} | {r['first']:.1f} |")
    lines += [
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}, jax {jax.__version__}, load average "
        f"{os.getloadavg()[0]:.1f}. Made by `python -m benchmarks.compliance`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    results = {}
    for name, (contacts, load) in families().items():
        results[name] = measure(contacts, load)
        print(name, results[name]["way"], f"{results[name]['seconds']:.1f} s", flush=True)
    answer = text(results)
    (Path(__file__).parent / "compliance.md").write_text(answer)
    print(answer)


if __name__ == "__main__":
    main()
