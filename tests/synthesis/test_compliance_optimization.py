"""Optimised compliance: never worse than the identity, better on average, and below what no compliance can beat."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxgrasp as jg
from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.synthesis import optimize_compliance

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.suite import problems  # noqa: E402
from benchmarks.suite.unreduced import unreduced_margins  # noqa: E402

# Margins are of order one; the solver's bounds agree to 1e-8 of that.
TOLERANCE = 1e-6
GRASPS, STEPS, SPREAD = 8, 20, 1e2


@pytest.fixture(scope="module")
def contacts() -> jg.Contacts:
    """Grasps of an ellipsoid; of the last three one is not admissible, one has a contact less, one holds nothing."""
    grasps = problems.sample(GRASPS, 4)
    active = np.ones((GRASPS, 4), bool)
    active[-2, 3] = False
    positions, frames = grasps.positions.copy(), grasps.frames.copy()
    positions[-3, 0, 0] = np.nan
    positions[-1], frames[-1] = positions[-1, :1], frames[-1, :1]
    return jg.Contacts.from_frames(positions, frames, friction=0.8, max_force=2.0, active=active)


@pytest.fixture(scope="module")
def result(contacts):
    answer = optimize_compliance(contacts, jg.DisturbanceSet.forces(1.0), steps=STEPS, spread=SPREAD)
    return jax.tree.map(np.asarray, answer)


def unreduced(contacts: jg.Contacts, lane: int) -> float:
    """lambda_13 by HiGHS, from its definition: the least over the directions."""
    on = np.asarray(contacts.active[lane])
    G = np.asarray(jg.grasp_map(contacts))[lane][:, np.repeat(on, 3)]
    n = on.sum()
    cones = np.kron(np.eye(n), pyramid_facets(8) * [1, 1, 0.8])
    bounds = np.kron(np.eye(n), [[0, 0, -1.0]])
    rows = np.hstack([np.vstack([cones, bounds]), np.zeros((9 * n, 1))])
    h = np.concatenate([np.zeros(8 * n), np.full(n, 2.0)])
    cost = np.r_[np.zeros(3 * n), -1.0]
    answers = [
        linprog(cost, rows, h, np.column_stack([G, W]), np.zeros(6), (None, None), "highs") for W in problems.SIX_FORCES
    ]
    return min(-answer.fun for answer in answers)


def test_margins_rise_and_stay_below_the_unreduced_program(contacts, result):
    before, after = result.before.margin, result.after.margin
    assert np.flatnonzero(result.after.status != jg.Status.SOLVED).tolist() == [GRASPS - 3]
    assert np.isnan(after[-3])
    before, after = np.delete(before, -3), np.delete(after, -3)
    most = np.array([unreduced(contacts, lane) for lane in range(GRASPS) if lane != GRASPS - 3])
    assert (after >= before - TOLERANCE).all()
    assert (after <= most + TOLERANCE).all()
    held = before > TOLERANCE
    assert held.sum() >= 4
    won = (after - before)[held] / (most - before)[held]
    assert won.min() > 0 and won.mean() > 0.5, won
    margins = np.delete(result.margins, -3, 0)
    np.testing.assert_allclose(after, margins.max(-1), atol=TOLERANCE)
    np.testing.assert_allclose(before, margins[:, 0], atol=TOLERANCE)


def test_compliance_is_diagonal_positive_and_bounded(contacts, result):
    entries = np.diagonal(result.compliance, axis1=-2, axis2=-1)
    np.testing.assert_array_equal(result.compliance, entries[..., None] * np.eye(3))
    assert entries.min() > 0
    assert (entries.max((1, 2)) / entries.min((1, 2)) <= SPREAD * (1 + 1e-12)).all()
    assert entries.max() > 2
    absent = ~np.asarray(contacts.active)
    np.testing.assert_array_equal(entries[absent], 1)
    flat = ~(result.before.margin > TOLERANCE)
    assert flat[-3] and flat[-1]
    np.testing.assert_array_equal(entries[flat], 1)


@pytest.mark.thorough
def test_benchmark_solves_the_unreduced_program(contacts):
    whole = jax.tree.map(lambda v: v[:4], contacts)
    found = unreduced_margins(whole, jnp.asarray(problems.SIX_FORCES), jnp.zeros((4, 6)))
    np.testing.assert_allclose(found, [unreduced(whole, lane) for lane in range(4)], atol=TOLERANCE)


@pytest.mark.parametrize("option, message", [({"steps": 0}, "steps: got 0"), ({"spread": 1.0}, "spread: got 1.0")])
def test_bad_options(contacts, option, message):
    with pytest.raises(ValueError, match=message):
        optimize_compliance(contacts, jg.DisturbanceSet.forces(1.0), **option)
