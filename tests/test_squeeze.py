"""Commands for tightening forces, against the contact forces of C MuJoCo."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jaxgrasp as jg  # noqa: E402
from benchmarks import squeeze  # noqa: E402
from jaxgrasp.hands import HandObject  # noqa: E402
from jaxgrasp.hands.closing import sample_configurations  # noqa: E402
from jaxgrasp.hands.scenes import four_fingers  # noqa: E402

# What the servos' own play and the fingers' weight may make of a force; the benchmark's median is 0.02.
TOLERANCE = 0.15
SAMPLES, BEST = 64, 12


def test_a_simulated_hand_squeezes_as_told():
    hand = HandObject.from_mjcf(four_fingers("sphere"), "object")
    qpos = sample_configurations(hand, SAMPLES)
    grasps = hand.grasps(qpos)
    # A margin of 1 N for all, since (22) then is the only program to compile.
    solution = jg.least_effort(
        grasps.contacts,
        jg.DisturbanceSet.forces(1.0),
        np.full(SAMPLES, 1.0),
        required_wrench=grasps.required_wrench,
        actuation=grasps.actuation,
    )
    solved = np.asarray(solution.status) == jg.Status.SOLVED
    best = np.argsort(np.where(solved, -np.asarray(solution.upper_bound), np.inf), kind="stable")[:BEST]
    assert solved[best].all()
    goal = squeeze.wanted(hand, qpos[best], *jax.tree.map(lambda x: np.asarray(x)[best], (grasps, solution)))
    found = squeeze.squeeze(hand.model, goal, seconds=0.5)
    vector, normal = squeeze.errors(goal, found)
    print(np.quantile(vector, squeeze.QUANTILES), np.quantile(normal, squeeze.QUANTILES))
    assert np.median(vector) < TOLERANCE
    assert np.median(normal) < TOLERANCE
    # Of one contact's force and nothing else, servos and weight leave nothing to explain.
    one = goal.contacts == 1
    rest = squeeze.parts(goal, found)[squeeze.REST][one]
    assert np.median(rest) < 0.02
