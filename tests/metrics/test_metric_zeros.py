"""Metrics of grasps without force closure are zero, not small; and the largest ball has the edges that one asks for."""

from __future__ import annotations

import itertools

import jax
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

import jaxgrasp as jg
from jaxgrasp import metrics
from jaxgrasp.metrics import METRICS, Setting, WrenchSpace

COUNT = 8
SPACE = WrenchSpace()
# Balls that rounding leaves of none, in units of the longest wrench: below these HiGHS decides nothing.
UNDECIDED = {np.float64: 1e-7, np.float32: 1e-3}

bound = jax.jit(metrics.ferrari_canny_bound, static_argnums=1)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def families() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Positions, normals, friction and which contacts are there, four contacts a grasp."""
    random = np.random.default_rng(5)
    normals = unit(random.normal(size=(COUNT, 4, 3)))
    above = unit(normals * [1, 1, 0] + [0, 0, 1.5])
    angles = random.uniform(0, 2 * np.pi, (COUNT, 4))
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    opposite = normals.copy()
    opposite[:, 1] = -opposite[:, 0]
    line = unit(random.normal(size=(COUNT, 1, 3))) * random.uniform(-0.05, 0.05, (COUNT, 4, 1))
    all_there, two = np.ones((COUNT, 4), bool), np.tile([True, True, False, False], (COUNT, 1))
    mu = np.full((COUNT, 4), 0.6)
    return {
        "around": (0.03 * normals, normals, mu, all_there),
        "random": (0.03 * unit(random.normal(size=(COUNT, 4, 3))), normals, mu, all_there),
        "from above": (0.03 * above, above, 0.5 * mu, all_there),
        "two fingers": (0.03 * opposite, opposite, mu, two),
        "on a line": (line, normals, 2 * mu, all_there),
        "roller without friction": (0.03 * ring, ring, 0 * mu, all_there),
        # Pairs of contacts beside each other on the faces of a wedge of 60 degrees, as good as tan 30 is friction.
        "wedge, too steep": (*wedge(np.tan(np.pi / 6) - 1e-3), all_there),
        "wedge, held": (*wedge(np.tan(np.pi / 6) + 1e-2), all_there),
    }


def wedge(friction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    normals = np.array([[s * np.cos(np.pi / 6), 0, 0.5] for s in (1, 1, -1, -1)])
    positions = np.array([[0.02 * s, y, 0] for s in (1, -1) for y in (-0.02, 0.02)])
    return tuple(np.tile(x, (COUNT, *[1] * x.ndim)) for x in (positions, normals, np.full(4, friction)))


def contacts_of(precision: type) -> jg.Contacts:
    """All families, one after the other."""
    parts = [np.concatenate(part) for part in zip(*families().values(), strict=True)]
    positions, normals, friction = (part.astype(precision) for part in parts[:3])
    return jg.Contacts.from_normals(positions, normals, friction=friction, max_force=precision(1), active=parts[3])


def least_weights(contacts: jg.Contacts) -> np.ndarray:
    """The largest least weight of edges that cancel, by HiGHS, times their number; 0 where they do not span."""
    W, found = np.asarray(metrics.edge_wrenches(contacts, SPACE)), []
    for wrenches, there in zip(W, np.asarray(contacts.active), strict=True):
        w = wrenches[there].reshape(-1, 6)
        m = len(w)
        if np.linalg.svd(w, compute_uv=False)[5] < 1e-9:
            found.append(0.0)
            continue
        equal = np.vstack([np.column_stack([w.T, np.zeros(6)]), np.append(np.ones(m), 0)])
        rows = np.column_stack([-np.eye(m), np.ones(m)])
        program = linprog([0] * m + [-1], rows, np.zeros(m), equal, [0] * 6 + [1], bounds=(None, None))
        found.append(-program.fun * m if program.status == 0 else -np.inf)
    return np.array(found)


@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_bounds_without_closure_are_zero(precision):
    weights = least_weights(contacts_of(np.float64))
    decided = np.abs(weights) > UNDECIDED[precision]
    decided |= weights == 0
    for norm in ("L1", "Linf")[: 1 if precision is np.float32 else 2]:
        found = np.asarray(bound(contacts_of(precision), norm, SPACE))
        assert found.dtype == precision and decided.mean() > 0.9
        np.testing.assert_array_equal(found[decided] > 0, weights[decided] > UNDECIDED[precision])
        assert np.all(found[weights <= 0] == 0) and not np.isnan(found).any()
    named = dict(zip(families(), np.split(found, len(families())), strict=True))
    for name in ("from above", "two fingers", "on a line", "roller without friction", "wedge, too steep"):
        assert not named[name].any(), name
    assert named["around"].any() and named["wedge, held"].all()


def test_balls_without_closure_are_zero():
    contacts = contacts_of(np.float64)
    closed = least_weights(contacts) > UNDECIDED[np.float64]
    for row in range(0, len(closed), 3):
        one = jax.tree.map(lambda x, at=row: x[at], contacts)
        radius = metrics.ferrari_canny(one, "L1", SPACE)
        assert radius > 1e-6 if closed[row] else radius == 0


@pytest.mark.parametrize("there", [True, False])
def test_rings_without_friction_close_nothing(there):
    """Radial forces in a plane span three dimensions; of grasps without contacts there is not even a plane."""
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, (40, 3))
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    contacts = jg.Contacts.from_normals(0.03 * ring, ring, friction=0.0, max_force=1.0, active=np.full((40, 3), there))
    found = metrics.force_closure(contacts, SPACE)
    assert not found.closed.any() and (found.status == jg.Status.SOLVED).all()
    assert (found.min_weight <= 0).all() and np.isfinite(found.separating_twist).all()
    work = np.einsum("nced,nd->nce", metrics.edge_wrenches(contacts, WrenchSpace(length=1.0)), found.separating_twist)
    assert work.max() < 1e-6
    assert not metrics.task_wrench(contacts, jg.DisturbanceSet.forces(1.0), SPACE).any()
    for norm in ("L1", "Linf"):
        assert metrics.ferrari_canny(jax.tree.map(lambda x: x[0], contacts), norm, SPACE) == 0


@pytest.mark.thorough
def test_gradients_without_closure_are_zero():
    contacts = contacts_of(np.float64)
    total = lambda p: bound(jg.Contacts(**{**vars(contacts), "positions": p}), "L1", SPACE).sum()  # noqa: E731
    gradient = np.asarray(jax.grad(total)(contacts.positions))
    closed = least_weights(contacts) > UNDECIDED[np.float64]
    assert np.isfinite(gradient).all() and not gradient[~closed].any() and gradient[closed].any()


@pytest.mark.parametrize("edges", [3, 4, 6])
def test_largest_balls_have_the_edges_that_one_asks_for(edges):
    parts = families()["around"]
    contacts = jg.Contacts.from_normals(*(x[1, :3] for x in parts[:2]), friction=0.8, max_force=1.0)
    setting = Setting(disturbances=jg.DisturbanceSet.forces(1.0), cone_edges=edges, task={})
    W = np.asarray(metrics.edge_wrenches(contacts, WrenchSpace(cone_edges=edges)))
    groups = [np.concatenate([np.zeros((1, 6)), w]) for w in W]
    sums = np.array([np.sum(choice, 0) for choice in itertools.product(*groups)])
    wanted = max(0.0, -ConvexHull(sums).equations[:, -1].max())
    np.testing.assert_allclose(METRICS["ferrari_canny_linf"].value(contacts, setting), wanted, atol=1e-9)
