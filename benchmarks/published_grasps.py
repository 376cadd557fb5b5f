"""Does the margin tell which published grasps hold? `python -m benchmarks.published_grasps HAND FOLDER...`.

A FOLDER has an object's convex `pieces` and `grasps.npz` (grasp_qpos, obj_pose, obj_scale, succ_flag, and where present
qp_metric, the benchmark's own): grasps in the layout of DexGraspBench. All options are the package's defaults; object,
friction and gravity are those of the benchmark's trial. Writes published_grasps.md beside this file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.candidates import Candidates, concatenate  # noqa: E402
from jaxgrasp.hands import Scene  # noqa: E402
from jaxgrasp.ranking import compare_metrics, rank  # noqa: E402
from jaxgrasp.ranking.configurations import candidates_of, trimmed  # noqa: E402

TRIAL = {"mass": 0.1, "friction": 0.6, "gravity": (0.0, 0.0, 0.0)}
"""Of the benchmark: kg, sliding friction, no gravity."""
PUSHES = jg.DisturbanceSet.forces(1.0)
EDGES = np.array([-np.inf, 1e-6, 1.0, 2.0, 3.0, 5.0, np.inf])
NAMES = ("0", "0-1", "1-2", "2-3", "3-5", "above 5")


def candidates(hand: str, folder: Path) -> tuple[Candidates, dict[str, np.ndarray]]:
    """Of one object, one scene a scale; and the columns of the file in the same order."""
    with np.load(folder / "grasps.npz") as file:
        table = {name: x for name, x in file.items() if x.ndim and len(x) == len(file["succ_flag"])}
    parts, order = [], []
    for scale in np.unique(table["obj_scale"]):
        rows = np.flatnonzero(table["obj_scale"] == scale)
        scene = Scene.build(hand=hand, object=folder / "pieces", scale=float(scale), **TRIAL)
        stage = table["grasp_qpos"][rows]
        qpos = scene.qpos(base=stage[:, :7], joints=stage[:, 7:], object=table["obj_pose"][rows])
        parts.append(candidates_of(scene.hand_object(), qpos, source=folder.name))
        order.append(rows)
    rows = np.concatenate(order)
    return concatenate(parts), {name: x[rows] for name, x in table.items()}


def margins(found: Candidates, limited: bool) -> np.ndarray:
    """What the grasps withstand, N; none is 0."""
    if not limited:
        keep = {name: x for name, x in found.hand.items() if name == "required_wrench"}
        found = Candidates(**{**vars(found), "hand": keep})
    return np.maximum(np.nan_to_num(rank(trimmed(found), PUSHES, top=0).margin), 0)


def by_margin(margin: np.ndarray, held: np.ndarray) -> list[str]:
    """How many held, by margin."""
    place = np.digitize(margin, EDGES) - 1
    cells = []
    for k in range(len(NAMES)):
        cells.append(_share(held[place == k]))
    return cells


def _share(held: np.ndarray) -> str:
    return f"{held.mean():.0%} of {len(held)}" if len(held) else "none"


def report(hand: str, folders: list[Path]) -> str:
    """The tables, in Markdown."""
    found = [candidates(hand, folder) for folder in folders]
    together = concatenate([candidate for candidate, _ in found])
    held = np.concatenate([table["succ_flag"].astype(bool) for _, table in found])
    metrics = {"margin": margins(together, False), "margin with actuators": margins(together, True)}
    if all("qp_metric" in table for _, table in found):
        metrics["qp_metric (theirs)"] = -np.concatenate([table["qp_metric"] for _, table in found])
    prediction = compare_metrics(metrics, held).prediction
    assert prediction is not None
    lines = [
        "# Published grasps",
        "",
        f"{len(held)} grasps of {', '.join(folder.name for folder in folders)}, of which {held.mean():.1%} held in the "
        f"benchmark's own trial; {together.columns['touching'].mean():.1f} links touch in the mean. All "
        "options are the defaults.",
        "",
        "| metric | AUC | 95 % |",
        "|---|---|---|",
    ]
    for name, auc, (low, high) in zip(metrics, prediction.auc, prediction.interval, strict=True):
        lines.append(f"| {name} | {auc:.3f} | {low:.3f} to {high:.3f} |")
    lines += ["", f"| held, by margin in N | {' | '.join(NAMES)} |", "|---" * (len(NAMES) + 1) + "|"]
    for name in ("margin", "margin with actuators"):
        lines.append(f"| {name} | {' | '.join(by_margin(metrics[name], held))} |")
    for name in ("margin", "margin with actuators"):
        low, high = (_share(held[rows]) for rows in (metrics[name] < 1, metrics[name] > 3))
        lines += ["", f"{name}: below 1 N {low} held, above 3 N {high}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("hand", help="MJCF or URDF file, or a name")
    parser.add_argument("folders", nargs="+", type=Path)
    given = parser.parse_args()
    missing = [folder for folder in given.folders if not (folder / "grasps.npz").is_file()]
    if missing:
        print(f"no grasps.npz in {', '.join(map(str, missing))}: nothing was done")
        return
    text = report(given.hand, given.folders)
    print(text)
    Path(__file__).with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
