"""The checker of answers: a sample of its families is true, and it finds every fault that is put into answers."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import jaxgrasp as jg  # noqa: E402
from benchmarks import truth  # noqa: E402
from benchmarks.suite import families, lanes, rules  # noqa: E402
from benchmarks.suite.grasps import DIRECTIONS  # noqa: E402
from benchmarks.suite.lanes import Claims, Lanes  # noqa: E402
from benchmarks.suite.rows import TOLERANCES  # noqa: E402
from benchmarks.suite.truth_report import faults, report  # noqa: E402
from jaxgrasp.robustness.auditing import setting  # noqa: E402

CONTACTS, EACH = 4, 96
# Sets that are smoothed are another program: they have a test of their own.
SAMPLED = [name for name in families.FAMILIES if name != "smoothed sets"]
TOLERANCE = TOLERANCES["float64"]


@pytest.fixture(scope="module", autouse=True)
def without_consequences():
    """An audit that fails, as it may for forces over sixteen decades, leaves the kernels to the tests that follow."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setting, "report", lambda failed, lanes: None)
        yield


def alike(name: str) -> Lanes:
    """Lanes of a family in the shape that all share: four contacts, eight edges, a sum of sets of every kind."""
    family = families.FAMILIES[name]
    made = family.make(np.random.default_rng(0), EACH, min(family.n_c, CONTACTS))
    padded = {}
    for key in ("positions", "frames", "friction", "max_force", "active"):
        value = made.arrays()[key]
        missing = np.zeros((EACH, CONTACTS - value.shape[1], *value.shape[2:]), value.dtype)
        padded[key] = np.concatenate([value, missing], axis=1)
    vertices = np.zeros((EACH, DIRECTIONS, 6))
    if made.vertices is not None:
        vertices[:, : made.vertices.shape[1]] = made.vertices
    parts = {"half_extents": (6,), "radii": (2,), "shape_matrix": (6, 6)}
    sets = {key: made.arrays().get(key, np.zeros((EACH, *shape))) for key, shape in parts.items()}
    return replace(made, cone_edges=8, vertices=vertices, **padded, **sets)


@pytest.fixture(scope="module")
def sample() -> Lanes:
    made = [alike(name) for name in SAMPLED]
    stacked = {key: np.concatenate([m.arrays()[key] for m in made]) for key in made[0].arrays()}
    return replace(made[0], **stacked)


@pytest.fixture(scope="module")
def solved(sample) -> tuple[Claims, Claims, np.ndarray]:
    """What both programs answer, and the margins that (22) was asked for."""
    margin = lanes.largest_disturbance(sample)
    asked = truth.asked_of(margin.margin, np.random.default_rng(1))
    return margin, lanes.least_effort(sample, asked), asked


def judge(sample: Lanes, margin: Claims, effort: Claims, asked: np.ndarray) -> dict:
    found = truth.check(sample, {"margin": margin, "effort": effort}, asked, "float64")
    truth.ask_highs(found, margin, "float64", np.random.default_rng(2), 100)
    return found


def test_a_sample_of_all_families_is_true(sample, solved):
    found = judge(sample, *solved)
    family = np.repeat(SAMPLED, EACH)
    for program in ("margin", "effort"):
        findings = found[program]
        for rule in ("wrong", "crossed", "false_status", "invalid"):
            bad = getattr(findings, rule) & ~found["model"].doubtful
            assert not bad.any(), (
                f"{program} {rule}: {dict(zip(*np.unique(family[bad], return_counts=True), strict=True))}"
            )
    assert found["margin"].solved.mean() > 0.8


def test_what_is_true_is_verified(sample, solved):
    """The audit may doubt lanes that are at the end of what float64 can tell, but no others."""
    far = np.isin(np.repeat(SAMPLED, EACH), ["8 decades", "16 decades", "nearly degenerate"])
    for answer in solved[:2]:
        assert not ((answer.status == rules.NOT_VERIFIED) & ~far).any()
    assert np.isin(solved[0].status, [jg.Status.MAX_ITERATIONS, jg.Status.ILL_CONDITIONED])[~far].mean() < 3e-3


def test_spoilt_lanes_are_marked_and_harm_nobody(sample, solved):
    spoilt_lanes, spoilt = lanes.spoil(sample, np.random.default_rng(3))
    margin, effort, asked = solved
    again = lanes.largest_disturbance(spoilt_lanes), lanes.least_effort(spoilt_lanes, asked)
    for before, after in zip((margin, effort), again, strict=True):
        assert (after.status[spoilt] == rules.INVALID).all()
        assert np.isnan(after.margin[spoilt]).all() and np.isnan(after.forces[spoilt]).all()
        assert not after.differs(before, None)[~spoilt].any()


@pytest.fixture(scope="module")
def few(sample, solved) -> tuple[Lanes, Claims, Claims, np.ndarray, dict]:
    """Lanes with a positive margin and forces that hold three quarters of it, for faults to be put in."""
    margin, _, _ = solved
    asked = 0.75 * np.where(np.isfinite(margin.margin), np.maximum(margin.margin, 0), 0)
    effort = lanes.least_effort(sample, asked)
    found = judge(sample, margin, effort, asked)
    m = found["model"]
    sure = found["margin"].solved & found["effort"].solved & ~found["margin"].wrong & ~found["effort"].wrong
    sure &= ~m.doubtful & ~found["margin"].open & ~found["effort"].suboptimal
    large = margin.margin > 100 * TOLERANCE.margin * m.mean_force
    chosen = np.flatnonzero(sure & large)[::3]
    assert len(chosen) > 200
    return (
        sample[chosen],
        margin[chosen],
        effort[chosen],
        asked[chosen],
        {"unit": TOLERANCE.margin * m[chosen].mean_force},
    )


def moved(claims: Claims, sample: Lanes) -> np.ndarray:
    """Forces of which one component of the strongest present contact is off by 1e-4 of its max_force."""
    forces, which = claims.forces.copy(), np.argmax(np.where(sample.active, sample.max_force, 0), axis=-1)
    row = np.arange(len(claims))
    forces[row, which, 2] -= 1e-4 * sample.max_force[row, which]
    return forces


# By name: how the answers of (21) and (22) change, and by which rules of which program each lane is found.
Change = Callable[[Claims, Claims, Lanes, np.ndarray], tuple[Claims, Claims]]
FAULTS: dict[str, tuple[Change, str, tuple[str, ...]]] = {
    "a margin too large": (
        lambda a, e, s, u: (replace(a, margin=a.margin + 10 * u, upper_bound=a.upper_bound + 10 * u), e),
        "margin",
        ("value",),
    ),
    "a margin too small": (lambda a, e, s, u: (replace(a, margin=a.margin - 10 * u), e), "margin", ("value",)),
    "an upper bound too large": (
        lambda a, e, s, u: (replace(a, upper_bound=a.upper_bound + 10 * u), e),
        "margin",
        ("value",),
    ),
    "an upper bound below the margin": (
        lambda a, e, s, u: (replace(a, upper_bound=(1 - 1e-6) * a.margin), e),
        "margin",
        ("crossed",),
    ),
    "no forces": (lambda a, e, s, u: (replace(a, forces=0 * a.forces), e), "margin", ("balance", "rows")),
    "one force": (lambda a, e, s, u: (replace(a, forces=moved(a, s)), e), "margin", ("balance", "rows")),
    "NaN among forces": (lambda a, e, s, u: (replace(a, forces=a.forces * np.nan), e), "margin", ("balance",)),
    "another lane's forces": (
        lambda a, e, s, u: (replace(a, forces=np.roll(a.forces, 1, axis=0)), e),
        "margin",
        ("balance", "rows"),
    ),
    "called infeasible": (
        lambda a, e, s, u: (replace(a, status=np.full_like(a.status, rules.INFEASIBLE)), e),
        "margin",
        ("false_status",),
    ),
    "called unbounded": (
        lambda a, e, s, u: (replace(a, status=np.full_like(a.status, rules.UNBOUNDED)), e),
        "margin",
        ("false_status",),
    ),
    "(22) no forces, as if nothing had been asked": (
        lambda a, e, s, u: (a, replace(e, forces=0 * e.forces, margin=0 * e.margin, effort=0 * e.effort)),
        "effort",
        ("balance", "rows", "value"),
    ),
    "(22) one force": (
        lambda a, e, s, u: (a, replace(e, forces=moved(e, s))),
        "effort",
        ("balance", "rows"),
    ),
    "(22) another effort": (lambda a, e, s, u: (a, replace(e, effort=1.001 * e.effort)), "effort", ("balance",)),
    "(22) a margin below what was asked": (
        lambda a, e, s, u: (a, replace(e, margin=0.5 * e.margin)),
        "effort",
        ("value",),
    ),
    "(22) an upper bound too small": (
        lambda a, e, s, u: (a, replace(e, upper_bound=e.margin)),
        "effort",
        ("value",),
    ),
    "(22) no multipliers": (
        lambda a, e, s, u: (a, replace(e, cone_multipliers=0 * e.cone_multipliers)),
        "effort",
        ("suboptimal",),
    ),
    "(22) called infeasible": (
        lambda a, e, s, u: (a, replace(e, status=np.full_like(e.status, rules.INFEASIBLE))),
        "effort",
        ("false_status",),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_found(few, fault):
    sample, margin, effort, asked, about = few
    change, program, named = FAULTS[fault]
    found = judge(sample, *change(margin, effort, sample, about["unit"]), asked)[program]
    caught = np.any([getattr(found, rule) for rule in named], axis=0)
    assert caught.all(), f"{(~caught).sum()} of {len(caught)} lanes pass"


def test_wrong_multipliers_leave_a_lane_to_highs(few):
    sample, margin, effort, asked, _ = few
    lame = replace(margin, cone_multipliers=0 * margin.cone_multipliers, bound_multipliers=0 * margin.bound_multipliers)
    found = truth.check(sample, {"margin": lame, "effort": effort}, asked, "float64")
    assert found["margin"].open.all() and not found["margin"].wrong.any()
    truth.ask_highs(found, lame, "float64", np.random.default_rng(0), 0)
    assert not found["margin"].wrong.any()


def test_a_load_that_nothing_bears_and_called_solved_is_found(sample, solved):
    margin, effort, asked = solved
    refused = np.flatnonzero(margin.status == rules.INFEASIBLE)
    assert len(refused) > 20
    told = replace(
        margin,
        status=np.zeros_like(margin.status),
        margin=np.zeros_like(margin.margin),
        upper_bound=np.zeros_like(margin.margin),
        forces=np.nan_to_num(margin.forces),
    )
    found = judge(sample[refused], told[refused], effort[refused], asked[refused])
    assert (found["margin"].wrong | found["model"].doubtful).all()


def test_report_counts_faults_of_both_precisions():
    counts = {"lanes": 8, "spoilt": 1, "margin wrong": 2, "effort crossed": 1}
    line = {"family": "16 decades", "seed": [0, 0], "seconds": [1.0, 1.0], "counts": counts}
    assert faults(line | {"dtype": "float64"}) == {"margin wrong": 2, "effort crossed": 1}
    assert faults(line | {"dtype": "float32"}) == {"effort crossed": 1}
    text = report([line | {"dtype": "float64"}, line | {"dtype": "float32"}])
    assert "| 16 decades | 8 |" in text and "margin wrong 2" in text


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", families.FAMILIES)
def test_a_batch_of_every_family_is_true(name, dtype):
    line = truth.examine(name, dtype, (7, 0), 2_048, 50)
    assert not faults(line | {"dtype": dtype}), line["examples"]
