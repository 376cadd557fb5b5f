"""What each approximation of the paper's chain costs, and how fast its programs are.

`python -m benchmarks.formulations` writes formulations.md and formulations.png beside this file. formulations.json
keeps what was measured; `--parts margins,edges,speed,compiling` measures some of it anew. The recorded grasps are taken
where they are present.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import chain, chain_peers  # noqa: E402
from benchmarks.suite.clock import by_turns, say, warn_if_busy  # noqa: E402
from benchmarks.suite.fresh import spent  # noqa: E402
from benchmarks.suite.workers import Workers  # noqa: E402
from jaxgrasp.robustness.chain.comparison import STEPS  # noqa: E402

HERE = Path(__file__).parent
KEPT = HERE / "formulations.json"
# n_c, n_d, grasps; the recorded ones come on top.
SHAPES = (
    *((2, 6, 200), (2, 24, 150), (3, 6, 250), (3, 24, 150), (4, 6, 590), (4, 24, 150)),
    *((5, 6, 200), (5, 24, 200), (5, 64, 100), (8, 6, 200), (8, 24, 150), (8, 64, 150)),
)
# Of these the table has what each step costs.
COSTS = ("recorded, 4 contacts, 6 directions", "random, 4 contacts, 6 directions", "random, 8 contacts, 64 directions")
EDGES = (4, 8, 16, 32, 64)
PART = 590
TIMED, ROUNDS = 512, 3


def contacts_of(batch: chain.Batch) -> jg.Contacts:
    return jg.Contacts.from_frames(batch.positions, batch.frames, friction=batch.friction, max_force=batch.max_force)


def compared(batch: chain.Batch) -> jg.Comparison:
    """In parts of one size, which are compiled once."""
    parts = []
    for start in range(0, len(batch), PART):
        part = batch[start : start + PART]
        vertices = jg.DisturbanceSet.vertices(part.wrenches)
        found = jg.compare_formulations(contacts_of(part), vertices, part.load)
        parts.append(jax.tree.map(np.asarray, found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def families() -> dict[str, chain.Batch]:
    recorded = chain.recorded()
    found = {} if recorded is None else {"recorded, 4 contacts, 6 directions": recorded}
    return found | {f"random, {c} contacts, {d} directions": chain.sample(100 * c + d, n, c, d) for c, d, n in SHAPES}


def margins() -> dict:
    """Every formulation against whole programs in HiGHS and Clarabel, and what is left of the margin by each step.

    Families that are in formulations.json already are left as they are.
    """
    table, left = (kept().get(key, {}) for key in ("accuracy", "costs"))
    for family, batch in families().items():
        if family in left:
            continue
        start = time.perf_counter()
        found = compared(batch)
        say(f"  {family}: ours in {time.perf_counter() - start:.0f} s")
        left[family] = cost(found, batch)
        cases = [batch.case(i) for i in range(len(batch))]
        units = np.array([case.scale for case in cases])
        for name, oracle in chain.ORACLES.items():
            truth = np.array([oracle(case) for case in cases])
            known, margin = ~np.isinf(truth), found.margins[name]
            error = np.where(known & np.isfinite(truth), np.abs(margin - truth) / np.fmax(truth, units), 0)
            wrong = known & (np.isnan(truth) != np.isnan(margin))
            record(table, name, family, found.statuses[name], error, known, wrong)
        most = found.margins["13"]
        asked = np.where(np.isfinite(most), most * np.random.default_rng(0).uniform(0.1, 1.1, len(batch)), 1.0)
        vertices = jg.DisturbanceSet.vertices(batch.wrenches)
        effort = jg.least_total_effort(contacts_of(batch), vertices, asked, batch.load)
        truth = np.array([chain.least_total_effort(case, a) for case, a in zip(cases, asked, strict=True)])
        # At the edge of what can be had either answer will do; zero is one that both know.
        edge = (np.abs(asked - most) <= 1e-4 * np.maximum(1, most)) & (asked > 0)
        known = ~np.isnan(truth) & ~edge
        ours = np.asarray(effort.effort)
        size = np.maximum(truth, 1e-3 * batch.max_force.max(-1) ** 2)
        error = np.where(known & np.isfinite(truth), np.abs(ours - np.where(np.isinf(truth), 0, truth)) / size, 0)
        wrong = known & (np.isinf(truth) != np.isnan(ours))
        record(table, "11", family, np.asarray(effort.status), error, known, wrong)
        worst = ", ".join(f"{n} {t[family]['error']:.1e}" for n, t in table.items())
        say(f"  {family}: {time.perf_counter() - start:.0f} s, worst {worst}")
        keep({"accuracy": table, "costs": left})
    return {}


def record(table: dict, name: str, family: str, status, error, known, wrong) -> None:
    decided = (status == jg.Status.SOLVED) | (status == jg.Status.INFEASIBLE)
    for what, rows in (("undecided", ~decided), ("feasibility otherwise", wrong), ("far", ~wrong & (error > 1e-6))):
        if rows.any():
            say(f"    {name}: {what} {np.flatnonzero(rows).tolist()}")
    table.setdefault(name, {})[family] = {
        "grasps": len(status),
        "decided": int(decided.sum()),
        "judged": int(known.sum()),
        "wrong": int(wrong.sum()),
        "answers": int((status == jg.Status.SOLVED).sum()),
        "error": float(np.nanmax(np.where(wrong, 0, error))),
    }


def cost(found: jg.Comparison, batch: chain.Batch) -> dict:
    """Quartiles of the ratio of neighbours in the chain, over the grasps with a margin."""
    deficient = (chain.projections(batch.positions, batch.frames) != np.eye(6)).any((1, 2))
    margins = found.margins
    some = margins["21"] > 1e-3 * np.nanmax(margins["21"])
    pairs = STEPS | {"all of it": ("12", "21")}
    ratio = lambda more, less: np.quantile(margins[less][some] / margins[more][some], [0.25, 0.5, 0.75]).tolist()  # noqa: E731
    ratios = {step: ratio(*pair) for step, pair in pairs.items()} if some.any() else {}
    counts = {"counted": int(some.sum()), "grasps": len(batch), "deficient": int(deficient.sum())}
    return counts | {"margin": int((deficient & (margins["21"] > 0)).sum()), "ratios": ratios}


def edges() -> dict:
    """Shortfall of the pyramids' margins over their number of edges."""
    batch = chain.sample(77, 256, 4, 6)
    vertices = jg.DisturbanceSet.vertices(batch.wrenches)
    ask = lambda name, n=8: np.asarray(  # noqa: E731
        jg.formulation_margin(contacts_of(batch), vertices, name, batch.load, cone_edges=n).margin
    )
    limit, rows = ask("12"), []
    some = np.isfinite(limit) & (limit > 0.1)
    for n in EDGES:
        margin = ask("13", n)
        short = 1 - np.where(np.isfinite(margin), margin, 0)[some] / limit[some]
        rows.append(np.quantile(short, [0.5, 0.95, 1.0]).tolist())
        say(f"  {n} edges: short by {rows[-1]}")
    fit = np.array(EDGES) >= 8
    rate = -np.polyfit(np.log(np.array(EDGES)[fit]), np.log(np.array(rows)[fit, 0]), 1)[0]
    return {"edges": {"edges": EDGES, "short": rows, "rate": float(rate), "counted": int(some.sum())}}


def speed() -> dict:
    """Grasps a second by every formulation, and of the peers, in one run by turns."""
    load = warn_if_busy()
    many = chain.sample(5, 8 * TIMED, 4, 6)
    # Peers' updates want one friction and bound; nothing is lost without load and degenerate contacts.
    batch = many[(np.arange(len(many)) % 8 > 2) & (np.arange(len(many)) % 3 == 0)]
    batch = replace(batch, friction=np.full_like(batch.friction, 0.6), max_force=np.full_like(batch.max_force, 5.0))
    contacts, vertices = contacts_of(batch), jg.DisturbanceSet.vertices(batch.wrenches)
    asked = 0.75 * np.asarray(jg.formulation_margin(contacts, vertices, "13").margin)
    ours = {name: lambda name=name: jg.formulation_margin(contacts, vertices, name).margin for name in chain.ORACLES}
    ours["11"] = lambda: jg.least_total_effort(contacts, vertices, asked).effort
    ours["21"] = lambda: jg.largest_disturbance(contacts, vertices).margin
    jobs, answers, peers = {}, {}, {}

    def add(name: str) -> None:
        def job() -> None:
            answers[name] = np.asarray(ours[name]())

        jobs[f"{name}: jaxgrasp"] = job

    with Workers(os.cpu_count() or 1) as workers:
        for name in ours:
            add(name)
            for label in chain_peers.PEERS.get(name, ()):
                part = lambda rows, name=name, label=label: (batch[rows], name, label, asked[rows])  # noqa: E731
                peers[name, label] = workers.spread(f"{name} {label}", chain_peers.solver, len(batch), part)
                jobs[f"{name}: {label}"] = peers[name, label].run
        timings = by_turns(jobs, ROUNDS)
    table: dict[str, dict] = {}
    found = {(name, "jaxgrasp"): value for name, value in answers.items()}
    for (name, label), values in (found | {key: loaded.answers for key, loaded in peers.items()}).items():
        error = np.abs(values - answers[name]) / np.maximum(1, np.abs(answers[name]))
        table.setdefault(name, {})[label] = {
            "per second": len(batch) / timings[f"{name}: {label}"].seconds,
            "cpu": timings[f"{name}: {label}"].cpu_per_wall,
            "solved": float(np.isfinite(values).mean()),
            "apart": float(np.nanmax(error)),
        }
    return {"speed": {"grasps": len(batch), "load": load, "table": table}}


def compiling() -> dict:
    """Seconds to the first answer of a fresh process, less those of imports: nothing compiled before, then kernels."""
    load, rows = warn_if_busy(), {}
    imports = spent(["-m", "benchmarks.suite.first", "nothing", "float64", "64"])[0]
    asked = [(name, f"formulation {name}") for name in chain.ORACLES]
    before = os.environ.get("XDG_CACHE_HOME")
    for name, how in [*asked, ("11", "total effort"), ("all but (11), (21) included", "comparison")]:
        with tempfile.TemporaryDirectory() as folder:
            os.environ["XDG_CACHE_HOME"] = folder
            rows[name] = [spent(["-m", "benchmarks.suite.first", how, "float64", "64"])[0] - imports for _ in range(2)]
        say(f"  {name}: {rows[name][0]:.1f} s, {rows[name][1]:.1f} s with kernels on disk")
    del os.environ["XDG_CACHE_HOME"]
    os.environ.update({} if before is None else {"XDG_CACHE_HOME": before})
    return {"compiling": {"rows": rows, "load": load}}


def figure(found: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    left, right = plt.subplots(1, 2, figsize=(11, 4.2))[1]
    n = np.array(found["edges"]["edges"])
    rows = np.array(found["edges"]["short"])
    left.loglog(n, rows[:, 0], "o-", label=f"median, n$^{{-{found['edges']['rate']:.2f}}}$ from eight edges on")
    left.loglog(n, rows[:, 1], "^:", color="C0", label="95th percentile", alpha=0.6)
    left.loglog(n, rows[1, 0] * (n / 8.0) ** -2, "k--", lw=0.8, label="n$^{-2}$")
    left.set_xlabel("edges of the pyramid")
    left.set_ylabel("shortfall of (13) against (12)")
    left.set_xticks(n, [str(k) for k in n])
    left.minorticks_off()
    left.legend(fontsize=8)
    left.grid(alpha=0.3)

    family = next(iter(found["costs"]))
    ratios = found["costs"][family]["ratios"]
    names = list(ratios)
    middle = np.array([ratios[name] for name in names])
    place = np.arange(len(names))[::-1]
    right.barh(place, middle[:, 1], color="C2", alpha=0.7)
    right.errorbar(
        middle[:, 1], place, xerr=np.abs(middle[:, [0, 2]] - middle[:, 1:2]).T, fmt="none", color="k", capsize=3
    )
    right.set_yticks(place, names, fontsize=8)
    right.set_xlim(0, 1.05)
    right.set_xlabel("margin left by the step (quartiles)")
    right.set_title(family, fontsize=9)
    right.grid(alpha=0.3, axis="x")
    plt.tight_layout()
    plt.savefig(HERE / "formulations.png", dpi=110)


def text(found: dict) -> str:
    lines = ["# Every formulation of the paper, side by side", ""]
    if "accuracy" in found:
        lines += [
            "## Against HiGHS and Clarabel",
            "",
            "Whole programs: (12) and (13) with the forces of all directions, (16) with the rows of all. Random grasps",
            "without and with load, some on one side, with a contact twice or with all contacts in line (half of those",
            "with wrenches in the range of G), and the recorded ones. Errors are of max(margin, natural scale); those",
            "of (11) are of max(effort, f_max^2 / 1000). (12) has the bound of (8).",
            "`decided` is solved or proved infeasible; `judged` where the other solver has an answer, too (in (11) the",
            "margins asked for are random shares of (13)'s, some above it; those within 1e-4 of it are not judged).",
            "",
            "| formulation | grasps | decided | solved | judged | feasibility otherwise | worst error |",
            "|---|---|---|---|---|---|---|",
        ]
        names = list(found["accuracy"])
        for name in names:
            own = found["accuracy"][name].values()
            counts = [sum(r[key] for r in own) for key in ("grasps", "decided", "answers", "judged", "wrong")]
            lines.append(
                f"| {name} | " + " | ".join(f"{n:,}" for n in counts) + f" | {max(r['error'] for r in own):.1e} |"
            )
        lines += [
            "",
            "Worst errors by family; how many have a G of rank below six, and how many of these have a margin:",
            "",
            "| family | grasps | of low rank | with margin | " + " | ".join(names) + " |",
            "|---|---|---|---|" + "---|" * len(names),
        ]
        for family, r in found["costs"].items():
            errors = (f"{found['accuracy'][name][family]['error']:.0e}" for name in names)
            lines.append(
                f"| {family} | {r['grasps']} | {r['deficient']} | {r['margin']} | " + " | ".join(errors) + " |"
            )
        lines.append("")
    if "costs" in found:
        families = {family: r for family, r in found["costs"].items() if family in COSTS}
        lines += [
            "## What each step costs",
            "",
            "Quartiles of the ratio of the margin after to that before the step, eight edges, normal forces bounded in",
            "all, over the grasps whose margin (21) is above a thousandth of the largest.",
            "",
            "| step | " + " | ".join(f"{f} ({r['counted']} of {r['grasps']})" for f, r in families.items()) + " |",
            "|---|" + "---|" * len(families),
        ]
        for step in next(iter(families.values()))["ratios"]:
            cells = (" / ".join(f"{v:.3f}" for v in r["ratios"][step]) for r in families.values())
            names = "" if step not in STEPS else " ({1} for {0})".format(*STEPS[step])
            lines.append(f"| {step}{names} | " + " | ".join(cells) + " |")
        lines.append("")
    if "edges" in found:
        e = found["edges"]
        lines += [
            "## Pyramids tend to cones",
            "",
            f"Shortfall of (13) against (12) for {e['counted']} random grasps, four contacts, six directions. From",
            f"eight edges on the median falls with the edges to the power {-e['rate']:.2f}.",
            "",
            "| edges | median | 95th percentile | most |",
            "|---|---|---|---|",
        ]
        for n, row in zip(e["edges"], e["short"], strict=True):
            lines.append(f"| {n} | " + " | ".join(f"{100 * v:.3f} %" for v in row) + " |")
        lines += ["", "![Shortfall over edges, and what the steps leave](formulations.png)", ""]
    if "speed" in found:
        s = found["speed"]
        lines += [
            "## Grasps a second",
            "",
            f"{s['grasps']} random grasps, four contacts, six directions, eight edges, no load; warm, by turns,",
            f"best of {ROUNDS}. Peers run in a process a core and have their programs ready made, one a direction",
            "where answers are free, and tolerance 1e-6; ours makes them from contacts, to 1e-9, with bounds. In",
            "brackets: share solved, how far from ours at most, of max(1, margin).",
            "",
            "| formulation | jaxgrasp | best peer | times | all peers |",
            "|---|---|---|---|---|",
        ]
        for name, r in s["table"].items():
            ours = r["jaxgrasp"]["per second"]
            others = {k: v for k, v in r.items() if k != "jaxgrasp"}
            cells = ", ".join(
                f"{k} {v['per second']:,.0f} ({100 * v['solved']:.0f} %, {v['apart']:.0e})" for k, v in others.items()
            )
            best = max(others, key=lambda k: others[k]["per second"]) if others else None
            factor = "" if best is None else f"{ours / others[best]['per second']:.1f}"
            lines.append(f"| {name} | {ours:,.0f} | {best or ''} | {factor} | {cells} |")
        lines += ["", f"Load average before: {s['load']:.1f}.", ""]
    if "compiling" in found:
        lines += [
            "## The first answer",
            "",
            "Seconds that a fresh process takes for 64 grasps, four contacts, six directions, float64, less imports.",
            "",
            "| formulation | nothing compiled before | kernels on disk |",
            "|---|---|---|",
        ]
        lines += [f"| {name} | {cold:.1f} | {warm:.1f} |" for name, (cold, warm) in found["compiling"]["rows"].items()]
        lines += ["", f"Load average before: {found['compiling']['load']:.1f}.", ""]
    lines += [
        f"{platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}, jax {jax.__version__}. Made by "
        "`python -m benchmarks.formulations`.",
        "",
    ]
    return "\n".join(lines)


def kept() -> dict:
    """What was measured so far."""
    return json.loads(KEPT.read_text()) if KEPT.exists() else {}


def keep(more: dict) -> None:
    """Add to what was measured, and write it out."""
    found = kept() | more
    KEPT.write_text(json.dumps(found, indent=1) + "\n")
    (HERE / "formulations.md").write_text(text(found))
    if {"edges", "costs"} <= set(found):
        figure(found)


PARTS = {"margins": margins, "edges": edges, "speed": speed, "compiling": compiling}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default="margins,edges,speed,compiling")
    for part in parser.parse_args().parts.split(","):
        say(part)
        start = time.perf_counter()
        keep(PARTS[part]())
        say(f"  {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
