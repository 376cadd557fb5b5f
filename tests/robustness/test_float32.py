"""float32, and float64 at its limits: what is called solved is right, bounds never cross, doubt is told."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxgrasp as jg
from benchmarks import float32_efforts as plain

LANES = 1024
SIX = jg.DisturbanceSet.forces(1.0)

UNDECIDED = 0.01
"""Of plain grasps."""

MARGIN = 1e-4
"""Of the mean largest force: what a margin and its upper bound may be off in float32."""


def pairs(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Positions (lanes, 2, 3) and normals of parallel jaws: opposite points of ellipsoids, as float32 holds them."""
    point, axes = problems.unit_vectors(rng, LANES), rng.uniform(0.4, 1, (LANES, 3))
    position, normal = 0.05 * point * axes, point / axes
    both = lambda v: np.stack([v, -v], 1).astype(np.float32)  # noqa: E731
    return both(position), both(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def spread(rng: np.random.Generator, n_c: int, decades: float) -> tuple[np.ndarray, ...]:
    """Positions, frames, friction and largest forces, the latter over some decades."""
    positions, frames = problems.ellipsoid_contacts(rng, LANES, n_c, "spread")
    friction, force = rng.uniform(0.2, 1, (LANES, n_c)), 10 ** rng.uniform(0, decades, (LANES, n_c))
    return tuple(x.astype(np.float32) for x in (0.05 * positions, frames, friction, force))


def margins(dtype: str, *data: np.ndarray) -> jg.Solution:
    positions, frames, friction, force = (x.astype(dtype) for x in data)
    contacts = jg.Contacts.from_frames(positions, frames, friction=friction, max_force=force)
    return jg.largest_disturbance(contacts, SIX)


@pytest.mark.parametrize("n_c, loaded", [(4, False), (6, True)])
def test_plain_efforts_are_decided_and_right(n_c, loaded):
    grasps = plain.plain(LANES, n_c, loaded, 1)
    largest, least = plain.solved(grasps, "float32")
    margin = (np.maximum(np.nan_to_num(largest.margin), 0) * grasps.share).astype(np.float32)
    answered = least.status == jg.Status.SOLVED
    assert np.mean(answered | (least.status == jg.Status.INFEASIBLE)) >= 1 - UNDECIDED
    assert not np.any(answered & plain.wrong(grasps, least, plain.solved(grasps, "float64", margin)))


@pytest.mark.parametrize("decades", [0, 4])
def test_bounds_of_float32_are_true(decades):
    data = spread(np.random.default_rng(2), 3, decades)
    ours, exact = margins("float32", *data), margins("float64", *data)
    solved = np.asarray((ours.status == jg.Status.SOLVED) & (exact.status == jg.Status.SOLVED))
    assert solved.mean() > (0.99 if decades == 0 else 0.9)
    far = MARGIN * data[3].mean(1)
    for bound in (ours.margin, ours.upper_bound):
        assert np.all(np.abs(np.asarray(bound, float) - exact.margin)[solved] <= far[solved])
    assert np.all(np.asarray(ours.margin <= ours.upper_bound)[solved])


def test_parallel_jaws_in_float32():
    """G has rank 5, which two points on a line make certain."""
    rng = np.random.default_rng(3)
    positions, normals = pairs(rng)
    friction, force = rng.uniform(0.1, 1.5, (LANES, 2)), rng.uniform(1, 20, (LANES, 2))
    answers = []
    for dtype in (np.float32, np.float64):
        own = [x.astype(np.float32).astype(dtype) for x in (positions, normals, friction, force)]
        contacts = jg.Contacts.from_normals(*own[:2], friction=own[2], max_force=own[3])
        answers.append(jg.largest_disturbance(contacts, SIX))
    ours, exact = answers
    solved = np.asarray(ours.status == jg.Status.SOLVED)
    assert solved.mean() > 0.99
    for bound in (ours.margin, ours.upper_bound):
        assert np.all(np.abs(np.asarray(bound, float) - exact.margin)[solved] <= MARGIN * force.mean(1)[solved])
    assert np.all(np.asarray(ours.rank)[solved] == 5)


def test_float32_says_that_it_cannot_tell_the_rank():
    """Three points hardly off a line: the rank is 5 or 6, and the margin 1.8 or 1.5 of something."""
    rng = np.random.default_rng(4)
    line, along = problems.unit_vectors(rng, 16), rng.uniform(-0.05, 0.05, (16, 3))
    off = 3e-7 * rng.uniform(-1, 1, (16, 3, 3))
    positions = (line[:, None] * along[..., None] + off).astype(np.float32)
    contacts = jg.Contacts.from_normals(positions, positions, friction=0.5, max_force=2.0)
    assert np.all(np.asarray(jg.largest_disturbance(contacts, SIX).status) == jg.Status.ILL_CONDITIONED)
    axis = np.array([[-0.05, 0, 0], [0.02, 0, 0], [0.05, 0, 0]], np.float32)
    contacts = jg.Contacts.from_normals(axis, axis, friction=0.5, max_force=2.0)
    assert jg.largest_disturbance(contacts, SIX).status == jg.Status.SOLVED


@pytest.mark.filterwarnings("ignore:.* answers failed the audit")
@pytest.mark.parametrize("decades", [12, 16])
def test_bounds_of_float64_do_not_cross(decades):
    """Forces that spread so far miss G f = b by more than the audit allows in some lanes."""
    ours = margins("float64", *spread(np.random.default_rng(5), 3, decades))
    solved = np.asarray(ours.status == jg.Status.SOLVED)
    assert solved.mean() > 0.4
    assert not np.any(np.asarray(ours.upper_bound < ours.margin))


def test_forces_of_no_margin_are_none():
    """One finger can resist nothing: its forces are zero, not what rounding leaves."""
    for dtype in ("float32", "float64"):
        rows = [np.eye(3)[None, None].astype(dtype), np.full((1, 1), 0.5, dtype), np.ones((1, 1), dtype)]
        contacts = jg.Contacts.from_frames(np.zeros((1, 1, 3), dtype), rows[0], friction=rows[1], max_force=rows[2])
        answer = jg.largest_disturbance(contacts, SIX)
        assert answer.status == jg.Status.SOLVED and answer.margin == 0
        np.testing.assert_array_equal(answer.forces, 0)


def test_a_hand_without_actuators_is_refused():
    contacts = jg.Contacts.from_normals(np.eye(3), np.eye(3), friction=0.5, max_force=1.0)
    actuation = jg.Actuation.from_jacobian(jnp.zeros((3, 3, 2)), np.zeros((2, 0)), np.zeros(0), np.zeros(0))
    with pytest.raises(ValueError, match="got no actuators"):
        jg.largest_disturbance(contacts, SIX, actuation=actuation)
