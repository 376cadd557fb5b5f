"""Early verdicts: what cannot be among the best is given up, and the best are the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgrasp as jg
from jaxgrasp.candidates import sample_grasps
from jaxgrasp.cli import main
from jaxgrasp.ranking import rank

COUNT, TOP = 6000, 10


@pytest.fixture(scope="module")
def candidates():
    return sample_grasps(COUNT, friction=0.6, max_force=10.0)


@pytest.fixture(scope="module")
def rankings(candidates):
    return [rank(candidates, top=TOP, tile=1500, prune=prune) for prune in (False, True)]


def test_the_best_are_the_same(rankings):
    full, pruned = rankings
    np.testing.assert_array_equal(full.order[:TOP], pruned.order[:TOP])
    best = full.order[:TOP]
    for name in ("margin", "upper_bound", "status"):
        np.testing.assert_array_equal(getattr(full, name)[best], getattr(pruned, name)[best])
    np.testing.assert_array_equal(full.forces, pruned.forces)


def test_the_others_carry_bounds_that_hold(rankings):
    full, pruned = rankings
    given_up = pruned.status == jg.Status.PRUNED
    # Of the three tiles that know what is to be reached, most.
    assert given_up.sum() > 0.5 * COUNT
    assert (pruned.upper_bound[given_up] < full.margin[full.order[TOP - 1]]).all()
    slack = 1e-7 * np.maximum(1, np.abs(full.margin))
    known = given_up & np.isfinite(full.margin)
    assert (full.margin <= pruned.upper_bound + slack)[known].all()
    low = known & ~np.isnan(pruned.margin)
    assert (pruned.margin <= full.upper_bound + slack)[low].all()
    kept = ~given_up
    np.testing.assert_array_equal(full.status[kept], pruned.status[kept])
    np.testing.assert_array_equal(full.margin[kept], pruned.margin[kept])


def solve(normals, cutoff):
    contacts = jg.Contacts.from_normals(normals, normals, friction=0.5, max_force=1.0)
    return jg.largest_disturbance(contacts, jg.DisturbanceSet.forces(1.0), cone_edges=4, cutoff=cutoff)


def test_fewer_steps():
    normals = jnp.asarray(np.random.default_rng(0).normal(size=(200, 4, 3)))
    full, cut = solve(normals, None), solve(normals, jnp.where(jnp.arange(200) < 100, jnp.inf, jnp.nan))
    assert (cut.status[:100] == jg.Status.PRUNED).all()
    assert cut.iterations[:100].max() <= 2 < full.iterations.mean()
    np.testing.assert_array_equal(cut.margin[100:], full.margin[100:])


@pytest.mark.thorough
def test_what_was_given_up_has_no_gradient():
    normals = jnp.asarray(np.random.default_rng(0).normal(size=(8, 4, 3)))
    slope = jax.grad(lambda x: jnp.nansum(solve(x, jnp.inf).margin))(normals)
    np.testing.assert_array_equal(slope, 0)


def test_the_command(tmp_path, capsys):
    table = tmp_path / "table.csv"
    assert main(["rank", "--prune", "--top", "3", "--output", str(table), "--figure", "None"]) == 0
    assert "PRUNED" in table.read_text()
    assert main(["rank", "--prune", "--metric", "isotropy"]) != 0
    assert "--prune: got --metric, too" in capsys.readouterr().err
