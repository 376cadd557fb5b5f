"""Kernels of every width that the processor can run, with spoilt memory, against each other and against XLA.

Each program is called three times, with the other kernels of its group between the calls. Kernels of all widths do the
same arithmetic in every lane, so their answers are equal to the last bit; AVX-512's estimates of reciprocals alone are
others'. XLA's arithmetic is in another order.
"""

from __future__ import annotations

import frame_reads
import kernel_programs
import kernel_targets
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.robustness.chain.verdicts import ACCEPTED

CALLS = 3
TARGETS = kernel_targets.targets()

TOLERANCE = {"float64": 2e-8, "float32": 1e-4}
"""Of margins, bounds, efforts and what is computed without iterations; the gap that solutions are accepted with."""

POINTS = {"float64": 1e-5, "float32": 2e-2}
"""Of forces and their derivatives, which gaps determine less well."""

LOOSE = ("forces", "effort", "actuator", "blocking", "changes", "twist", "moments")

NOISE = ("residual", "gap", "iterations", "multipliers")
"""What rounding decides, or a gap of rounding: kernels agree with each other on it."""

NOT_BINDING = {"of total efforts: [2]": 1.0}
"""N: the bounds on forces bind in none of these efforts, and what multipliers leave of zero is their derivative."""

TOLERANCE_CHAIN = {"float64": 2e-8, "float32": ACCEPTED["float32"]}
"""The same of formulations."""

UNDECIDED = {"float64": 0.0, "float32": 0.005}
"""Share of lanes whose status rounding may change."""

UNDECIDED_CHAIN = {"float64": 0.0, "float32": 0.03}
"""The same for formulations: float32 ends near the line up to which forces may miss their load in 1 or 2 of 100."""

ELSEWHERE = {"float64": 0.005, "float32": 0.01}
"""Share of lanes in which rounding may lead to another one of many best points, or of the multipliers at a kink; in
float64 of programs with round cones alone, whose forces vary as the root of a gap."""

QUICK = [("plain", "float64", True), ("plain", "float32", False)]
"""Group, precision, and whether XLA is asked, too, which compiles for longer than all kernels together."""

THOROUGH = [(group, dtype, True) for group in kernel_programs.GROUPS for dtype in TOLERANCE]
THOROUGH = [pytest.param(*case, marks=pytest.mark.thorough) for case in THOROUGH if case not in QUICK]

QUICK_TARGETS = [name for name in TARGETS if "halves" not in name or len(TARGETS) == 2]


def rows(x: np.ndarray) -> np.ndarray:
    return x.reshape(len(x), -1)


def far(ours: np.ndarray, theirs: np.ndarray, tolerance: float, unit: np.ndarray | float = 0.0) -> np.ndarray:
    """The lanes that differ by more than the tolerance, of the lane's own size and of a usual lane's, or of a unit."""
    a, b = rows(ours), rows(theirs)
    known = np.isfinite(b)
    size = np.where(known, np.abs(b), 0).max(1)
    size = size + np.maximum(np.median(size[size > 0]) if (size > 0).any() else 1, unit)
    with np.errstate(invalid="ignore"):
        near = (np.abs(a - b) <= tolerance * size[:, None]) | (a == b) | (np.isnan(a) & np.isnan(b))
    return np.flatnonzero(~near.all(1))


def mean_force(program: str) -> np.ndarray:
    """The mean max_force of each lane, N: margins and their bounds are promised in terms of it."""
    count = int(program.split()[0]) if program.endswith("contacts") else 3
    batch = kernel_programs.batch(count)
    return np.where(batch.active, batch.max_force, 0).sum(-1) / np.maximum(batch.active.sum(-1), 1)


def proven_alone(ours: dict, theirs: dict, program: str, name: str, loose: bool) -> np.ndarray:
    """Lanes whose load cannot be borne, as far as float32 leaves more open than that.

    There many forces come equally near, and rounding decides whether one of the two also closes the gap of the margin.
    """
    status = theirs.get(f"{program}: .status")
    if status is None:
        return np.zeros(kernel_programs.LANES, bool)
    one_knows = np.isnan(rows(ours[name])).any(1) != np.isnan(rows(theirs[name])).any(1)
    return (status == jg.Status.INFEASIBLE) & (one_knows | loose)


def hold_against_xla(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], dtype: str, group: str) -> None:
    wrong: dict[str, list[int]] = {}
    chain = group == "chain"
    allowed, tolerance = (UNDECIDED_CHAIN if chain else UNDECIDED), (TOLERANCE_CHAIN if chain else TOLERANCE)
    undecided = {name: np.flatnonzero(ours[name] != x) for name, x in theirs.items() if name.endswith("status")}
    for name, lanes in undecided.items():
        if len(lanes) > allowed[dtype] * kernel_programs.LANES:
            wrong[name] = lanes.tolist()
    for name, reference in theirs.items():
        program, path = name.split(": ")
        if reference.dtype.kind != "f" or any(word in path for word in NOISE):
            continue
        loose = any(word in name for word in LOOSE) or "derivative" in program
        # First derivatives are as good as the multipliers.
        loose |= (program.startswith("of ") or group == "derivatives") and dtype == "float32"
        if loose and group in ("margins", "hands") and dtype == "float32":
            # Of the forces of many contacts, or efforts of joints, many are best; that these are is what bounds and
            # the audit say.
            continue
        unit = mean_force(program) if path in (".margin", ".upper_bound", ".directions") else NOT_BINDING.get(name, 0.0)
        lanes = far(ours[name], reference, (POINTS if loose else tolerance)[dtype], unit)
        lanes = np.setdiff1d(lanes, undecided.get(f"{program}: .status", []))
        if path == "":
            # A metric alone is NaN where it is undecided.
            open_ = np.flatnonzero(np.isnan(ours[name]) != np.isnan(reference))
            lanes = np.setdiff1d(lanes, open_) if len(open_) <= allowed[dtype] * kernel_programs.LANES else lanes
        if dtype == "float32":
            # What proves that a load cannot be borne need not be the least bound.
            proof = loose or (path == ".upper_bound" and group == "hands")
            lanes = lanes[~proven_alone(ours, theirs, program, name, proof)[lanes]]
        several = loose and (dtype == "float32" or program.startswith(("12", "total effort")))
        # Near a kink float32 is as far from float64 on XLA as here, in as many lanes.
        several |= group == "derivatives, sets" and dtype == "float32"
        if len(lanes) > several * ELSEWHERE[dtype] * kernel_programs.LANES:
            wrong[name] = lanes.tolist()
    assert not wrong


@pytest.mark.parametrize(("group", "dtype", "xla"), QUICK + THOROUGH)
def test_every_lane_of_every_call_is_the_same_at_all_widths(group, dtype, xla):
    theirs = kernel_programs.answers_of_xla(group, dtype) if xla else None
    first: dict[bool, dict[str, np.ndarray]] = {}
    for target in QUICK_TARGETS if (group, dtype, xla) in QUICK else TARGETS:
        with kernel_targets.compiled_for(TARGETS[target]) as texts:
            calls = [kernel_programs.answers(group, dtype) for _ in range(CALLS)]
        assert texts, "nothing was compiled"
        assert not [line for text in texts for line in frame_reads.unwritten(text)]
        reference = first.setdefault(TARGETS[target].estimates, calls[0])
        for number, call in enumerate(calls):
            wrong = {name: d for name, x in call.items() if len(d := kernel_programs.differing(x, reference[name]))}
            assert not wrong, f"{target}, call {number}"
    if theirs is not None:
        for ours in first.values():
            hold_against_xla(ours, theirs, dtype, group)
