"""Grasps whose iterates run along the boundary and stall: each is decided, and a ranking knows those that are not."""

import jax
import numpy as np
import pytest

import jaxgrasp as jg
from benchmarks.suite import problems
from jaxgrasp import kernels

FORCES = np.vstack([np.eye(3, 6), -np.eye(3, 6)])
# The tolerance of the gap is 1e-8 of the margin's scale, some newtons.
CLOSE = {"rtol": 1e-7, "atol": 1e-7}
# Of a million random grasps of four contacts, those that stall with gaps of 1e-7 and 1e-4: seed and number.
STALLING = ((2, 36825), (6, 7426))


def margins_of(grasps: problems.Grasps) -> jg.Solution:
    contacts = jg.Contacts.from_frames(
        grasps.positions, grasps.frames, friction=problems.FRICTION, max_force=problems.MAX_FORCE
    )
    return jg.largest_disturbance(contacts, jg.DisturbanceSet.vertices(FORCES))


@pytest.mark.parametrize("by_kernels", [True, False])
def test_grasps_that_stall_are_decided(by_kernels):
    found = [problems.sample(1 << 16, 4, seed)[[number]] for seed, number in STALLING]
    grasps = problems.Grasps(*(np.concatenate([getattr(g, f) for g in found]) for f in ("positions", "frames")))
    if by_kernels:
        solution = margins_of(grasps)
    else:
        jax.clear_caches()
        with kernels.without():
            solution = margins_of(grasps)
        jax.clear_caches()
    assert (np.asarray(solution.status) == jg.Status.SOLVED).all()
    programs = problems.programs(grasps, FORCES)
    np.testing.assert_allclose(solution.margin, programs.scale * problems.highs(programs, 1e-10, 1), **CLOSE)


@pytest.mark.thorough
def test_of_two_million_random_grasps_none_is_undecided():
    undecided, count = [], 0
    for n_c, batches in {3: 6, 4: 14, 5: 6, 8: 6, 12: 1}.items():
        for seed in range(batches):
            grasps = problems.sample(1 << 16, n_c, seed)
            status, count = np.asarray(margins_of(grasps).status), count + len(grasps)
            for row in np.flatnonzero(status == jg.Status.MAX_ITERATIONS):
                columns = np.swapaxes(grasps[[row]].columns()[0], 0, 1).reshape(6, -1)
                if np.linalg.cond(columns) < 1e4:
                    undecided.append((n_c, seed, row))
    assert count > 2_000_000 and not undecided
