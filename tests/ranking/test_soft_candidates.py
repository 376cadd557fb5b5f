"""Candidates with soft fingertips: a column of files, a rank, and the moments in its table."""

from __future__ import annotations

import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.candidates import CandidateError, read_candidates
from jaxgrasp.candidates.candidates import concatenate
from jaxgrasp.ranking import rank, ranking_table

COUNT = 12


def columns() -> dict[str, np.ndarray]:
    """Two opposed fingers, which bear nothing about their line unless they are soft."""
    rng = np.random.default_rng(0)
    width = rng.uniform(0.02, 0.05, COUNT)
    positions = np.zeros((COUNT, 2, 3))
    positions[:, 0, 0], positions[:, 1, 0] = width, -width
    normals = np.tile([[1.0, 0, 0], [-1.0, 0, 0]], (COUNT, 1, 1))
    return {
        "positions": positions,
        "outward_normals": normals,
        "friction": np.float64(0.6),
        "max_force": np.float64(5.0),
        "torsional_friction": rng.uniform(0.005, 0.02, (COUNT, 2)),
    }


def test_a_column_makes_contacts_soft(tmp_path):
    given = columns()
    np.savez(tmp_path / "soft.npz", **given)
    np.savez(tmp_path / "hard.npz", **{name: x for name, x in given.items() if name != "torsional_friction"})
    np.savez(tmp_path / "all.npz", **given | {"torsional_friction": np.float64(0.01)})
    soft, hard, alike = (read_candidates([tmp_path / f"{name}.npz"]) for name in ("soft", "hard", "all"))
    assert hard.torsional_friction is None and "torsional_friction" not in soft.columns
    np.testing.assert_array_equal(soft.torsional_friction, given["torsional_friction"])
    np.testing.assert_array_equal(alike.torsional_friction, np.full((COUNT, 2), 0.01))
    both = concatenate([soft, hard])
    assert both.torsional_friction is not None and not both.torsional_friction[COUNT:].any()
    np.testing.assert_array_equal(both.take(np.array([3, 20])).torsional_friction[0], given["torsional_friction"][3])
    np.savez(tmp_path / "wrong.npz", **given | {"torsional_friction": np.zeros((COUNT, 3))})
    with pytest.raises(CandidateError, match="torsional_friction"):
        read_candidates([tmp_path / "wrong.npz"])


def test_soft_candidates_are_ranked_with_their_moments(tmp_path):
    given = columns()
    np.savez(tmp_path / "soft.npz", **given)
    candidates = read_candidates([tmp_path / "soft.npz"])
    moments = jg.DisturbanceSet.vertices(np.array([[0, 0, 0, 0.01, 0, 0], [0, 0, 0, -0.01, 0, 0]]))
    ranking = rank(candidates, moments, top=3)
    # Each finger takes its part of the moment as its (gamma / mu)^2, and the weaker one decides.
    gamma = given["torsional_friction"]
    shares = gamma**2 / (gamma**2).sum(-1, keepdims=True)
    np.testing.assert_allclose(ranking.margin, (gamma * 5 / 0.01 / shares).min(-1), rtol=1e-7)
    assert ranking.moments is not None and ranking.moments.shape == (3, 2)
    table = ranking_table(ranking)
    assert table["moments"].shape == (COUNT, 2) and np.isnan(table["moments"][3:]).all()
    hard = rank(concatenate([candidates]), jg.DisturbanceSet.forces(1.0), top=1)
    assert (hard.margin > 0).all()
