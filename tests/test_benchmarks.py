"""The benchmark runs, and its programs are those that the package solves."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxgrasp as jg  # noqa: E402
from benchmarks.suite import ours, peers, problems, report  # noqa: E402
from benchmarks.suite.clock import by_turns  # noqa: E402

# The peers' own tolerance, with room for what they leave of it.
PEER_TOLERANCE = 5e-6
OURS_TOLERANCE = 1e-7
GRASPS = 64


@pytest.fixture(scope="module")
def optimum() -> np.ndarray:
    return peers.reference(problems.programs(problems.sample(GRASPS, 4)))()


def error(answers: np.ndarray, optimum: np.ndarray) -> np.ndarray:
    return np.abs(answers - optimum) / np.maximum(1.0, np.abs(optimum))


# Not qpax: the tests ask for strict promotion of dtypes, which it does not keep.
@pytest.mark.parametrize("peer", [peer for peer in peers.PEERS if "qpax" not in peer])
def test_peers_solve_the_same_programs(peer: str, optimum: np.ndarray) -> None:
    pytest.importorskip(peers.PEERS[peer])
    answers = getattr(peers, peer)(problems.programs(problems.sample(GRASPS, 4))[:16])()
    solved = np.isfinite(answers)
    assert solved.mean() >= 0.5
    assert error(answers[solved], optimum[:16][solved]).max() <= PEER_TOLERANCE


def test_ours_solve_the_same_programs(optimum: np.ndarray) -> None:
    compiled = ours.margins(4, GRASPS, "float64", 1, mapped=False)
    timings = by_turns({"ours": compiled.run}, 1)
    assert timings["ours"].seconds > 0
    assert (np.asarray(compiled.out.status) == jg.Status.SOLVED).all()
    margins = np.asarray(compiled.out.margin) / problems.programs(problems.sample(GRASPS, 4)).scale
    assert error(margins, optimum).max() <= OURS_TOLERANCE


def test_worst_cases_are_those_of_the_package() -> None:
    grasps = problems.sample(GRASPS, 4)
    S_1, S_2 = ours.worst_cases(grasps, problems.SIX_FORCES, "float64", 1).out
    programs = problems.programs(grasps)
    np.testing.assert_allclose(S_1, programs.S_1, atol=1e-9)
    np.testing.assert_allclose(S_2, programs.S_2, atol=1e-9)


def test_report_tells_of_the_machine_and_of_what_was_missed() -> None:
    row = {"solver": "jaxgrasp float64", "per_s": 4.0}
    headline = [row, {"solver": "PIQP dense, two processes", "per_s": 1.0}]
    headline += [
        {"solver": f"jaxgrasp {dtype}{kind}", "per_s": 4.0}
        for dtype in ("float64", "float32")
        for kind in ("", ", vmap")
    ]
    results = {
        "machine": report.machine(),
        "load_average": 0.0,
        "quick": True,
        "headline": headline,
        "against_peers": [],
        "scaling": [],
        "worst_cases": [],
        "processes": [],
    }
    results["targets"] = report.targets(results)
    missed = [target["what"] for target in results["targets"] if not target["met"]]
    assert missed == ["rate over PIQP's in two processes, float64"]
    assert "jax" in report.markdown(results)
