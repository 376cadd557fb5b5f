"""The largest ball of whole batches, its nearest facet and the proof, against Qhull."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull

import jaxgrasp as jg
from jaxgrasp import metrics
from jaxgrasp.metrics import WrenchSpace

# The search proves squares to 1e-7; what it finds is a vertex but for rounding. Float32 has 2e-4.
TOLERANCE = {np.float64: 1e-7, np.float32: 1e-4}
# Smaller balls than this share of the longest wrench count as none.
SMALLEST = {np.float64: 1e-7, np.float32: 1e-3}


def grasps(count: int, n_c: int, dtype=np.float64, seed: int = 3, **more) -> jg.Contacts:
    """Random grasps of a ball; every fifth lacks a contact, two have all in a plane or a point."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, n_c, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    normals = points + 0.3 * rng.normal(size=points.shape)
    points[0], points[1] = points[0] * [1, 1, 0], points[1, :1]
    active = np.arange(n_c) < np.where(np.arange(count) % 5 == 4, n_c - 1, n_c)[:, None]
    friction = rng.uniform(0.5, 1.2, (count, n_c))
    given = [x.astype(dtype) for x in (0.03 * points, normals, friction)]
    return jg.Contacts.from_normals(*given[:2], friction=given[2], max_force=dtype(1), active=active, **more)


def groups_of(contacts: jg.Contacts, space: WrenchSpace) -> list[list[np.ndarray]]:
    """The wrenches of every finger of every grasp, with the origin."""
    W = np.asarray(metrics.edge_wrenches(contacts, space), float)
    soft = contacts.torsional_friction is not None
    there = np.asarray(contacts.active)
    if soft:
        poles = there & (np.asarray(contacts.torsional_friction) > 0)
    groups = []
    for row, fingers in enumerate(W):
        counted = [w[: None if not soft or poles[row, c] else -2] for c, w in enumerate(fingers) if there[row, c]]
        groups.append([np.concatenate([np.zeros((1, 6)), w]) for w in counted])
    return groups


def hull_of(groups: list[np.ndarray], norm: str) -> ConvexHull | None:
    points = np.concatenate(groups) if norm == "L1" else np.array([sum(x) for x in itertools.product(*groups)])
    singular = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return ConvexHull(points) if singular[5] > 1e-9 * singular[0] else None


def against_qhull(contacts: jg.Contacts, norm: str, space: WrenchSpace, dtype=np.float64) -> None:
    found = jax.tree.map(np.asarray, metrics.nearest_facet(contacts, norm, space))
    closed = 0
    for row, groups in enumerate(groups_of(contacts, space)):
        hull, longest = hull_of(groups, norm), max(np.linalg.norm(w, axis=-1).max() for w in groups)
        exact = 0 if hull is None else max(0, -hull.equations[:, -1].max())
        assert found.status[row] == jg.Status.SOLVED
        if exact < 2 * SMALLEST[dtype] * longest:
            assert found.radius[row] <= 2 * SMALLEST[dtype] * longest
            continue
        closed += 1
        assert found.radius[row] == pytest.approx(exact, rel=TOLERANCE[dtype])
        assert found.lower_bound[row] <= exact * (1 + TOLERANCE[dtype])
        assert found.lower_bound[row] >= exact * (1 - 2 * TOLERANCE[dtype])
        # The wrench space reaches as far along the normal as the ball.
        reach = [np.max(w @ found.normal[row]) for w in groups]
        reach = max(reach) if norm == "L1" else sum(reach)
        assert reach == pytest.approx(exact, rel=TOLERANCE[dtype])
        assert np.linalg.norm(found.normal[row]) == pytest.approx(1, rel=float(10 * np.finfo(dtype).eps))
    assert 0.1 < closed / len(found.radius) < 1


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_balls_of_batches_are_qhulls(dtype):
    against_qhull(grasps(120, 4, dtype), "L1", WrenchSpace(), dtype)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_balls_where_each_force_is_bounded_are_qhulls(dtype):
    against_qhull(grasps(40, 3, dtype), "Linf", WrenchSpace(cone_edges=4), dtype)


def test_balls_of_soft_contacts_are_qhulls():
    torsion = 0.01 * (np.arange(3) % 2)
    against_qhull(grasps(60, 3, torsional_friction=torsion), "L1", WrenchSpace(cone_edges=4))


@pytest.mark.thorough
@pytest.mark.parametrize(("n_c", "edges"), [(3, 8), (4, 8), (5, 4), (8, 4)])
def test_balls_of_many_grasps_are_qhulls(n_c, edges):
    against_qhull(grasps(2000 if n_c < 5 else 200, n_c, seed=11), "L1", WrenchSpace(cone_edges=edges))


def test_a_bad_grasp_costs_its_neighbours_nothing():
    contacts = grasps(12, 4)
    spoilt = replace(contacts, positions=contacts.positions.at[5, 1, 0].set(np.nan))
    good, bad = (jax.tree.map(np.asarray, metrics.nearest_facet(c)) for c in (contacts, spoilt))
    assert bad.status[5] == jg.Status.INVALID_INPUT and np.isnan(bad.radius[5]) and np.isnan(bad.normal[5]).all()
    for ours, theirs in zip(jax.tree.leaves(good), jax.tree.leaves(bad), strict=True):
        np.testing.assert_array_equal(np.delete(ours, 5, 0), np.delete(theirs, 5, 0))


def test_batches_of_any_shape():
    contacts = grasps(12, 4)
    flat = np.asarray(metrics.ferrari_canny(contacts))
    shaped = jax.tree.map(lambda x: x.reshape(3, 4, *x.shape[1:]), contacts)
    np.testing.assert_array_equal(metrics.ferrari_canny(shaped), flat.reshape(3, 4))
    assert metrics.ferrari_canny(jax.tree.map(lambda x: x[0], contacts)).shape == ()
    assert metrics.ferrari_canny(jax.tree.map(lambda x: x[:0], contacts)).shape == (0,)
    lengths = WrenchSpace(length=np.array([[0.03], [0.05]]))
    assert metrics.ferrari_canny(contacts, "L1", lengths).shape == (2, 12)
