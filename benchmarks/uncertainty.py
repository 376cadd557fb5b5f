"""What random friction, contacts and mass centres cost and tell: `python -m benchmarks.uncertainty [HAND FOLDER...]`.

speed       1,000 draws a grasp against as many margins of the same drawn grasps, and the memory that more grasps take
intervals   how often 95 % intervals hold the truth, on recorded or random grasps
forces      how often forces hold that were to hold with a probability, and what they cost
success     with a HAND and FOLDERs as of `published_grasps`: what predicts the benchmark's own trials; recorded picks

--only NAME runs one of these; the others' parts of uncertainty.md stay as they are.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks import published_grasps  # noqa: E402
from benchmarks.suite.clock import say, warn_if_busy  # noqa: E402
from jaxgrasp.candidates import concatenate, read_candidates, sample_grasps  # noqa: E402
from jaxgrasp.ranking import compare_metrics  # noqa: E402
from jaxgrasp.ranking.configurations import trimmed  # noqa: E402
from jaxgrasp.ranking.tiles import columns_of, contacts_of  # noqa: E402
from jaxgrasp.uncertainty import scenario_effort  # noqa: E402
from jaxgrasp.uncertainty.draws import apply, draw  # noqa: E402

HERE = Path(__file__).with_suffix(".md")
PICKS = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "ycb_allegro_grasps.npz"
PUSHES = jg.DisturbanceSet.forces(1.0)
SPEC = jg.Uncertainty.of(friction=0.1, position=0.002, normal=math.radians(10), center_of_mass=0.005)
"""Friction 0.1, contacts 2 mm, normals 10 degrees about both tangents, mass centres 5 mm."""
GRASPS, SAMPLES = 10_000, 1_000
# Grasps, independent runs of each, draws in a run, and draws that stand for the truth.
COVERED, TRIALS, DRAWS, TRUTH = 200, 40, 250, 20_000
HELD, TESTED = 60, 1_000
SMALL = jg.Uncertainty.of(friction=0.05, position=0.0005, normal=math.radians(2), center_of_mass=0.001)
LEVELS = (0.05, 0.1, 0.5, 0.9)


def speed() -> str:
    """The time of margins under uncertainty, in margins."""
    warn_if_busy()
    contacts = contacts_of(columns_of(sample_grasps(GRASPS)))
    draws = draw(SPEC, contacts.n_c, 8, jnp.asarray(0), contacts.positions.dtype)
    spread = jax.tree.map(lambda x: x[:, None], contacts)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), apply(spread, None, draws).contacts)
    plain = lambda: jax.block_until_ready(jg.largest_disturbance(flat, PUSHES))
    random = lambda some: jax.block_until_ready(jg.margin_distribution(some, PUSHES, SPEC, samples=SAMPLES))
    few = jax.tree.map(lambda x: x[: GRASPS // 10], contacts)
    peaks = []
    for some in (few, contacts):
        random(some)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        say(f"  {len(some.positions):,} grasps: peak {peaks[-1]:.0f} MiB")
    plain()
    (wall, cpu), (all_wall, all_cpu) = _seconds(plain, 5), _seconds(lambda: random(contacts), 1)
    many = GRASPS * SAMPLES / len(flat.positions)
    by_cpu, by_wall = all_cpu / (many * cpu), all_wall / (many * wall)
    return f"""{GRASPS:,} sampled grasps of {contacts.n_c} contacts, {SAMPLES:,} draws each, take {by_cpu:.2f} times the
processor seconds ({all_cpu:.1f}) and {by_wall:.2f} times the time of as many margins of such grasps in
batches of {len(flat.positions):,}. The process's peak was {peaks[0]:.0f} MiB after {GRASPS // 10:,} grasps and
{peaks[1]:.0f} MiB after {GRASPS:,}.
"""


def _seconds(job: Callable[[], object], rounds: int) -> tuple[float, float]:
    """The least time, and the least processor time, that a warm job takes."""
    found = []
    for _ in range(rounds):
        start, cpu = time.perf_counter(), time.process_time()
        job()
        found.append((time.perf_counter() - start, time.process_time() - cpu))
        say(f"  {found[-1][0]:.2f} s, {found[-1][1]:.2f} processor seconds")
    return min(wall for wall, _ in found), min(cpu for _, cpu in found)


def intervals() -> str:
    """How often 95 % intervals hold the truth."""
    source = read_candidates([PICKS], friction=0.6, max_force=5.0) if PICKS.is_file() else sample_grasps(COVERED)
    contacts = contacts_of(columns_of(source.take(slice(0, COVERED))))
    count = len(contacts.positions)
    asked = {"quantiles": LEVELS, "at_least": (1.0,)}
    truth = jg.margin_distribution(contacts, PUSHES, SPEC, samples=TRUTH, seed=10_000, **asked)
    names = [f"quantile {level}" for level in LEVELS] + ["P(margin >= 1 N)", "mean", "tail mean"]
    gather = lambda found: [
        *(jax.tree.map(lambda x, k=k: x[:, k], found.quantiles) for k in range(len(LEVELS))),
        jax.tree.map(lambda x: x[:, 0], found.at_least),
        found.mean,
        found.tail_mean,
    ]
    covered = np.zeros((len(names), count))
    for trial in range(TRIALS):
        found = jg.margin_distribution(contacts, PUSHES, SPEC, samples=DRAWS, seed=trial, **asked)
        for k, (ours, known) in enumerate(zip(gather(found), gather(truth), strict=True)):
            covered[k] += np.asarray((ours.low <= known.value) & (known.value <= ours.high))
    # Where the truth is uncertain itself, or many draws share one margin, intervals are wider than they need be.
    smooth = [np.asarray(x.high > x.low) & (np.asarray(x.error) > 0) for x in gather(truth)]
    lines = ["| statistic | 95 % intervals that hold it | grasps |", "|---|---|---|"]
    for name, share, fine in zip(names, covered / TRIALS, smooth, strict=True):
        lines.append(f"| {name} | {share[fine].mean():.1%} | {fine.sum()} |")
    table = "\n".join(lines)
    return f"""{TRIALS} independent runs of {DRAWS} draws on {count} grasps, {TRIALS * count:,} trials,
against {TRUTH:,} other draws. Grasps whose statistic is certain (a probability of 0 or 1, a quantile
that many draws share) are left out.

{table}
"""


def forces() -> str:
    """How often forces hold in draws that were not used to find them."""
    source = read_candidates([PICKS], friction=0.6, max_force=5.0) if PICKS.is_file() else sample_grasps(HELD)
    contacts = contacts_of(columns_of(source.take(slice(0, HELD))))
    margin = 0.5 * jnp.maximum(jnp.nan_to_num(jg.largest_disturbance(contacts, PUSHES).margin), 0)
    plain = jg.least_effort(contacts, PUSHES, margin).forces
    bare = jg.margin_distribution(contacts, PUSHES, SMALL, forces=plain, margin=margin, samples=TESTED, seed=1)
    lines = [
        "| asked for | grasps with such forces | held, mean | 95 % intervals that reach it | effort over that of (22) |"
    ]
    lines += ["|---|---|---|---|---|"]
    kept = math.nan
    for probability in (0.9, 0.95):
        found = scenario_effort(contacts, PUSHES, margin, SMALL, probability, samples=TESTED)
        solved = np.asarray((found.status == jg.Status.SOLVED) & (found.known_effort > 0))
        hold, high = (np.asarray(x)[solved] for x in (found.p_hold.value, found.p_hold.high))
        ratio = np.quantile(np.asarray(found.effort / found.known_effort)[solved], [0.25, 0.5, 0.75])
        cells = f"{solved.sum()} of {len(solved)}", f"{hold.mean():.1%}", f"{(high >= probability).mean():.1%}"
        lines.append(f"| {probability:.0%} | {' | '.join(cells)} | {' / '.join(f'{x:.2f}' for x in ratio)} |")
        kept = np.asarray(bare.p_hold.value)[solved].mean()
    table = "\n".join(lines)
    return f"""Friction off by 0.05, contacts by 0.5 mm, normals by 2 degrees, mass centres by 1 mm; half of the known
margin is asked for. Held is the share of {TESTED:,} other draws. Forces of (22) for the grasp as it is known hold in
{kept:.1%}.

{table}
"""


def predictions(contacts: jg.Contacts, actuation: jg.Actuation | None, load: float) -> dict[str, np.ndarray]:
    """Everything that may predict success, by name."""
    plain = jg.largest_disturbance(contacts, PUSHES, actuation=actuation).margin
    found = jg.margin_distribution(
        contacts, PUSHES, SPEC, actuation=actuation, samples=SAMPLES, at_least=(load,), quantiles=(0.1,)
    )
    quantile = np.asarray(found.quantiles.value[:, 0])
    return {
        "plain margin": np.maximum(np.nan_to_num(np.asarray(plain)), 0),
        # Equal ones are told apart as `jaxgrasp rank --by p_hold` does.
        f"P(margin >= {load:g} N)": np.asarray(found.at_least.value[:, 0]) + 1e-9 * np.arctan(quantile),
        "10 % quantile": quantile,
        "mean of the worst 10 %": np.asarray(found.tail_mean.value),
        "mean": np.asarray(found.mean.value),
        f"P(margin >= {load:g} N), first order": np.nan_to_num(np.asarray(found.first_order.at_least[:, 0])),
    }


def success(hand: str | None, folders: list[Path]) -> str:
    """What predicts which grasps hold."""
    parts = []
    if hand:
        found = [published_grasps.candidates(hand, folder) for folder in folders]
        together = trimmed(concatenate([candidate for candidate, _ in found]))
        held = np.concatenate([table["succ_flag"].astype(bool) for _, table in found])
        objects = np.repeat([folder.name for folder in folders], [len(candidate) for candidate, _ in found])
        contacts = contacts_of(columns_of(together))
        names = ", ".join(folder.name for folder in folders)
        title = f"{len(held)} published grasps of {names}, of which {held.mean():.1%} held pushes of 1 N."
        parts.append(_areas(title, predictions(contacts, None, 1.0), held, objects))
    if PICKS.is_file():
        picks = read_candidates([PICKS], friction=0.6, max_force=5.0)
        held = picks.columns["pick_success"].astype(bool)
        title = f"{len(held)} recorded picks, of which {held.mean():.1%} held."
        parts.append(
            _areas(title, predictions(contacts_of(columns_of(picks)), None, 1.0), held, picks.columns["object_name"])
        )
    return "\n".join(parts)


def _areas(title: str, metrics: dict[str, np.ndarray], held: np.ndarray, objects: np.ndarray) -> str:
    metrics = {name: np.nan_to_num(value, neginf=-1e6) for name, value in metrics.items()}
    prediction = compare_metrics(metrics, held).prediction
    within = compare_metrics(metrics, held, within=objects).prediction
    assert prediction is not None and within is not None
    lines = [title, "", "| metric | AUC | 95 % | AUC on the same object |", "|---|---|---|---|"]
    for name, auc, (low, high), other in zip(metrics, prediction.auc, prediction.interval, within.auc, strict=True):
        lines.append(f"| {name} | {auc:.3f} | {low:.3f} to {high:.3f} | {other:.3f} |")
    return "\n".join(lines) + "\n"


HEAD = """# Numbers that are not known

Friction is off by 0.1, contacts by 2 mm along every axis, normals by 10 degrees about both tangents, mass
centres by 5 mm along every axis (standard deviations).

"""
TITLES = {
    "speed": "Time and memory",
    "intervals": "Intervals",
    "forces": "Forces that hold with a probability",
    "success": "Prediction",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hand", nargs="?", help="MJCF or URDF file, or a name")
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--only", choices=TITLES)
    given = parser.parse_args()
    sections = {"speed": speed, "intervals": intervals, "forces": forces}
    sections["success"] = lambda: success(given.hand, given.folders)
    kept = HERE.with_suffix(".json")
    found = json.loads(kept.read_text()) if kept.is_file() else {}
    for name in [given.only] if given.only else TITLES:
        found[name] = sections[name]()
        say(f"## {TITLES[name]}\n\n{found[name]}")
        kept.write_text(json.dumps(found, indent=1))
    parts = [f"## {TITLES[name]}\n\n{found[name]}" for name in TITLES if name in found]
    HERE.write_text(HEAD + "\n".join(parts))


if __name__ == "__main__":
    main()
