"""The distribution of the margin against loops over the same draws in NumPy, and statistics against SciPy's."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
import scipy.stats

import jaxgrasp as jg
from jaxgrasp.uncertainty import distribution, normal, uniform
from jaxgrasp.uncertainty.draws import draw
from jaxgrasp.uncertainty.statistics import _ranks_around, mean_of, probability_of, quantile_of, tail_mean_of

SAME_MARGIN = 2e-8
"""Of max(margin, 1): the same programs, in batches of other sizes and with other roundings."""

SAMPLES, GRASPS, CONTACTS = 60, 7, 4
SPEC = jg.Uncertainty.of(
    friction=0.2,
    position=0.002,
    normal=normal(0.1, correlation=0.5),
    max_force=uniform(0.3),
    mass=0.2,
    center_of_mass=0.003,
    load=[0.1, 0.1, 0.1, 0.002, 0.002, 0.002],
)
PUSHES = jg.DisturbanceSet.forces(1.0)
WEIGHT = jg.required_wrench(mass=0.05)


@cache
def grasps() -> jg.Contacts:
    """Seven grasps of a ball, the second with an absent contact, which holds numbers without a meaning."""
    rng = np.random.default_rng(3)
    points = rng.normal(size=(GRASPS, CONTACTS, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    points[0] = [[-1, 0, 0.1], [0.8, -0.6, 0.2], [0.8, 0.6, 0.2], [0.9, 0, -0.7]]
    points[1, :3] = points[0, :3]
    active = np.ones((GRASPS, CONTACTS), bool)
    active[1, 3] = False
    friction = np.full((GRASPS, CONTACTS), 0.6)
    friction[0, 0] = 0.15
    return jg.Contacts.from_normals(0.03 * points, points, friction=friction, max_force=6.0, active=active)


@cache
def pulled() -> jax.Array:
    """Forces (22) at three quarters of the margins."""
    found = jg.largest_disturbance(grasps(), PUSHES, WEIGHT)
    hold = jg.least_effort(grasps(), PUSHES, 0.75 * jnp.maximum(found.margin, 0), WEIGHT)
    return jnp.nan_to_num(hold.forces)


@cache
def answer() -> jg.MarginDistribution:
    return jg.margin_distribution(
        grasps(), PUSHES, SPEC, WEIGHT, samples=SAMPLES, at_least=(0.5, 2.0), forces=pulled(), margin=0.4, seed=5
    )


def drawn(which: int) -> tuple[jg.Contacts, np.ndarray, np.ndarray]:
    """One grasp under all draws, by other means; also whether anything was moved back."""
    found = {name: np.asarray(x) for name, x in draw(SPEC, CONTACTS, SAMPLES, jnp.asarray(5), jnp.dtype(float)).items()}
    one = jax.tree.map(lambda x: np.asarray(x[which]), grasps())
    angles = found["normal"].reshape(-1, 2)
    turns = scipy.spatial.transform.Rotation.from_rotvec(np.pad(angles, [(0, 0), (0, 1)])).as_matrix()
    turns = turns.reshape(SAMPLES, CONTACTS, 3, 3)
    positions = one.positions + np.einsum("nij,snj->sni", one.frames, found["position"])
    friction = one.friction + found["friction"]
    contacts = jg.Contacts.from_frames(
        positions - found["center_of_mass"][:, None],
        np.einsum("nij,snjk->snik", one.frames, turns),
        friction=np.maximum(friction, 0),
        max_force=one.max_force * (1 + found["max_force"]),
        active=np.broadcast_to(one.active, (SAMPLES, CONTACTS)),
    )
    wrench = np.asarray(WEIGHT) * (1 + found["mass"][:, None]) + found["load"]
    return contacts, wrench, ((friction < 0) & one.active).any(-1)


@cache
def margins(which: int) -> np.ndarray:
    contacts, wrench, _ = drawn(which)
    return np.asarray(jg.largest_disturbance(contacts, PUSHES, wrench).margin)


def test_statistics_are_those_of_a_loop_over_the_draws():
    found = answer()
    for which in range(GRASPS):
        wanted, ranked = margins(which), np.sort(margins(which))
        near = partial(np.testing.assert_allclose, atol=SAME_MARGIN * max(1, abs(ranked[-1])))
        near(found.mean.value[which], wanted.mean())
        near(found.mean.error[which], wanted.std(ddof=1) / np.sqrt(SAMPLES))
        near(found.quantiles.value[which], ranked[[5, 29, 53]])
        near(found.tail_mean.value[which], ranked[:6].mean())
        np.testing.assert_allclose(
            found.at_least.value[which], [(wanted >= 0.5).mean(), (wanted >= 2).mean()], rtol=1e-9
        )
        assert found.clipped[which] == pytest.approx(drawn(which)[2].mean())
        # None of the draws of the third can bear its load.
        status = jg.Status.INFEASIBLE if (wanted < 0).all() else jg.Status.SOLVED
        assert found.status[which] == status
    assert found.clipped[0] > 0
    assert not found.unanswered.any()


def test_forces_hold_where_every_row_does():
    """Rows of (16), one disturbance after the other, with G* of NumPy."""
    found, angles = answer(), 2 * np.pi * (np.arange(8) + 0.5) / 8
    for which in range(GRASPS):
        contacts, wrenches, _ = drawn(which)
        held = []
        nominal = jax.tree.map(lambda x, which=which: np.asarray(x[which]), grasps())
        pushed = np.einsum("nij,nj->ni", nominal.frames, np.asarray(pulled()[which]))
        for k in range(SAMPLES):
            one = jax.tree.map(lambda x, k=k: np.asarray(x[k]), contacts)
            on = one.active
            blocks = [
                np.vstack([r, np.cross(p, r.T).T]) for p, r in zip(one.positions[on], one.frames[on], strict=True)
            ]
            G = np.hstack(blocks)
            # A contact whose friction came out as 0 answers with its normal force alone.
            rough = np.repeat(one.friction[on] > 0, 3) | (np.arange(G.shape[1]) % 3 == 2)
            star = np.linalg.pinv(G * rough)
            f = np.einsum("nji,nj->ni", one.frames[on], pushed[on]).ravel()
            f = f + star @ (wrenches[k] - G @ f)
            fine = np.allclose(G @ f, wrenches[k], atol=1e-9)
            for w in np.vstack([np.zeros(6), np.asarray(PUSHES.terms[0].wrenches)]):
                fs = (f - 0.4 * star @ w).reshape(-1, 3)
                fine &= np.allclose(G @ star @ w, w, atol=1e-9)
                cone = fs[:, :2] @ np.array([np.cos(angles), np.sin(angles)])
                cone += np.cos(np.pi / 8) * one.friction[on][:, None] * fs[:, 2:]
                fine &= (cone <= 1e-7).all() and (-fs[:, 2] <= one.max_force[on] + 1e-7).all()
            held.append(fine)
        assert found.p_hold.value[which] == pytest.approx(np.mean(held))
    assert 0 < found.p_hold.value[0] < 1


def test_parts_of_a_batch_and_of_the_samples_do_not_matter(monkeypatch):
    monkeypatch.setattr(distribution, "_SOLVED", 16)
    monkeypatch.setattr(distribution, "_KEPT", 3 * SAMPLES)
    forces = pulled()
    ask = lambda contacts: jg.margin_distribution(
        contacts, PUSHES, SPEC, WEIGHT, samples=SAMPLES, at_least=(0.5, 2.0), forces=forces, margin=0.4, seed=5
    )
    # A function of its own, so that nothing compiled before is used.
    found = jax.jit(lambda contacts: ask(contacts))(grasps())
    for ours, whole in zip(jax.tree.leaves(found), jax.tree.leaves(answer()), strict=True):
        np.testing.assert_allclose(ours, whole, atol=1e-6)


def test_a_bad_grasp_costs_no_other_anything():
    spoilt = replace(grasps(), positions=grasps().positions.at[2, 0, 0].set(jnp.nan))
    spoilt = replace(spoilt, friction=spoilt.friction.at[4, 1].set(-0.1))
    found = jg.margin_distribution(
        spoilt, PUSHES, SPEC, WEIGHT, samples=SAMPLES, at_least=(0.5, 2.0), forces=pulled(), margin=0.4, seed=5
    )
    bad = np.array([2, 4])
    assert (np.asarray(found.status)[bad] == jg.Status.INVALID_INPUT).all()
    for leaf, before in zip(jax.tree.leaves(found), jax.tree.leaves(answer()), strict=True):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.isnan(np.asarray(leaf)[bad]).all()
        others = np.delete(np.arange(GRASPS), bad)
        np.testing.assert_allclose(np.asarray(leaf)[others], np.asarray(before)[others], atol=1e-6)


def test_draws_are_the_same_for_more_contacts_and_more_samples():
    few, many = (draw(SPEC, n, count, jnp.asarray(1), jnp.dtype(float)) for n, count in ((3, 5), (4, 9)))
    for name, x in few.items():
        y = many[name][:5]
        np.testing.assert_array_equal(x, y[:, :3] if x.shape != y.shape else y)


def test_draws_have_the_correlations_and_bounds_that_were_asked_for():
    matrix = np.array([[1, 0.8, 0], [0.8, 1, -0.5], [0, -0.5, 1]])
    spec = jg.Uncertainty.of(
        friction=normal(0.1, correlation=0.7),
        center_of_mass=normal([0.1, 0.2, 0.3], mean=1.0, correlation=matrix),
        max_force=normal(0.3, mean=0.1, lower=-0.2, upper=0.5),
        mass=uniform(0.2),
    )
    found = {name: np.asarray(x) for name, x in draw(spec, 2, 40_000, jnp.asarray(0), jnp.dtype(float)).items()}
    # Five standard errors.
    assert np.corrcoef(found["friction"].T)[0, 1] == pytest.approx(0.7, abs=0.015)
    np.testing.assert_allclose(np.corrcoef(found["center_of_mass"].T), matrix, atol=0.025)
    np.testing.assert_allclose(found["center_of_mass"].std(0), [0.1, 0.2, 0.3], rtol=0.02)
    cut = scipy.stats.truncnorm(-1, 4 / 3, loc=0.1, scale=0.3)
    assert scipy.stats.kstest(found["max_force"][:, 0], cut.cdf).pvalue > 1e-3
    assert scipy.stats.kstest(found["mass"], scipy.stats.uniform(-0.2, 0.4).cdf).pvalue > 1e-3


def test_without_uncertainty_a_grasp_is_what_it_is():
    found = jg.margin_distribution(
        grasps(), PUSHES, jg.Uncertainty.of(friction=0.0), WEIGHT, samples=8, forces=pulled(), margin=0.0
    )
    margin = np.asarray(jg.largest_disturbance(grasps(), PUSHES, WEIGHT).margin)
    np.testing.assert_allclose(found.mean.value, margin, atol=SAME_MARGIN * 10)
    np.testing.assert_allclose(found.first_order.mean, margin, atol=SAME_MARGIN * 10)
    assert not found.first_order.std.any()
    assert np.asarray(found.first_order.good).all()
    np.testing.assert_array_equal(found.p_hold.value, margin >= 0)


def test_grasps_that_have_no_finite_margin_have_their_status():
    one = jax.tree.map(lambda x: x[:1], grasps())
    still = jg.DisturbanceSet.vertices(np.zeros((1, 6)))
    spec = jg.Uncertainty.of(friction=0.1)
    ask = lambda wrench: jg.margin_distribution(one, still, spec, jnp.asarray(wrench), samples=8, margin=0.5)
    free, heavy = ask(np.zeros(6)), ask(np.array([0, 0, 1e3, 0, 0, 0]))
    assert free.status[0] == jg.Status.UNBOUNDED and np.isinf(free.mean.value[0]) and free.p_hold.value[0] == 1
    assert heavy.status[0] == jg.Status.INFEASIBLE and heavy.p_hold.value[0] == 0
    assert not heavy.unanswered[0]


def test_statistics_are_those_of_numpy():
    margins = np.random.default_rng(0).normal(size=(3, 50)).round(1)
    ranked = jnp.sort(jnp.asarray(margins), -1)
    found = quantile_of(jnp.asarray(margins), ranked, 0.3)
    np.testing.assert_array_equal(found.value, np.quantile(margins, 0.3, axis=-1, method="inverted_cdf"))
    low, high = _ranks_around(50, 0.3)
    assert low == scipy.stats.binom.ppf(0.025, 50, 0.3) and high == scipy.stats.binom.ppf(0.975, 50, 0.3) + 1
    np.testing.assert_array_equal(found.low, ranked[:, low - 1])
    found = probability_of(jnp.asarray(margins), jnp.zeros(3))
    wilson = scipy.stats.binomtest(int((margins[0] >= 0).sum()), 50).proportion_ci(method="wilson")
    assert (found.low[0], found.high[0]) == (pytest.approx(wilson.low), pytest.approx(wilson.high))
    np.testing.assert_allclose(tail_mean_of(jnp.asarray(margins), ranked, 1.0).value, margins.mean(-1))
    np.testing.assert_allclose(
        tail_mean_of(jnp.asarray(margins), ranked, 0.05).value, (ranked[:, 0] + ranked[:, 1] + 0.5 * ranked[:, 2]) / 2.5
    )
    assert np.isneginf(mean_of(jnp.array([[1.0, -jnp.inf]])).value[0])


def test_the_interval_of_a_low_quantile_of_few_samples_is_open():
    margins = jnp.arange(10.0)[None]
    found = quantile_of(margins, margins, 0.1)
    assert np.isneginf(found.low[0]) and found.value[0] == 0
    assert np.isposinf(quantile_of(margins, margins, 0.99).high[0])


@pytest.mark.parametrize("level", [0.02, 0.1, 0.5, 0.9])
def test_intervals_hold_as_often_as_they_say(level):
    """Of 4,000 samples of known distributions; the binomial error of 95 % is 0.34 %."""
    samples = np.random.default_rng(1).exponential(size=(4000, 400))
    ranked = jnp.sort(jnp.asarray(samples), -1)
    truth = scipy.stats.expon()
    tail = truth.expect(lambda x: x, ub=truth.ppf(level)) / level
    for found, wanted in (
        (quantile_of(jnp.asarray(samples), ranked, level), truth.ppf(level)),
        (probability_of(jnp.asarray(samples), jnp.full(4000, truth.ppf(level))), 1 - level),
        (mean_of(jnp.asarray(samples)), 1.0),
        (tail_mean_of(jnp.asarray(samples), ranked, level), tail),
    ):
        covered = ((found.low <= wanted) & (wanted <= found.high)).mean()
        # A tail of eight samples has a skew mean.
        assert (0.9 if level == 0.02 else 0.925) <= covered <= 0.985


def test_shapes_are_those_of_the_batch():
    """No grasps at all, one, and several axes; loads and forces with axes of their own; without running anything."""
    one = jax.tree.map(lambda x: x[0], grasps())
    for batch in ((), (0,), (1,), (3, 1, 2)):
        many = jax.tree.map(lambda x, batch=batch: jnp.broadcast_to(x, (*batch, *x.shape)), one)
        ask = lambda contacts: jg.margin_distribution(contacts, PUSHES, SPEC, WEIGHT, samples=4, quantiles=(0.1, 0.5))
        found = jax.eval_shape(ask, many)
        assert found.mean.value.shape == found.status.shape == batch
        assert found.quantiles.low.shape == found.first_order.quantiles.shape == (*batch, 2)
        assert found.at_least.error.shape == (*batch, 1)
    ask = lambda load, scale: jg.margin_distribution(one, PUSHES, SPEC, load, samples=4, margin=scale)
    assert jax.eval_shape(ask, jnp.zeros((5, 1, 6)), jnp.zeros(3)).p_hold.value.shape == (5, 3)
    mapped = jax.vmap(lambda contacts: jg.margin_distribution(contacts, PUSHES, SPEC, WEIGHT, samples=4))
    assert jax.eval_shape(mapped, grasps()).mean.value.shape == (GRASPS,)


def test_an_empty_batch_has_an_empty_answer():
    none = jax.tree.map(lambda x: x[:0], grasps())
    found = jg.margin_distribution(none, PUSHES, jg.Uncertainty.of(friction=0.1), samples=4)
    assert found.mean.value.shape == (0,) and found.quantiles.value.shape == (0, 3)
