"""Derivatives of the statistics of margins, and the estimate of first order."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from test_margin_distribution import PUSHES, WEIGHT, grasps

import jaxgrasp as jg
from jaxgrasp.uncertainty import normal

STEP, GRADIENT_TOLERANCE = 1e-6, 1e-5
"""Of central differences with the same draws, and the error, relative to the largest slope."""

SAMPLES, LEVEL = 1000, 0.2
SAMPLED = 0.17
"""Three standard errors of a kernel's density from 1,000 draws, its width 0.27 standard deviations."""


def test_means_vary_as_with_the_same_draws_and_another_grasp():
    """The mean and the tail's mean, by what is known, by how little the rest is known, and by the load."""
    two = jax.tree.map(lambda x: x[:2], grasps())

    def both(friction, spread, wrench):
        contacts = jg.Contacts.from_frames(
            two.positions, two.frames, friction=friction, max_force=6.0, active=two.active
        )
        spec = jg.Uncertainty.of(position=spread, normal=0.05, mass=0.1)
        found = jg.margin_distribution(contacts, PUSHES, spec, wrench, samples=20, tail=0.25)
        return jnp.stack([found.mean.value, found.tail_mean.value])

    at = (jnp.full((2, 4), 0.5), jnp.asarray(0.002), WEIGHT)
    value, pull = jax.jit(lambda *at: jax.vjp(both, *at))(*at)
    call = jax.jit(both)
    for weights in (np.array([[1.0, 0.5], [0, 0]]), np.array([[0, 0], [0.3, 1.0]])):
        slopes = pull(jnp.asarray(weights))
        for place, slope in enumerate(slopes):
            # Along one direction for each argument.
            way = np.random.default_rng(place).normal(size=jnp.shape(at[place])) * np.abs(at[place]).max()
            moved = [tuple(x + s * STEP * way if k == place else x for k, x in enumerate(at)) for s in (1, -1)]
            wanted = (weights * (call(*moved[0]) - call(*moved[1]))).sum() / (2 * STEP)
            assert float((slope * way).sum()) == pytest.approx(
                float(wanted), rel=GRADIENT_TOLERANCE, abs=GRADIENT_TOLERANCE
            )
    np.testing.assert_allclose(value, call(*at))


def test_quantiles_and_probabilities_vary_as_those_of_a_margin_that_is_normal():
    """Without load margins are proportional to max_force: m (1 + sigma z)."""
    one = jax.tree.map(lambda x: x[0], grasps())
    plain = float(jg.largest_disturbance(one, PUSHES).margin)
    threshold, sigma = 0.9 * plain, 0.2

    def both(scale, sigma, threshold):
        contacts = jg.Contacts.from_frames(one.positions, one.frames, friction=one.friction, max_force=6.0 * scale)
        spec = jg.Uncertainty.of(max_force=normal(sigma, correlation=1.0))
        found = jg.margin_distribution(
            contacts, PUSHES, spec, samples=SAMPLES, quantiles=(LEVEL,), at_least=threshold[None]
        )
        return (found.quantiles.value[0], found.at_least.value[0]), found

    at = (jnp.asarray(1.0), jnp.asarray(sigma), jnp.asarray(threshold))
    slopes, found = jax.jit(jax.jacrev(both, argnums=(0, 1, 2), has_aux=True))(*at)
    z, known = scipy.stats.norm.ppf(LEVEL), scipy.stats.norm(plain, plain * sigma)
    assert found.quantiles.low[0] <= known.ppf(LEVEL) <= found.quantiles.high[0]
    assert found.at_least.low[0] <= known.sf(threshold) <= found.at_least.high[0]
    by_quantile = plain * (1 + sigma * z), plain * z, 0
    density = known.pdf(threshold)
    by_probability = density * threshold, density * (threshold - plain) / sigma, -density
    for got, wanted in zip(slopes[0], by_quantile, strict=True):
        assert got == pytest.approx(wanted, rel=SAMPLED)
    for got, wanted in zip(slopes[1], by_probability, strict=True):
        assert got == pytest.approx(wanted, rel=SAMPLED)

    # The gradient is exact here, and so is what it estimates, up to the draws' own covariance.
    first = found.first_order
    assert first.good
    assert first.mean == pytest.approx(plain, rel=0.03)
    assert first.std == pytest.approx(plain * sigma, rel=0.05)
    assert first.quantiles[0] == pytest.approx(known.ppf(LEVEL), rel=0.05)


def test_a_first_order_estimate_that_is_not_good_says_so():
    """Normals that are far off only ever cost: the margin at the mean is far above the mean margin."""
    spec = jg.Uncertainty.of(normal=0.3)
    found = jg.margin_distribution(grasps(), PUSHES, spec, WEIGHT, samples=200)
    off = np.asarray(found.first_order.mean - found.mean.value) > 4 * np.asarray(found.mean.error) * np.sqrt(200) * 0.1
    assert off[0]
    assert not np.asarray(found.first_order.good)[off].any()
