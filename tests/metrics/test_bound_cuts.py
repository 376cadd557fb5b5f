"""The bound of Ferrari and Canny's metric: the same numbers however a batch is cut, above the hull's, mostly equal."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import jaxgrasp as jg

# Facets of such grasps are alike, so rounding alone would choose among them.
TOLERANCE = {"float64": 1e-9, "float32": 1e-4}
COUNT = 60
NORMALS = {
    "three": np.array([[np.cos(a), np.sin(a), 0] for a in 2 * np.pi * np.arange(3) / 3]),
    "four": np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]),
    "six": np.concatenate([np.eye(3), -np.eye(3)]),
}


def turned(name: str, dtype: str = "float64") -> jg.Contacts:
    """Symmetric grasps that lie askew."""
    turns = Rotation.from_quat(np.random.default_rng(1).normal(size=(COUNT, 4))).as_matrix()
    normals = np.einsum("nij,cj->nci", turns, NORMALS[name]).astype(dtype)
    return jg.Contacts.from_normals(0.05 * normals, normals, friction=0.6, max_force=1.0)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("norm", ["L1", "Linf"])
def test_symmetric_grasps_do_not_depend_on_their_batch(norm, dtype):
    contacts = turned("six", dtype)
    bound = lambda c: jg.metrics.ferrari_canny_bound(c, norm)  # noqa: E731
    whole = np.asarray(bound(contacts))
    parts = jax.tree.map(lambda x: x.reshape(12, 5, *x.shape[1:]), contacts)
    np.testing.assert_allclose(jax.lax.map(bound, parts).ravel(), whole, rtol=TOLERANCE[dtype])
    backwards = jax.jit(bound)(jax.tree.map(lambda x: x[::-1], contacts))
    np.testing.assert_allclose(backwards[::-1], whole, rtol=TOLERANCE[dtype])


@pytest.mark.parametrize("name", NORMALS)
def test_bounds_of_symmetric_grasps_are_above_qhulls_and_near(name):
    contacts = turned(name)
    edges = np.asarray(jg.metrics.edge_wrenches(contacts)).reshape(COUNT, -1, 6)
    exact = [-ConvexHull(np.vstack([w, np.zeros(6)])).equations[:, -1].max() for w in edges]
    above = jg.metrics.ferrari_canny_bound(contacts) / jnp.asarray(exact)
    assert above.min() >= 1 - 1e-9 and above.max() <= 1.05
