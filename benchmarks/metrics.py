"""The field's metrics: against stored figures, against recorded picks, and how fast: `python -m benchmarks.metrics`.

Writes metrics.md and metrics.png beside this file. The recorded grasps lie beside a checkout, and not everywhere: what
needs them is left out where they are absent, and then nothing is written.
"""

from __future__ import annotations

import os
import platform
import textwrap
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp import metrics  # noqa: E402
from jaxgrasp.candidates import Candidates, read_candidates, sample_grasps  # noqa: E402
from jaxgrasp.metrics import METRICS, Setting, WrenchSpace  # noqa: E402
from jaxgrasp.ranking import MetricComparison, compare_metrics, score  # noqa: E402
from jaxgrasp.viewer import figure_of_comparison, write_figure  # noqa: E402

REAL = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "ycb_allegro_grasps.npz"
MAX_FORCE = 5.0
RESAMPLES = 4000
# Compared with the picks; what cannot be asked for so many points is left to its bound.
COMPARED = [name for name in METRICS if name not in ("ferrari_canny_bound", "ferrari_canny_linf")]
# In the figure, where the paper's other programs would hide each other.
SHOWN = (
    "margin",
    "margin, with gravity",
    "margin_12",
    "margin_13",
    "ferrari_canny",
    "ferrari_canny_linf_bound",
    "min_weight",
    "volume",
    "task_wrench",
    "smallest_singular_value",
    "isotropy",
    "closure_residual",
)
BATCH, LOOPED = 1024, 64
NEAR = 0.01


def frogger(given: dict[str, np.ndarray]) -> tuple[jg.Contacts, WrenchSpace]:
    """The conventions of the stored figures; the first tangent is (1.2, 2.3, 3.4) made orthogonal to the normal."""
    n = given["outward_normals"]
    seed = np.array([1.2, 2.3, 3.4])
    t1 = seed - n * (n @ seed)[..., None]
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    frames = np.stack([t1, np.cross(n, t1), n], -1)
    friction = np.repeat(given["friction"][:, None], n.shape[1], 1)
    contacts = jg.Contacts.from_frames(given["positions"], frames, friction=friction, max_force=1.0)
    return contacts, WrenchSpace(cone_edges=4, unit_edges=True, length=1.0, reference=-given["center_of_mass"])


def rows_of(tree: object, row: int | slice) -> object:
    return jax.tree.map(lambda x: x[row], tree)


def stored_figures(given: dict[str, np.ndarray]) -> dict:
    """Ours beside those stored, and by how much normals would have to turn, or points to move, for the stored ones."""
    contacts, space = frogger(given)
    weights = np.asarray(metrics.min_weight(contacts, space))
    radii = np.array(
        [
            metrics.ferrari_canny(rows_of(contacts, row), "L1", replace(space, reference=space.reference[row]))
            for row in range(len(weights))
        ]
    )
    bounds = np.asarray(metrics.ferrari_canny_bound(contacts, "L1", space))

    def turned(angles: jax.Array) -> jax.Array:
        # Small rotations of every contact frame about its own tangents.
        x, y = angles[..., 0], angles[..., 1]
        zero = jnp.zeros_like(x)
        skew = jnp.stack([zero, zero, y, zero, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
        frames = contacts.frames @ (jnp.eye(3) + skew)
        return metrics.min_weight(replace(contacts, frames=frames), space).sum()

    slope = np.asarray(jax.grad(turned)(jnp.zeros((*contacts.friction.shape, 2))))
    error = np.abs(weights - given["min_weight"])
    needed = np.degrees(error / np.linalg.norm(slope, axis=(1, 2)))
    near = lambda ours, name: np.abs(ours - given[name]) <= NEAR * np.abs(given[name])  # noqa: E731
    return {
        "min_weight": near(weights, "min_weight"),
        "ferrari_canny": near(radii, "ferrari_canny"),
        "needed": needed,
        "exact": radii,
        "bound": bounds,
        "objects": given["object_name"],
        "generator": given["generator"],
    }


def predictions(candidates: Candidates) -> tuple[MetricComparison, MetricComparison, MetricComparison]:
    """All metrics against the picks, over all pairs of grasps and over those on the same object; and those drawn."""
    forces = jg.DisturbanceSet.forces(1.0)
    values = {}
    for name in COMPARED:
        values[name] = score(candidates, name, forces)
        if name.startswith("margin"):
            values[f"{name}, with gravity"] = score(candidates, name, forces, gravity=9.81)
        print(name, flush=True)
    values |= {f"{name}, stored": candidates.columns[name] for name in ("min_weight", "ferrari_canny")}
    success, objects = candidates.columns["pick_success"], candidates.columns["object_name"]
    smaller = frozenset(name for name in COMPARED if not METRICS[name].larger_is_better)
    shown = {name: values[name] for name in SHOWN}
    everywhere, within, drawn = (
        compare_metrics(some, success, smaller_is_better=smaller, within=labels, resamples=RESAMPLES)
        for some, labels in ((values, None), (values, objects), (shown, None))
    )
    return everywhere, within, drawn


def ball(points: np.ndarray) -> float:
    try:
        return max(0.0, (-ConvexHull(points).equations[:, -1]).min())
    except QhullError:
        return 0.0


def least_weight(W: np.ndarray) -> float:
    m = len(W)
    rows = np.column_stack([-np.eye(m), np.ones(m)])
    equal = np.vstack([np.column_stack([W.T, np.zeros(6)]), np.append(np.ones(m), 0)])
    return -linprog([0] * m + [-1], rows, np.zeros(m), equal, [0] * 6 + [1], bounds=(None, None)).fun


def largest_task(W: np.ndarray, wrenches: np.ndarray) -> float:
    rows, cost = [np.append(np.ones(len(W)), 0)], np.append(np.zeros(len(W)), -1)
    return min(-linprog(cost, rows, [1], np.column_stack([W.T, -w]), np.zeros(6)).fun for w in wrenches)


def speeds() -> list[dict]:
    """Grasps a second of every metric that takes batches, warm, and of one grasp after the other by other means."""
    found = sample_grasps(BATCH, seed=1)
    contacts = jg.Contacts.from_normals(
        found.positions, found.outward_normals, friction=found.friction, max_force=found.max_force
    )
    setting = Setting(disturbances=jg.DisturbanceSet.forces(1.0), task={})
    edges = np.asarray(metrics.edge_wrenches(contacts, setting.space))
    flat = edges.reshape(BATCH, -1, 6)
    length = np.sqrt((found.positions**2).sum(-1).mean(-1))
    G = np.asarray(jg.grasp_map(contacts))
    wrenches = np.concatenate([np.eye(3, 6), -np.eye(3, 6)])
    loops: dict[str, tuple[str, Callable[[int], object]]] = {
        "ferrari_canny_bound": ("Qhull (exact)", lambda i: ball(flat[i])),
        "min_weight": ("HiGHS", lambda i: least_weight(flat[i])),
        "force_closure": ("HiGHS", lambda i: least_weight(flat[i]) > 1e-9),
        "task_wrench": ("HiGHS, six programs", lambda i: largest_task(flat[i], wrenches)),
        "smallest_singular_value": ("numpy.linalg.svd", lambda i: np.linalg.svd(_scaled(G[i], length[i]))[1][5]),
        "isotropy": ("numpy.linalg.svd", lambda i: np.linalg.svd(_scaled(G[i], length[i]))[1][[5, 0]]),
        "closure_residual": ("NumPy", lambda i: np.linalg.norm(_scaled(G[i], length[i])[:, 2::3].sum(1))),
    }
    rows = []
    for name, metric in METRICS.items():
        if not metric.batched or name.startswith("margin"):
            continue
        run = jax.jit(lambda c, value=metric.value: value(c, setting))
        start = time.perf_counter()
        ours = np.asarray(jax.block_until_ready(run(contacts)))
        first = time.perf_counter() - start
        seconds = min(_timed(lambda run=run: jax.block_until_ready(run(contacts))) for _ in range(3))
        row = {"name": name, "rate": BATCH / seconds, "compile": first - seconds}
        if name in loops:
            label, loop = loops[name]
            start = time.perf_counter()
            theirs = [loop(i) for i in range(LOOPED)]
            row |= {"peer": label, "peer_rate": LOOPED / (time.perf_counter() - start)}
            if name in ("min_weight", "task_wrench"):
                row["error"] = float(np.max(np.abs(ours[:LOOPED] - theirs)))
            if name == "ferrari_canny_bound":
                closed = np.array(theirs) > 1e-6
                row["ratio"] = ours[:LOOPED][closed] / np.array(theirs)[closed]
        rows.append(row)
        print(row["name"], f"{row['rate']:,.0f}/s", flush=True)
    return rows


def _scaled(G: np.ndarray, length: float) -> np.ndarray:
    return np.concatenate([G[:3], G[3:] / length])


def _timed(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def paragraph(words: str) -> list[str]:
    return textwrap.wrap(" ".join(words.split()), 120)


def text(stored: dict, everywhere: MetricComparison, within: MetricComparison, rates: list[dict]) -> str:
    count, both = len(stored["needed"]), stored["min_weight"] & stored["ferrari_canny"]
    needed, far = stored["needed"], ~stored["min_weight"]
    closed = stored["exact"] > 1e-6
    ratio = stored["bound"][closed] / stored["exact"][closed]
    names, numbers = np.unique(stored["objects"][~both], return_counts=True)
    by_object = ", ".join(f"{n} {name}" for name, n in sorted(zip(names, numbers, strict=True), key=lambda x: -x[1]))
    baseline = int((stored["generator"][~both] == "baseline").sum())
    lines = [
        "# The field's metrics on the same contacts",
        "",
        "## Against stored figures",
        "",
        *paragraph(
            f"""{count} recorded grasps with the min-weight and the Ferrari-Canny metric (L1) that their source
            computed: four edges of unit norm, N m about the origin of the mesh, and the first tangent (1.2, 2.3, 3.4)
            made orthogonal to the normal, on which coarse pyramids depend."""
        ),
        "",
        "| | within 1 % of the stored one |",
        "|---|---|",
        f"| `min_weight` | {stored['min_weight'].mean():.1%} |",
        f"| `ferrari_canny` (hull) | {stored['ferrari_canny'].mean():.1%} |",
        f"| both | {both.mean():.1%} |",
        "",
        *paragraph(
            f"""The other {np.sum(~both)}: {by_object}; {baseline} of them by the baseline generator. Contacts and
            normals were derived from the source's files, so where a surface bends sharply the normals may be others
            than those that the source used. The least turn of the four normals that would explain the difference of the
            min-weight, to first order by its gradient (root of the sum of squares):
            {np.median(needed[~far]):.3f} degrees in the median of the grasps that agree,
            {np.median(needed[far]):.2f} in the median of those that do not (from {needed[far].min():.3f} to
            {needed[far].max():.2f}); {np.sum(needed[far] < 1)} of {far.sum()} need less than one degree."""
        ),
        "",
        *paragraph(
            f"""`ferrari_canny_bound` on the {closed.sum()} of them with force closure: the metric itself (to 1e-6) on
            {np.mean(ratio < 1 + 1e-6):.1%}, within 1 % on {np.mean(ratio < 1.01):.1%}, at most {ratio.max():.2f} times
            it; the lowest ratio is 1 - {max(0.0, 1 - ratio.min()):.0e}."""
        ),
        "",
        "## Against recorded picks",
        "",
        *paragraph(
            f"""The source lifted every grasp in a simulation; {everywhere.prediction.success.sum()} of {count} held.
            Areas under the ROC curve with 95 % bootstrap intervals ({RESAMPLES:,} resamples of the grasps), over all
            pairs of a success and a failure, and over pairs on the same object alone. 0.5 is no better than chance.
            `Leads by` is how much larger the area of the margin (21) without gravity is, with its interval from the
            same resamples. Eight edges, largest normal force {MAX_FORCE:g} N, six unit forces, moments over the size of
            the grasp, about the centre of mass; grasps that cannot bear their weight count by their negative margin,
            those without any as the worst. The stored ones are in their own conventions."""
        ),
        "",
        "| metric | AUC | 95 % | the margin leads by | 95 % | same object: AUC | 95 % | leads by | 95 % |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row, name in enumerate(everywhere.names):
        cells = []
        for found in (everywhere.prediction, within.prediction):
            (low, high), (lead, least, most) = found.interval[row], found.lead[row]
            cells += [f"{found.auc[row]:.3f}", f"{low:.3f} to {high:.3f}"]
            cells += [f"{lead:+.3f}", f"{least:+.3f} to {most:+.3f}"] if row else ["", ""]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "![Rank correlations, ROC curves and areas](metrics.png)",
        "",
        "## Speed",
        "",
        *paragraph(
            f"""{BATCH:,} random grasps of four contacts, eight edges, float64, one call of `jax.jit` on one device,
            warm, best of three; beside it one grasp after the other by other means, the first {LOOPED} of them, in the
            same process."""
        ),
        "",
        "| metric | grasps/s | compiling, s | one by one | grasps/s | ratio | |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rates:
        peer = "| | | "
        if "peer" in row:
            peer = f"| {row['peer']} | {row['peer_rate']:,.0f} | {row['rate'] / row['peer_rate']:,.0f} "
        note = f"largest difference {row['error']:.0e}" if "error" in row else ""
        if "ratio" in row:
            note = f"equal on {np.mean(row['ratio'] < 1 + 1e-6):.0%} of those with force closure"
        lines.append(f"| {row['name']} | {row['rate']:,.0f} | {row['compile']:.1f} {peer}| {note} |")
    lines += [
        "",
        f"{platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}, jax {jax.__version__}, load average "
        f"{os.getloadavg()[0]:.1f}. Made by `python -m benchmarks.metrics`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    rates = speeds()
    if not REAL.exists():
        print("no recorded grasps beside this checkout: nothing is written")
        return
    with np.load(REAL, allow_pickle=False) as data:
        given = {name: data[name] for name in data}
    stored = stored_figures(given)
    everywhere, within, drawn = predictions(read_candidates([REAL], max_force=MAX_FORCE))
    here = Path(__file__).parent
    write_figure(figure_of_comparison(drawn, outcome="pick_success"), here / "metrics.png")
    answer = text(stored, everywhere, within, rates)
    (here / "metrics.md").write_text(answer)
    print(answer)


if __name__ == "__main__":
    main()
