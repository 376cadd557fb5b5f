"""Figures as a table to read and as JSON, with where and with what they were taken."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import jax

Row = dict[str, Any]
PACKAGES = ("jaxgrasp", "jax", "jaxlib", "numpy", "scipy", "clarabel", "piqp", "proxsuite", "osqp", "qpax")

HOW = """
Random grasps of an ellipsoid, friction 0.8, 2 N a finger, pyramids of eight edges, six unit forces, nothing to be
borne. One program is the largest disturbance (21) of one grasp. **jaxgrasp** starts from the contacts and returns its
whole solution, certificates included, spread over the devices by `shard_map`. The **others** get the scaled and
orthonormalised programs ready made in the layout that they want, and keep a warm workspace, updated with the next
program's numbers: Clarabel, PIQP and OSQP by `update`, ProxQP by `update` or (parallel) by its own batch on two
threads, HiGHS as many programs side by side in one call of SciPy as is fastest, qpax by `vmap`. All but the parallel
one run in two processes, each with half of the programs. They are timed on a subsample, given as programs. Tolerances
are the loosest at which lambda is right to 1e-6: 1e-6 for all but HiGHS (1e-7), qpax in float32 (1e-5, its implicit
method; the explicit one ends nowhere there) and jaxgrasp (its defaults). qpax in float64 is not quite as accurate,
and at 1e-7 it leaves a third of the programs unsolved. All take an LP as it is, without any regularisation beside
their own; ProxQP with a proximal step of 1e-3 and infeasibility tolerances of 1e-8, since its defaults call a share
of these programs infeasible; OSQP stops after 20,000 iterations. `solved` is what the solver calls solved; errors are
against HiGHS at 1e-10, relative to max(Lambda, |lambda|), and `right` is the share within 1e-6. Times are the best of
several rounds, all jobs of a table by turns, warm, compilation apart (two programs at a time but for the first
table); rounds that took 15 % longer than the best count as noisy. `cpu/wall` is the processor time a second: two
where both cores worked. Fresh processes come first, while nothing else runs; the first answer is that of
`largest_disturbance` for 64 grasps. A solver whose version is not listed was not installed. The peak for S_1 and S_2 is
what a large matrix product of NumPy reaches by turns with them.
"""


def machine() -> Row:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "date": datetime.date.today().isoformat(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(memory, 1),
        "devices": [f"{device.device_kind} device" for device in jax.local_devices()],
        "python": platform.python_version(),
        "versions": versions,
    }


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.is_file():
        names = [line.split(":", 1)[1].strip() for line in information.read_text().splitlines() if "model name" in line]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def targets(results: Row) -> list[Row]:
    """What was aimed at, with what was reached; what could not be measured is left out."""
    rate = {row["solver"]: row["per_s"] for row in results["headline"]}
    time = {(row["dtype"], row["n_c"], row["batch"]): 1 / row["per_s"] for row in results["scaling"]}
    found: list[Row] = []

    def add(what: str, value: float, goal: float, at_least: bool) -> None:
        met = value >= goal if at_least else value <= goal
        found.append({"what": what, "value": value, "goal": f"{'>=' if at_least else '<='} {goal:g}", "met": met})

    piqp = "PIQP dense, two processes"
    for dtype, share in (("float64", 0.15), ("float32", 0.20)):
        if f"C++ floor {dtype}" in rate:
            add(
                f"rate over the C++ floor's, {dtype}",
                rate[f"jaxgrasp {dtype}"] / rate[f"C++ floor {dtype}"],
                share,
                True,
            )
    if piqp in rate:
        add("rate over PIQP's in two processes, float64", rate["jaxgrasp float64"] / rate[piqp], 5.0, True)
    for dtype in ("float64", "float32"):
        add(
            f"time of vmap over the direct batch's, {dtype}",
            rate[f"jaxgrasp {dtype}"] / rate[f"jaxgrasp {dtype}, vmap"],
            1.2,
            False,
        )
    for dtype in ("float64", "float32"):
        if (dtype, 20, 4096) in time:
            growth = time[dtype, 20, 4096] / time[dtype, 4, 4096] / 5
            add(f"time from 4 to 20 contacts over five times, {dtype}", growth, 1.3, False)
    for row in results["worst_cases"]:
        if row["directions"] == 4096 and row["dtype"] == "float32":
            add("S_1/S_2, 4096 directions, share of the peak, float32", row["share_of_peak"], 0.35, True)
    for row in results["processes"]:
        if row["what"].startswith("first answer"):
            add(f"{row['what']}, s", row["seconds"], 6.0, False)
        if row["what"].startswith("jaxgrasp rank"):
            add(f"{row['what']}, MiB", row["peak_mib"], 2048.0, False)
    return found


def markdown(results: Row) -> str:
    about = results["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items() if version)
    lines = [
        "# Benchmark",
        "",
        f"{about['date']}, {about['processor']}, {about['cores']} cores, {about['memory_gib']} GiB, "
        f"{len(about['devices'])} x {about['devices'][0]}. Python {about['python']}, {versions}.",
        f"Load average at the start {results['load_average']:.1f}. Made by `python -m benchmarks.run"
        + (" --quick`." if results["quick"] else "`."),
        HOW.rstrip(),
    ]
    if results["load_average"] > 0.5:
        lines += ["", "**The machine was not idle: take no time from this table.**"]
    for key, title in TITLES.items():
        lines += ["", f"## {title}", "", *_table(results[key])]
    return "\n".join(lines) + "\n"


TITLES = {
    "targets": "Aims",
    "headline": "Contacts to margins, four contacts, by turns",
    "against_peers": "Every solver",
    "scaling": "Batch sizes and numbers of contacts",
    "worst_cases": "S_1 and S_2 (17), (18), four contacts, shared directions",
    "processes": "Fresh processes, from start to exit",
}
HEADINGS = {
    "per_s": "per second",
    "cpu_per_wall": "cpu/wall",
    "worst_error": "worst error",
    "within_1e-6": "right",
    "compile_s": "compile, s",
    "peak_mib": "peak, MiB",
    "gflops": "GFLOP/s",
    "peak_gflops": "peak GFLOP/s",
    "share_of_peak": "share of peak",
    "discarded": "noisy",
}


def _table(rows: list[Row]) -> list[str]:
    if not rows:
        return ["Not measured."]
    keys = list(rows[0])
    heading = "| " + " | ".join(HEADINGS.get(key, key) for key in keys) + " |"
    return [
        heading,
        "|" + "---|" * len(keys),
        *("| " + " | ".join(_cell(k, row[k]) for k in keys) + " |" for row in rows),
    ]


def _cell(key: str, value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key in ("solved", "within_1e-6"):
        return f"{100 * value:.2f} %"
    if key == "worst_error":
        return f"{value:.0e}"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)
