"""What is timed: each function compares what belongs together, by turns, and returns rows of plain numbers."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np

import jaxgrasp as jg
from benchmarks.suite import floor, ours, peers, problems
from benchmarks.suite.clock import Job, Timing, by_turns, say
from benchmarks.suite.workers import Loaded, Workers

Row = dict[str, Any]
DTYPES = ("float64", "float32")
PROCESSES = 2
# Grasps wherever numbers of contacts are compared.
BATCH = 4096
# Smaller batches go to one device.
LEAST_SPREAD = 256
# Programs on which a peer is timed with four contacts; fewer with more. Its time a program does not depend on that.
SUBSAMPLE = {
    "highs": 512,
    "clarabel": 1024,
    "piqp_dense": 2048,
    "piqp_sparse": 2048,
    "proxqp": 512,
    "proxqp_parallel": 512,
    "osqp": 32,
    "qpax_float64": 1024,
    "qpax_float32": 1024,
    "reference": 1024,
}


@dataclass(frozen=True)
class Sizes:
    n_c: tuple[int, ...] = (3, 4, 5, 8, 12, 20)
    batch: int = 16_384
    ladder: tuple[int, ...] = (1, 16, 256, 4096, 16_384, 65_536)
    directions: tuple[int, ...] = (6, 64, 512, 4096)
    rounds: int = 7
    peer_rounds: int = 3
    alone: bool = True
    """Time one device, too."""

    def shapes(self) -> list[tuple[int, int]]:
        """(n_c, batch) of what is timed of ours by itself."""
        return sorted({(4, batch) for batch in self.ladder} | {(n_c, BATCH) for n_c in (4, *self.n_c)})


QUICK = Sizes(n_c=(4,), batch=BATCH, ladder=(BATCH,), directions=(4096,), rounds=5, peer_rounds=2, alone=False)


def devices() -> int:
    return len(jax.local_devices())


def headline(sizes: Sizes, workers: Workers) -> list[Row]:
    """Contacts to margins: ours, the same under vmap and on one device, the C++ floor, PIQP in two processes."""
    say(f"Contacts to margins, n_c = 4, batch {sizes.batch}")
    grasps = problems.sample(sizes.batch, 4)
    programs = problems.programs(grasps)
    reference = _reference(workers, programs)
    jobs: dict[str, Job] = {}
    margins, compiled, counts = {}, {}, {}
    library = floor.build()
    if isinstance(library, str):
        say(f"  no C++ floor: {library}")
    for dtype in DTYPES:
        variants = {"": (devices(), False), ", vmap": (devices(), True), ", one device": (1, False)}
        if devices() == 1 or not sizes.alone:
            variants.pop(", one device")
        for name, (count, mapped) in variants.items():
            it = compiled[f"jaxgrasp {dtype}{name}"] = ours.margins(4, sizes.batch, dtype, count, mapped=mapped)
            jobs[f"jaxgrasp {dtype}{name}"] = it.run
        if not isinstance(library, str):
            it = floor.Floor(library, grasps, programs, dtype)
            jobs[f"C++ floor {dtype}"] = it.run
            margins[f"C++ floor {dtype}"] = it
    if find_spec("piqp"):
        piqp = workers.load("piqp_dense", programs[: SUBSAMPLE["piqp_dense"]])
        jobs["PIQP dense, two processes"], counts["PIQP dense, two processes"] = piqp.run, piqp.count
    timings = by_turns(jobs, sizes.rounds)
    rows = []
    for name, timing in timings.items():
        if name in compiled:
            answers = _scaled(compiled[name], programs)
        elif name in margins:
            answers = margins[name].margin / programs.scale
        else:
            answers = piqp.answers
        seconds = compiled[name].compile_seconds if name in compiled else None
        rows.append(_row(name, timing, counts.get(name, sizes.batch), answers, reference, seconds))
    return rows


def prepare(sizes: Sizes) -> None:
    """Compile what the next sections need, two at a time: one after the other takes most of the whole run."""
    say("Compiling")
    with ThreadPoolExecutor(2) as pool:
        waiting = [
            pool.submit(ours.margins, n_c, batch, dtype, _spread(batch), mapped=False)
            for n_c, batch in sizes.shapes()
            for dtype in DTYPES
        ]
    for it in waiting:
        it.result()


def against_peers(sizes: Sizes, workers: Workers) -> list[Row]:
    """Every solver at every number of contacts, on the same programs."""
    rows = []
    for n_c in sizes.n_c:
        say(f"Every solver, n_c = {n_c}")
        programs = problems.programs(problems.sample(BATCH, n_c))
        reference = _reference(workers, programs)
        jobs: dict[str, Job] = {}
        compiled: dict[str, ours.Compiled] = {}
        loaded: dict[str, Loaded] = {}
        for dtype in DTYPES:
            compiled[f"jaxgrasp {dtype}"] = ours.margins(n_c, BATCH, dtype, devices(), mapped=False)
        for peer, distribution in peers.PEERS.items():
            if find_spec(distribution):
                loaded[peer] = workers.load(peer, programs[: _count(peer, n_c)])
        jobs |= {name: it.run for name, it in compiled.items()} | {name: it.run for name, it in loaded.items()}
        timings = by_turns(jobs, sizes.peer_rounds)
        for name, timing in timings.items():
            if name in compiled:
                answers, seconds = _scaled(compiled[name], programs), compiled[name].compile_seconds
            else:
                answers = loaded[name].answers
                seconds = loaded[name].setup_seconds if "qpax" in name else None
            rows.append({"n_c": n_c, **_row(name, timing, len(answers), answers, reference, seconds)})
    return rows


def scaling(sizes: Sizes) -> list[Row]:
    """Ours alone: batch sizes at four contacts and numbers of contacts at one batch size, all by turns."""
    say("Batch sizes and numbers of contacts")
    jobs: dict[str, Job] = {}
    about: dict[str, Row] = {}
    for dtype in DTYPES:
        for n_c, batch in sizes.shapes():
            spread = _spread(batch)
            compiled = ours.margins(n_c, batch, dtype, spread, mapped=False)
            name = f"{dtype}, n_c {n_c}, batch {batch}"
            jobs[name] = compiled.run
            about[name] = {"dtype": dtype, "n_c": n_c, "batch": batch, "devices": spread}
            about[name]["compile_s"] = compiled.compile_seconds
    timings = by_turns(jobs, sizes.rounds)
    return [{**about[name], **_timed(timing, about[name]["batch"])} for name, timing in timings.items()]


def worst_cases(sizes: Sizes) -> list[Row]:
    """S_1 and S_2 with shared directions, as a share of what a large matrix product of NumPy reaches."""
    batch = sizes.batch
    say(f"S_1 and S_2, n_c = 4, batch {batch}")
    grasps, rng = problems.sample(batch, 4), np.random.default_rng(1)
    wrenches = rng.normal(size=(max(sizes.directions), 6))
    wrenches /= np.linalg.norm(wrenches, axis=-1, keepdims=True)
    jobs: dict[str, Job] = {}
    flops, about = {}, {}
    for dtype in DTYPES:
        size = 3072
        jobs[f"matrix product {dtype}"] = functools.partial(_square, np.full((size, size), 0.5, dtype))
        flops[f"matrix product {dtype}"] = 2 * size**3
        for count in sizes.directions:
            compiled = ours.worst_cases(grasps, wrenches[:count], dtype, devices())
            name = f"{dtype}, {count} directions"
            jobs[name] = compiled.run
            # A product and a sum for each of six components, for every facet row and every normal row.
            flops[name] = batch * 2 * 6 * 4 * (problems.EDGES + 1) * count
            about[name] = {"dtype": dtype, "directions": count, "batch": batch, "compile_s": compiled.compile_seconds}
    timings = by_turns(jobs, sizes.rounds)
    rate = {name: flops[name] / timing.seconds / 1e9 for name, timing in timings.items()}
    return [
        {
            **row,
            **_timed(timings[name], batch),
            "gflops": rate[name],
            "peak_gflops": rate[f"matrix product {row['dtype']}"],
            "share_of_peak": rate[name] / rate[f"matrix product {row['dtype']}"],
        }
        for name, row in about.items()
    ]


def _spread(batch: int) -> int:
    return devices() if batch >= LEAST_SPREAD else 1


def _square(matrix: np.ndarray) -> None:
    np.matmul(matrix, matrix)


def _count(peer: str, n_c: int) -> int:
    count = int(SUBSAMPLE[peer] * min(1.0, (4 / n_c) ** 1.5))
    return max(8, count // PROCESSES * PROCESSES)


def _reference(workers: Workers, programs: problems.Programs) -> np.ndarray:
    n_c = programs.S_2.shape[1]
    loaded = workers.load("reference", programs[: _count("reference", n_c)])
    loaded.run()
    return loaded.answers


def _scaled(compiled: ours.Compiled, programs: problems.Programs) -> np.ndarray:
    """Margins in units of Lambda; nan where the status is not SOLVED."""
    solved = np.asarray(compiled.out.status) == jg.Status.SOLVED
    return np.where(solved, np.asarray(compiled.out.margin, float), np.nan) / programs.scale


def _timed(timing: Timing, count: int) -> Row:
    return {
        "per_s": count / timing.seconds,
        "cpu_per_wall": timing.cpu_per_wall,
        "rounds": timing.rounds,
        "discarded": timing.discarded,
    }


def _row(
    solver: str, timing: Timing, count: int, answers: np.ndarray, reference: np.ndarray, compile_s: float | None
) -> Row:
    """Errors are relative to max(Lambda, |lambda|), over programs that are called solved and that HiGHS solved."""
    both = min(len(answers), len(reference))
    error = np.abs(answers[:both] - reference[:both]) / np.maximum(1.0, np.abs(reference[:both]))
    known = error[np.isfinite(error)]
    return {
        "solver": solver,
        "programs": count,
        **_timed(timing, count),
        "solved": float(np.isfinite(answers).mean()),
        "worst_error": float(known.max()) if len(known) else None,
        "within_1e-6": float((known <= 1e-6).sum() / max(1, np.isfinite(reference[:both]).sum())),
        "compile_s": compile_s,
    }
