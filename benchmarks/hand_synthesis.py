"""Do synthesised grasps of real hands hold? `python -m benchmarks.hand_synthesis [hand ...] [--quick]`.

Grasps by gradient and random ones, closed without optimisation, are squeezed by the same rule and tried in C MuJoCo:
squeeze, gravity, six pushes. Writes hand_synthesis_HAND.md beside this file, for each hand.
"""

from __future__ import annotations

import argparse
import os
import platform
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float
from rich.progress import Progress
from scipy.stats import binomtest

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from jaxgrasp.hands import HandObject, sample_configurations  # noqa: E402
from jaxgrasp.hands.scenes import four_fingers, shadow_hand  # noqa: E402
from jaxgrasp.hands.surroundings import Surroundings  # noqa: E402
from jaxgrasp.metrics import METRICS  # noqa: E402
from jaxgrasp.ranking import compare_metrics, score  # noqa: E402
from jaxgrasp.ranking.configurations import candidates_of  # noqa: E402
from jaxgrasp.simulation import Trials, hold_trials  # noqa: E402
from jaxgrasp.synthesis import Verdict, synthesize_hand_grasps  # noqa: E402
from jaxgrasp.synthesis.hand.judgement import DEEPEST, LEAST_MARGIN, SHARE, Judgement, judged  # noqa: E402

HANDS = {"shadow_hand": shadow_hand, "four_fingers": four_fingers}
OBJECTS = ("sphere", "box", "capsule", "cylinder", "mesh")
STARTS, QUICK_STARTS = 256, 96
MORE = {"shadow_hand": 2, "four_fingers": 1}
"""So many times as many random starts: of one in fifty the Shadow Hand's fingers are not inside each other."""
SYNTHESISED, RANDOM = "synthesised", "random, closed"
JUDGED = 96
"""So many grasps of each kind on each object have all metrics computed."""
LEAST_CONTACTS, MOST = 3, 2.0
"""(22) is asked for so many times the object's weight, as far as the margin goes."""
LEFT_OUT = "ferrari_canny_linf"
"""Its hull has too many points with eight contacts; its bound is among the others."""
FORCES = jg.DisturbanceSet.forces(1.0)
Clock = dict[str, float]


@dataclass(frozen=True)
class Arm:
    """Grasps of one hand on one object, found in one way, and what became of them."""

    hand: HandObject
    judgement: Judgement
    trials: Trials
    seconds: Clock
    """Of the parts of the work, all compiled before but the search's first run; of the trial, for one grasp."""

    @property
    def checks(self) -> dict[str, Bool[np.ndarray, " n"]]:
        """What a grasp must have, one after the other."""
        found = self.judgement
        return {
            f"{LEAST_CONTACTS} contacts": found.touching >= LEAST_CONTACTS,
            f"penetration below {1e3 * DEEPEST:g} mm": np.maximum(found.penetration, found.self_penetration) <= DEEPEST,
            "positive margin": (found.status == jg.Status.SOLVED) & (found.margin > LEAST_MARGIN),
        }

    @property
    def fine(self) -> Bool[np.ndarray, " n"]:
        return self.judgement.verdict == Verdict.GOOD

    @property
    def commanded(self) -> Bool[np.ndarray, " n"]:
        """Whether (22) has an answer: only then there are squeeze commands."""
        return np.isfinite(self.judgement.controls).all(-1)


@dataclass(frozen=True)
class Share:
    """So many of so many, with Wilson's 95 % interval."""

    count: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        if not self.of:
            return 0.0, 1.0
        found = binomtest(self.count, self.of).proportion_ci(method="wilson")
        return found.low, found.high

    def __str__(self) -> str:
        if not self.of:
            return "none of 0"
        low, high = self.interval
        return f"{100 * self.count / self.of:.0f} ({100 * low:.0f}-{100 * high:.0f}) of {self.of}"

    def verdict(self, other: Share) -> str:
        """Whether this one is larger than another, for all that is known."""
        if self.interval[0] > other.interval[1]:
            return "yes"
        return "no, behind" if self.interval[1] < other.interval[0] else "no, they overlap"


def shares(arm: Arm) -> dict[str, Share]:
    fine, held = arm.fine, arm.trials.held
    return {
        "contacts, clear, positive margin": Share(int(fine.sum()), len(fine)),
        "of these held": Share(int(held[fine].sum()), int(fine.sum())),
        "all three and held": Share(int((fine & held).sum()), len(fine)),
    }


def found_by(name: str, hand: HandObject, starts: int, seed: int, tile: int) -> Float[np.ndarray, "n nq"]:
    if name == RANDOM:
        return sample_configurations(hand, starts, seed, tile=tile)
    return synthesize_hand_grasps(hand, jax.random.key(seed), starts=starts).qpos


def measure(name: str, hand: HandObject, starts: int, seed: int, tile: int) -> Arm:
    seconds: Clock = {}

    def timed(part: str, work: Callable):
        begun = time.perf_counter()
        answer = work()
        seconds[part] = time.perf_counter() - begun
        return answer

    qpos = timed("search, first", lambda: found_by(name, hand, starts, seed, tile))
    # The same once more: what is compiled now takes no time.
    timed("search", lambda: found_by(name, hand, starts, seed, tile))
    weight = hand.object_mass * float(np.linalg.norm(hand.model.opt.gravity))
    judge = lambda: judged(Surroundings.of(hand), qpos, FORCES, LEAST_CONTACTS, jnp.asarray(MOST * weight))  # noqa: E731
    judgement = judge()
    if name == SYNTHESISED:
        timed("judging", judge)
    # Of grasps that are not fine only those whose metrics are compared are tried.
    commanded = np.isfinite(judgement.controls).all(-1)
    tried = (judgement.verdict == Verdict.GOOD) | (commanded & (np.cumsum(commanded) <= JUDGED))
    controls = np.where(tried[:, None], judgement.controls, np.nan)
    hold_trials(hand, qpos[tried][:1], controls[tried][:1])
    trials = timed("trial", lambda: hold_trials(hand, qpos, controls))
    seconds["trial"] /= tried.sum()
    return Arm(hand, judgement, trials, seconds)


def values_of(arm: Arm, rows: np.ndarray, starts: int) -> dict[str, np.ndarray]:
    """Every metric of some grasps, and what else might tell those that hold from others."""
    found, values = arm.judgement, {}
    # Filled up to one size for all arms, so that programs are compiled once for a hand.
    filled = candidates_of(arm.hand, found.qpos[np.resize(rows, starts)], source="").take(np.arange(JUDGED))
    few = filled.take(np.arange(len(rows)))
    for name, metric in METRICS.items():
        if name != LEFT_OUT:
            values[name] = score(filled if metric.batched else few, name, FORCES)[: len(rows)]
    names = {"contacts": "touching", "penetration": "penetration", "self-penetration": "self_penetration"}
    return values | {name: getattr(found, of)[rows] for name, of in names.items()}


def areas(arms: dict[str, list[Arm]], starts: int, resamples: int) -> tuple[list[list[str]], list[str]]:
    """AUC by metric of squeezed grasps, of all and of those that are fine, and how many there are.

    Of each arm the first `JUDGED`.
    """
    every = [(label, arm, np.flatnonzero(arm.commanded)[:JUDGED]) for label, list_ in arms.items() for arm in list_]
    every = [(label, arm, rows) for label, arm, rows in every if len(rows)]
    parts = [values_of(arm, rows, starts) for _, arm, rows in every]
    values = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    held = np.concatenate([arm.trials.held[rows] for _, arm, rows in every])
    fine = np.concatenate([arm.fine[rows] for _, arm, rows in every])
    labels = np.repeat([label for label, _, _ in every], [len(rows) for _, _, rows in every])
    smaller = frozenset(n for n in METRICS if not METRICS[n].larger_is_better) | {"penetration", "self-penetration"}
    columns, told = [list(values)], []
    for counted in (np.ones_like(fine), fine):
        success, within = held[counted], labels[counted]
        told.append(f"{int(success.sum())} of {len(success)}")
        if not any(0 < success[within == label].sum() < np.sum(within == label) for label in np.unique(within)):
            columns.append([""] * len(values))
            continue
        some = {name: value[counted] for name, value in values.items()}
        options = {"smaller_is_better": smaller, "within": within, "resamples": resamples}
        found = compare_metrics(some, success, **options).prediction
        assert found is not None
        pairs = zip(found.auc, found.interval, strict=True)
        columns.append([f"{auc:.2f} ({low:.2f}-{high:.2f})" for auc, (low, high) in pairs])
    return [list(row) for row in zip(*columns, strict=True)], told


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header), *rows)]


def wrapped(words: str) -> str:
    return textwrap.fill(words, 120)


def text(hand: str, results: dict[str, dict[str, Arm]], starts: int, resamples: int, minutes: float) -> str:
    lines = [
        f"# Do synthesised grasps of `{hand}` hold?",
        "",
        wrapped(
            "Starts are synthesised by `synthesize_hand_grasps`, or random: `sample_configurations`, with fingers "
            "closed on an object that is turned and shifted at random; of these there are more where few have what is "
            f"wanted. Wanted are at least {LEAST_CONTACTS} contacts, "
            f"no more than {1e3 * DEEPEST:g} mm of penetration (of hand and object, and of the hand with itself) "
            "and a positive margin (21) under six unit forces with the object's weight borne and the "
            f"actuators' limits kept. Squeeze commands of both are those of (22) for {MOST:g} times the object's "
            f"weight, or for {SHARE:.0%} of the margin where that is less. `hold_trials` squeezes in C MuJoCo, lets "
            "gravity act and pushes along +-x, +-y, +-z with the object's weight; held is what stays in all of it. "
            "Shares are in per cent with 95 % intervals (Wilson)."
        ),
        "",
    ]
    rows = []
    for object, arms in results.items():
        for name, arm in arms.items():
            checks = [f"{100 * check.mean():.0f}" for check in arm.checks.values()]
            gravity = Share(int((arm.fine & arm.trials.held_gravity).sum()), int(arm.fine.sum()))
            of_all, held, both = map(str, shares(arm).values())
            rows.append([object, name, *checks, of_all, str(gravity), held, both])
    checks = list(next(iter(next(iter(results.values())).values())).checks)
    header = ["object", "starts", *checks, "all three", "of these held under gravity", "held", "three and held"]
    lines += table(header, rows) + ["", "## Are synthesised grasps ahead, with intervals that are disjoint?", ""]
    rows = []
    for object, arms in results.items():
        ours, theirs = (shares(arms[name]) for name in (SYNTHESISED, RANDOM))
        rows.append([object, *(ours[what].verdict(theirs[what]) for what in ours)])
    lines += table(["object", *ours], rows)
    lines += ["", "## What tells grasps that hold from others?", ""]
    lines += [
        wrapped(
            f"Area under the ROC curve of each metric, with 95 % bootstrap intervals ({resamples} resamples), pairs on "
            f"the same object alone: of all grasps with squeeze commands, both kinds together, of each and on each "
            f"object the first {JUDGED}; and of those of them with all three. {LEFT_OUT} is left to its bound."
        ),
        "",
    ]
    of_hand = {object: list(arms.values()) for object, arms in results.items()}
    rows, told = areas(of_hand, starts, resamples)
    header = ["metric", f"AUC, squeezed ({told[0]} hold)", f"AUC, with all three ({told[1]} hold)"]
    lines += [*table(header, rows), ""]
    lines += ["## How fast, and where the time goes", ""]
    rows = []
    for object, arms in results.items():
        arm = arms[SYNTHESISED]
        s, count = arm.seconds, len(arm.fine)
        rates = [f"{count / s['search']:.0f}", f"{arm.fine.sum() / s['search']:.0f}"]
        warm = [f"{1e3 * s[part] / count:.2f}" for part in ("search", "judging")]
        rows.append([object, *rates, f"{s['search, first'] - s['search']:.0f}", *warm, f"{1e3 * s['trial']:.0f}"])
    header = ["object", "starts a second", "good ones a second", "compiling, s", "search, ms a start"]
    lines += table([*header, "of it judging, once of twice", "trial, ms a grasp"], rows)
    lines += [
        "",
        f"{minutes:.0f} min on {platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}, jax "
        f"{jax.__version__}, mujoco {mujoco.__version__}, float64, load average {os.getloadavg()[0]:.1f} in the end. "
        f"Made by `python -m benchmarks.hand_synthesis {hand}`.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer starts, and nothing is written")
    parser.add_argument("hands", nargs="*", help=f"{', '.join(HANDS)}; all of them where none is given")
    given = parser.parse_args()
    quick, hands = given.quick, given.hands or list(HANDS)
    if not set(hands) <= set(HANDS):
        parser.error(f"hands: got {hands}, wanted some of {', '.join(HANDS)}")
    starts, resamples, begun = (QUICK_STARTS, 200, time.time()) if quick else (STARTS, 2000, time.time())
    for hand_name in hands:
        results: dict[str, dict[str, Arm]] = {}
        with Progress() as progress:
            task = progress.add_task(f"grasping with {hand_name}", total=2 * len(OBJECTS))
            for seed, object in enumerate(OBJECTS):
                hand, arms = HandObject.from_mjcf(HANDS[hand_name](object), "object", contact_distance=1e-3), {}
                for name in (SYNTHESISED, RANDOM):
                    count = starts * MORE[hand_name] if name == RANDOM else starts
                    arms[name] = measure(name, hand, count, seed, starts)
                    told = ", ".join(f"{what} {share}" for what, share in shares(arms[name]).items())
                    progress.console.print(f"{hand_name}, {object}, {name}: {told}")
                    progress.advance(task)
                results[object] = arms
        answer = text(hand_name, results, starts, resamples, (time.time() - begun) / 60)
        if not quick:
            (Path(__file__).parent / f"hand_synthesis_{hand_name}.md").write_text(answer)
        print(answer)


if __name__ == "__main__":
    main()
