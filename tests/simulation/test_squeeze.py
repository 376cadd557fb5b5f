"""Commands for tightening forces, against the contact forces of C MuJoCo."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import jaxgrasp as jg  # noqa: E402
from benchmarks import squeeze  # noqa: E402
from jaxgrasp.hands import HandObject  # noqa: E402
from jaxgrasp.hands.closing import sample_configurations  # noqa: E402
from jaxgrasp.hands.scenes import four_fingers  # noqa: E402

# What servos that move and the fingers' weight may make of a force; the benchmark's median is a few per cent.
TOLERANCE = 0.15
# What remains of a force when these two are taken from it: contacts move and fingers turn by fractions of a degree.
REST = 0.02
SAMPLES, BEST = 64, 12


@pytest.mark.thorough
def test_a_simulated_hand_squeezes_as_told():
    hand = HandObject.from_mjcf(four_fingers("sphere"), "object", contact_distance=1e-3)
    qpos = sample_configurations(hand, SAMPLES)
    grasps = hand.grasps(qpos)
    # The forces of (21) instead of (22)'s: all that they have to be is admissible, and this compiles in half the time.
    solution = jg.largest_disturbance(
        grasps.contacts,
        jg.DisturbanceSet.forces(1.0),
        required_wrench=grasps.required_wrench,
        actuation=grasps.actuation,
    )
    solved = np.asarray(solution.status) == jg.Status.SOLVED
    best = np.argsort(np.where(solved, -np.asarray(solution.margin), np.inf), kind="stable")[:BEST]
    assert solved[best].all()
    goal = squeeze.wanted(hand, qpos[best], *jax.tree.map(lambda x: np.asarray(x)[best], (grasps, solution)))
    found = squeeze.squeeze(hand.model, goal, seconds=0.5)
    vector, normal = squeeze.errors(goal, found)
    print(np.quantile(vector, squeeze.QUANTILES), np.quantile(normal, squeeze.QUANTILES))
    assert np.median(vector) < TOLERANCE
    assert np.median(normal) < TOLERANCE
    one = goal.contacts == 1
    assert one.mean() > 0.5
    assert np.median(squeeze.parts(goal, found)[squeeze.REST][one]) < REST
