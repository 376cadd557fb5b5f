"""Whether answers are true: random and degenerate lanes, each checked in NumPy that shares nothing with the package.

    python -m benchmarks.truth --dtype float64 --lanes 4000000 [--families loads ...] [--seed 1] [--record truth.jsonl]

The lanes are of the 27 families of `suite/families.py`, one in eight spoilt. Every batch is solved twice, with and
without the spoilt lanes, by `largest_disturbance` and by `least_effort` at shares of the margin found (shares above one
included). Rules are in `suite/rules.py`; lanes that their own forces and multipliers do not settle, and a random sample
of the others, go to HiGHS. With --record every batch becomes a line of that file; batches that it has are not run
again, and the report, truth.md beside this file, is of all its lines. The default form of the audit computes other
lanes anew at each call, so that some lanes count as harmed; JAXGRASP_AUDIT=strict looks at all of them.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from unittest import mock

import jax
import numpy as np

from benchmarks.suite import families, highs, lanes, rules
from benchmarks.suite.lanes import Claims, Lanes
from benchmarks.suite.rows import TOLERANCES, model
from benchmarks.suite.truth_report import faults, report, told

BATCH, CHUNK = 16_384, 4_096
SHARES = (0.0, 0.3, 0.75, 0.9, 0.99, 1.0, 1.01, 1.5)
SAMPLE = 2_000
"""Lanes a run that go to HiGHS though they are settled."""
MOST_HIGHS = 4_096
"""Lanes a batch that go to HiGHS; what is left counts as unsettled."""
ROUNDING = {"float64": 1e-12, "float32": 1e-5}
"""A neighbour is harmed where its status, or a field by more than this share of it, depends on other lanes."""


def asked_of(margins: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Margins for (22): shares of those found; where there is none, of a newton."""
    share = rng.choice(SHARES, len(margins)).astype(margins.dtype)
    return share * np.where(np.isfinite(margins), np.maximum(margins, 0), 1).astype(margins.dtype)


def examine(name: str, dtype: str, seed: tuple[int, ...], count: int, sample: int = 0) -> dict:
    """Solve one batch of a family, check it and count what was found."""
    rng = np.random.default_rng([7919, *seed])
    clock = [time.perf_counter()]
    clean = families.make(name, count, seed).rounded(dtype)
    spoilt_lanes, spoilt = lanes.spoil(clean, rng)
    alone = lanes.largest_disturbance(clean)
    asked = asked_of(alone.margin, rng)
    answers = {"margin": lanes.largest_disturbance(spoilt_lanes), "effort": lanes.least_effort(spoilt_lanes, asked)}
    without = {"margin": alone, "effort": lanes.least_effort(clean, asked)}
    clock.append(time.perf_counter())
    counts: Counter = Counter(lanes=count, spoilt=int(spoilt.sum()))
    examples: list = []
    for program, answer in answers.items():
        for status, number in zip(*np.unique(answer.status[~spoilt], return_counts=True), strict=True):
            counts[f"{program} status {status}"] = int(number)
        bits, harmed = (answer.differs(without[program], t)[~spoilt] for t in (None, ROUNDING[dtype]))
        counts[f"{program} bits differ"], counts[f"{program} harmed"] = int(bits.sum()), int(harmed.sum())
        shown = answer[spoilt]
        hidden = (shown.status == rules.INVALID) & np.isnan(shown.margin) & np.isnan(shown.forces).all((1, 2))
        counts[f"{program} invalid"] = int((~hidden).sum())
    sound = np.flatnonzero(~spoilt)
    for start in range(0, len(sound), CHUNK):
        rows = sound[start : start + CHUNK]
        own = {program: answer[rows] for program, answer in answers.items()}
        found = check(clean[rows], own, asked[rows], dtype)
        share = -(-sample * len(rows) // len(sound))
        counts += ask_highs(found, own["margin"], dtype, rng, share)
        tally(found, rows, counts, examples)
    clock.append(time.perf_counter())
    return {
        "family": name,
        "dtype": dtype,
        "seed": list(seed),
        "seconds": np.diff(clock).round(3).tolist(),
        "counts": {k: v for k, v in counts.items() if v},
        "examples": examples[:8],
    }


def check(clean: Lanes, answers: dict[str, Claims], asked: np.ndarray, dtype: str) -> dict:
    """The findings of both programs, and the model, of sound lanes."""
    tolerances = TOLERANCES[dtype]
    claims = {program: answer.wide() for program, answer in answers.items()}
    # What nobody uses may be anything, and so may what is beyond float64.
    with np.errstate(all="ignore"):
        m = model(clean, answers["margin"].rank, tolerances)
        margin, optimum = rules.margins(m, claims["margin"], tolerances)
        effort = rules.efforts(m, claims["effort"], asked.astype(np.float64), optimum, tolerances)
    return {"model": m, "margin": margin, "effort": effort}


def ask_highs(found: dict, claims: Claims, dtype: str, rng: np.random.Generator, sample: int) -> Counter:
    """HiGHS settles what is open, and a random sample: sets `value` and `false_status` of the margins' findings."""
    m, margin = found["model"], found["margin"]
    told = (margin.solved | (claims.status == rules.INFEASIBLE)) & ~m.doubtful
    unsettled, settled = np.flatnonzero(margin.open), np.flatnonzero(told & ~margin.open)
    drawn = rng.choice(settled, min(sample, len(settled)), replace=False)
    chosen = np.concatenate([unsettled[:MOST_HIGHS], drawn])
    if not len(chosen):
        return Counter()
    with np.errstate(all="ignore"):
        optimum, unknown = highs.optima(m[chosen])
        own = claims[chosen].wide()
        unit = TOLERANCES[dtype].margin * m[chosen].mean_force
        off = np.maximum(np.abs(own.margin - optimum), np.abs(own.upper_bound - optimum))
    margin.value[chosen] |= margin.solved[chosen] & ~unknown & ~(off <= unit)
    margin.false_status[chosen] |= (own.status == rules.INFEASIBLE) & ~unknown & (optimum > unit)
    unanswered = int(unknown.sum()) + max(0, len(unsettled) - MOST_HIGHS)
    return Counter({"highs open": len(unsettled), "highs sample": len(drawn), "unsettled": unanswered})


RULES = ("invalid", "balance", "rows", "value", "crossed", "false_status", "suboptimal", "rounding")


def tally(found: dict, rows: np.ndarray, counts: Counter, examples: list) -> None:
    """Add findings to counts; of every rule, lanes in doubt apart."""
    doubtful = found["model"].doubtful
    counts["doubtful"] += int(doubtful.sum())
    for program in ("margin", "effort"):
        findings = found[program]
        counts[f"{program} solved"] += int(findings.solved.sum())
        counts[f"{program} wrong"] += int((findings.wrong & ~doubtful).sum())
        counts[f"{program} wrong, rank in doubt"] += int((findings.wrong & doubtful).sum())
        for rule in RULES:
            bad = getattr(findings, rule)
            if bad.size:
                counts[f"{program} {rule}"] += int(bad.sum())
                if rule != "rounding":
                    examples += [[program, rule, int(rows[k])] for k in np.flatnonzero(bad)[:2]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dtype", choices=list(TOLERANCES), default="float64")
    parser.add_argument("--lanes", type=int, default=4_000_000, help="of all families together")
    parser.add_argument("--families", nargs="+", default=list(families.FAMILIES), choices=list(families.FAMILIES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", type=int, default=BATCH, help="lanes solved at once, at least")
    parser.add_argument("--workers", type=int, default=1, help="families at once")
    parser.add_argument("--record", type=Path, help="a file of lines of JSON, a batch each; goes on where it ends")
    options = parser.parse_args()
    lines = read(options.record)
    # An audit that fails has consequences for its whole process: every family has one of its own.
    own = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.workers, mp_context=own, max_tasks_per_child=1) as pool:
        for found in pool.map(partial(run, options, known(lines)), options.families):
            lines += found
    text = report(lines)
    Path(__file__).with_suffix(".md").write_text(text)
    print(text)
    sys.exit(int(any(faults(line) for line in lines)))


def run(options: argparse.Namespace, done: set, family: str) -> list[dict]:
    """All batches of a family that are not done yet."""
    jax.config.update("jax_enable_x64", True)
    together = len(options.families)
    batches = max(1, options.lanes // (options.batch * together))
    count = -(-options.lanes // (64 * batches * together)) * 64
    sample = -(-SAMPLE // (batches * together))
    lines = []
    # Both programs are traced before the first audit, for one that fails has XLA run whatever is traced later.
    with mock.patch.dict(os.environ, JAXGRASP_AUDIT="off"):
        first = families.make(family, count, (options.seed, 0)).rounded(options.dtype)
        lanes.least_effort(first, lanes.largest_disturbance(first).margin)
    for batch in range(batches):
        if (options.dtype, family, options.seed, batch, count) in done:
            continue
        lines.append(examine(family, options.dtype, (options.seed, batch), count, sample))
        print(told(lines[-1]), flush=True)
        if options.record is not None:
            with options.record.open("a") as record:
                record.write(json.dumps(lines[-1]) + "\n")
    return lines


def known(lines: list[dict]) -> set:
    """What tells batches apart."""
    return {(line["dtype"], line["family"], *line["seed"], line["counts"]["lanes"]) for line in lines}


def read(record: Path | None) -> list[dict]:
    """The lines of a record; none where there is none yet."""
    return [json.loads(line) for line in record.read_text().splitlines()] if record and record.exists() else []


if __name__ == "__main__":
    main()
