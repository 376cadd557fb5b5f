"""The study of pushed grasps: the directional margin, and one short run."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.contact.friction import pyramid_facets

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import margin_study  # noqa: E402


def test_a_push_of_the_directional_margin_just_holds():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20, 4, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    contacts = jg.Contacts.from_normals(0.03 * normals, normals, friction=0.7, max_force=5.0)
    forces = np.tile([0.0, 0.0, -1.0], (20, 4, 1))
    pushes = rng.normal(size=(20, 6, 6)) * [1, 1, 1, 0.02, 0.02, 0.02]
    factor = margin_study.directional(contacts, forces, pushes, jnp.eye(12))
    blocking = np.asarray(jg.blocking_forces(contacts, pushes))
    for share, holds in ((0.999, True), (1.001, False)):
        acting = forces[:, None] + share * factor[..., None, None] * blocking
        rows = np.einsum("ea,nkca->nkce", pyramid_facets(8) * [1, 1, 0.7], acting)
        assert np.all((rows.max((-2, -1)) <= 0) == holds)


@pytest.mark.thorough
def test_weak_pushes_are_held_and_strong_ones_are_not(monkeypatch):
    monkeypatch.setattr(margin_study, "STRENGTHS", np.array([0.0, 0.5, 4.0]))
    found = margin_study.grasps_on("sphere", 6, seed=0)
    outcome, margin = margin_study.run_arm(margin_study.ARMS[0], *found, 0)
    assert margin.shape == (6,) and margin.min() > margin_study.LEAST
    held = outcome.held.reshape(6, 3)
    assert held[:, :2].mean() > 0.9 and held[:, 2].mean() < 0.5
    assert np.all(outcome.stands.reshape(6, 3) == held[:, :1])
    words = margin_study.text({"one": outcome}, {"one": margin}, 60.0)
    assert "| 4 | " in words and "all below 0.9" in words
