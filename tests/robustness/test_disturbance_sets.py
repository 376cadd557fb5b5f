"""Sets given by a support function against polytopes: the vertices that attain it, and dense samplings from inside."""

from __future__ import annotations

from dataclasses import replace

import harness
import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest
from problems import sample
from test_identities import SAME_MARGIN

import jaxgrasp as jg

LENGTH = 0.05
"""Metres: torques are of this size for forces of size one."""

DENSE = 4000
"""Points of a sphere, some 0.03 rad apart: a cap between them is missed by at most 0.1 %."""


@pytest.fixture(scope="module")
def batch() -> problems.Batch:
    return sample(families=("around", "light load", "real") if problems.REAL_GRASPS.exists() else ("around", "plain"))


def box_vertices(half: np.ndarray) -> np.ndarray:
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 6, indexing="ij"), axis=-1).reshape(-1, 6)
    return signs * half


def box_member(half):
    return lambda a: np.sign(a) * half


def ellipsoid_member(L):
    def member(a):
        u = a @ L
        return u @ L.T / np.maximum(np.linalg.norm(u, axis=-1, keepdims=True), 1e-300)

    return member


def ball_member(force, torque):
    def member(a):
        parts = a.reshape(-1, 2, 3)
        norms = np.maximum(np.linalg.norm(parts, axis=-1, keepdims=True), 1e-300)
        return (parts / norms * np.array([force, torque])[:, None]).reshape(-1, 6)

    return member


def vertex_member(vertices):
    padded = np.vstack([vertices, np.zeros(6)])
    return lambda a: padded[np.argmax(a @ padded.T, axis=-1)]


def worst_vertices(grasp: oracles.Grasp, members) -> np.ndarray:
    """For every row of (21) the member of a sum of sets that loads it most: a polytope with the same S_1 and S_2."""
    every_wrench = replace(grasp, vertices=np.eye(6))
    change = every_wrench.force_changes[:-1]
    rows = np.concatenate([-(change @ grasp.cone_matrix.T).T, (change @ grasp.normal_matrix.T).T])
    return sum(member(rows) for member in members)


RNG = np.random.default_rng(11)
HALF = np.array([1.0, 0.3, 0.5, 0.02, 0.0, 0.01])
OTHER_HALF = np.array([0.0, 0.4, 0.2, 0.0, 0.03, 0.02])
SHAPE = RNG.normal(size=(6, 6)) * np.repeat([1.0, LENGTH], 3)[:, None]
VERTICES = problems.random_wrenches(RNG, 1, 5, LENGTH)[0]

SETS = {
    "box": (lambda: jg.DisturbanceSet.box(jnp.asarray(HALF)), [box_member(HALF)]),
    "ellipsoid": (lambda: jg.DisturbanceSet.ellipsoid(jnp.asarray(SHAPE)), [ellipsoid_member(SHAPE)]),
    "ball": (lambda: jg.DisturbanceSet.ball(force=1.5, torque=0.02), [ball_member(1.5, 0.02)]),
    "force ball": (lambda: jg.DisturbanceSet.ball(), [ball_member(1.0, 0.0)]),
    "box + ellipsoid": (
        lambda: jg.DisturbanceSet.box(jnp.asarray(HALF)) + jg.DisturbanceSet.ellipsoid(jnp.asarray(SHAPE)),
        [box_member(HALF), ellipsoid_member(SHAPE)],
    ),
    "vertices + ball": (
        lambda: jg.DisturbanceSet.vertices(jnp.asarray(VERTICES)) + jg.DisturbanceSet.ball(force=0.2, torque=0.01),
        [vertex_member(VERTICES), ball_member(0.2, 0.01)],
    ),
}


def margins(batch: problems.Batch, disturbances) -> np.ndarray:
    contacts, _, load, reserve = harness.data_of(batch)
    return np.asarray(harness.largest(contacts, disturbances, load, reserve).margin)


@pytest.mark.parametrize("name", SETS)
def test_the_support_is_attained_by_a_member(name):
    make, members = SETS[name]
    directions = np.random.default_rng(14).normal(size=(40, 6))
    attained = sum(np.maximum(np.sum(directions * member(directions), axis=-1), 0.0) for member in members)
    np.testing.assert_allclose(make().support(jnp.asarray(directions)), attained, rtol=1e-12)


@pytest.mark.parametrize("name", ["box", "ellipsoid", "vertices + ball"])
def test_a_set_is_as_bad_as_its_worst_members(batch, name):
    make, members = SETS[name]
    ours = margins(batch, make())
    assert np.any(ours > 0)
    for lane, margin in enumerate(ours):
        grasp = batch.grasp(lane, 8)
        polytope = replace(grasp, vertices=worst_vertices(grasp, members))
        truth = oracles.largest_disturbance(polytope)
        assert abs(margin - truth.margin) <= SAME_MARGIN * max(abs(truth.margin), truth.scale)


def sphere(count: int) -> np.ndarray:
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=-1)


@pytest.mark.thorough
def test_a_sampled_ball_approaches_the_ball_from_above(batch):
    points = jnp.asarray(np.hstack([sphere(DENSE), np.zeros((DENSE, 3))]))
    ball, sampled = margins(batch, jg.DisturbanceSet.ball()), margins(batch, jg.DisturbanceSet.vertices(points))
    held = ball > 0
    assert held.sum() > len(batch) / 2
    assert np.all((sampled >= ball - SAME_MARGIN * np.abs(ball))[held])
    assert np.all((sampled <= 1.002 * ball)[held])


def test_a_sampled_ellipsoid_approaches_the_ellipsoid_from_above(batch):
    flat = np.where(np.arange(6) < 3, SHAPE, 0.0)
    points = jnp.asarray(np.hstack([sphere(DENSE), np.zeros((DENSE, 3))]) @ flat.T)
    ellipsoid = margins(batch, jg.DisturbanceSet.ellipsoid(jnp.asarray(flat)))
    sampled = margins(batch, jg.DisturbanceSet.vertices(points))
    held = ellipsoid > 0
    assert held.sum() > len(batch) / 2
    assert np.all((sampled >= ellipsoid - SAME_MARGIN * np.abs(ellipsoid))[held])
    assert np.all((sampled <= 1.002 * ellipsoid)[held])


DIRECTIONS = np.random.default_rng(15).normal(size=(40, 6))


def assert_alike(ours, other) -> None:
    """Two sets with the same support function are the same for every program."""
    directions = jnp.asarray(DIRECTIONS)
    np.testing.assert_allclose(ours.support(directions), other.support(directions), rtol=1e-12, atol=1e-13)


def test_a_box_is_its_corners_and_a_sum_of_boxes_is_a_box():
    box, other = jg.DisturbanceSet.box(jnp.asarray(HALF)), jg.DisturbanceSet.box(jnp.asarray(OTHER_HALF))
    assert_alike(jg.DisturbanceSet.vertices(jnp.asarray(box_vertices(HALF))), box)
    assert_alike(jg.DisturbanceSet.box(jnp.asarray(HALF + OTHER_HALF)), box + other)


def test_a_sum_of_polytopes_has_all_sums_of_their_vertices():
    more = problems.random_wrenches(np.random.default_rng(12), 1, 4, LENGTH)[0]
    a, b = (np.vstack([v, np.zeros(6)]) for v in (VERTICES, more))
    sums = (a[:, None] + b).reshape(-1, 6)
    ours = jg.DisturbanceSet.vertices(jnp.asarray(VERTICES)) + jg.DisturbanceSet.vertices(jnp.asarray(more))
    assert_alike(ours, jg.DisturbanceSet.vertices(jnp.asarray(sums)))


@pytest.mark.parametrize("name", SETS)
def test_a_turned_set_answers_as_the_set_does_to_directions_turned_back(name):
    R = problems.rotations(np.random.default_rng(13), 1)[0]
    make, _ = SETS[name]
    back = (DIRECTIONS.reshape(-1, 2, 3) @ R).reshape(-1, 6)
    turned = make().rotated(jnp.asarray(R)).support(jnp.asarray(DIRECTIONS))
    np.testing.assert_allclose(turned, make().support(jnp.asarray(back)), rtol=1e-12)
    twice = make().rotated(jnp.asarray(R)).rotated(jnp.asarray(R.T)).support(jnp.asarray(DIRECTIONS))
    np.testing.assert_allclose(twice, make().support(jnp.asarray(DIRECTIONS)), rtol=1e-12)


def test_a_large_polytope_is_as_bad_as_its_worst_vertices():
    wrenches = problems.random_wrenches(np.random.default_rng(16), 1, 3001, LENGTH)[0]
    expected = np.maximum((DIRECTIONS @ wrenches.T).max(axis=-1), 0.0)
    ours = jg.DisturbanceSet.vertices(jnp.asarray(wrenches)).support(jnp.asarray(DIRECTIONS))
    np.testing.assert_allclose(ours, expected, rtol=1e-12)
    one_sided = jg.DisturbanceSet.vertices(jnp.asarray(wrenches[:1])).support(jnp.asarray(-wrenches[:1]))
    assert float(one_sided[0]) == 0.0, "the origin is always a member"


def test_the_six_forces_and_one_set_for_each_grasp():
    axes = jnp.asarray(np.vstack([np.eye(6)[:3], -np.eye(6)[:3]]))
    assert_alike(jg.DisturbanceSet.forces(2.0), jg.DisturbanceSet.vertices(2.0 * axes))
    scale = np.linspace(0.5, 2.0, 7)
    directions = jnp.asarray(np.tile(DIRECTIONS, (7, 1, 1)))
    for make in (
        lambda s: jg.DisturbanceSet.vertices(s[..., None, None] * axes),
        lambda s: jg.DisturbanceSet.box(s[..., None] * jnp.asarray(HALF)),
        lambda s: jg.DisturbanceSet.ellipsoid(s[..., None, None] * jnp.asarray(SHAPE)),
        lambda s: jg.DisturbanceSet.ball(force=s, torque=0.1 * s),
    ):
        one = make(jnp.asarray(1.0)).support(jnp.asarray(DIRECTIONS))
        each = make(jnp.asarray(scale)).support(directions)
        np.testing.assert_allclose(each, scale[:, None] * one, rtol=1e-12)
