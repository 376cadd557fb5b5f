"""Statistics of drawn margins with their sampling errors, and how they vary.

Values are those of the sample; a margin of -inf stands for a draw in which nothing holds. Derivatives are pathwise: the
same draws, each margin with its own derivative dm. A mean varies by the mean of dm, the conditional value at risk by
the mean of dm in the tail. A quantile q and a probability P(m >= x) vary by

    dq = E[dm | m = q],      dP = p(x) E[dm | m = x]

with p the density, where both conditions are estimated by a Gaussian kernel of Silverman's width.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgrasp.records import record

# Of a standard normal distribution: between -z and z lie 95 %.
_Z = 1.959963984540054


@record
class Estimate:
    """A statistic of samples with its sampling error."""

    value: Float[Array, "..."]
    """The estimate; NaN where there is none."""
    error: Float[Array, "..."]
    """Its standard error; of a quantile a quarter of the interval's width, nearly."""
    low: Float[Array, "..."]
    """The lower end of the 95 % interval; -inf where the samples set none."""
    high: Float[Array, "..."]
    """The upper end; inf where the samples set none."""


def mean_of(margins: jax.Array) -> Estimate:
    """The mean of samples (..., S)."""
    count = margins.shape[-1]
    value = _linear(margins, jnp.full_like(margins, 1 / count), margins.mean(-1))
    error = jax.lax.stop_gradient(_deviation(margins)) / math.sqrt(count)
    return _normal(value, error, count - 1)


def probability_of(margins: jax.Array, threshold: jax.Array) -> Estimate:
    """P(m >= x) of samples (..., S) for x (...), with Wilson's interval."""
    count = margins.shape[-1]
    still = jax.lax.stop_gradient(margins)
    value = (still >= threshold[..., None]).astype(margins.dtype).mean(-1)
    weights = _kernel(still, jax.lax.stop_gradient(threshold)) / count
    # P(m - x >= 0), so that x varies like -m.
    varying = _linear(margins - threshold[..., None], weights, value)
    square = _Z**2 / count
    middle = (value + square / 2) / (1 + square)
    half = _Z * jnp.sqrt(value * (1 - value) / count + square / (4 * count)) / (1 + square)
    return Estimate(
        value=varying,
        error=jnp.sqrt(value * (1 - value) / count),
        low=jnp.maximum(middle - half, 0),
        high=jnp.minimum(middle + half, 1),
    )


def quantile_of(margins: jax.Array, ranked: jax.Array, level: float) -> Estimate:
    """The quantile of samples (..., S), with the interval between two of them that holds for any distribution.

    Args:
        margins: the samples.
        ranked: the same by rising value; it has no derivative.
        level: between 0 and 1.
    """
    count = margins.shape[-1]
    value = ranked[..., min(max(int(np.ceil(level * count - 1e-9)), 1), count) - 1]
    kernel = _kernel(ranked, value)
    # In the order of the margins.
    total = kernel.sum(-1, keepdims=True)
    weights = _kernel(jax.lax.stop_gradient(margins), value) / jnp.where(total > 0, total, 1)
    below, above = _ranks_around(count, level)
    low = ranked[..., below - 1] if below >= 1 else jnp.full_like(value, -jnp.inf)
    high = ranked[..., above - 1] if above <= count else jnp.full_like(value, jnp.inf)
    same = high == low
    error = jnp.where(same, 0, jnp.where(same, 0, high) - jnp.where(same, 0, low)) / (2 * _Z)
    return Estimate(value=_linear(margins, weights, value), error=error, low=low, high=high)


def tail_mean_of(margins: jax.Array, ranked: jax.Array, share: float) -> Estimate:
    """The conditional value at risk: the mean of the worst share of samples (..., S).

    Args:
        margins: the samples.
        ranked: the same by rising value; it has no derivative.
        share: of the samples, in (0, 1].
    """
    count = margins.shape[-1]
    whole = max(share * count, 1.0)
    by_rank = np.clip(whole - np.arange(count), 0, 1) / whole
    used = int(np.ceil(whole))
    value = (ranked[..., :used] * by_rank[:used].astype(ranked.dtype)).sum(-1)
    edge = ranked[..., used - 1]
    still = jax.lax.stop_gradient(margins)
    # Samples that equal the last one of the tail share what is left of it.
    under, at = (still < edge[..., None]).astype(margins.dtype), (still == edge[..., None]).astype(margins.dtype)
    left = (whole - under.sum(-1)) / jnp.maximum(at.sum(-1), 1)
    weights = (under + at * left[..., None]) / whole
    # Of the mean of q - max(q - m, 0) / share, whose derivative by q is zero.
    short = jnp.where(under > 0, jnp.where(under > 0, edge[..., None], 0) - still, 0)
    error = _deviation(short) / (whole / count) / math.sqrt(count)
    return _normal(_linear(margins, weights, value), error, whole - 1)


def _normal(value: jax.Array, error: jax.Array, freedom: float) -> Estimate:
    """An estimate with errors as of Student's distribution with so many degrees of freedom."""
    still = jax.lax.stop_gradient(value)
    finite = jnp.isfinite(still)
    # Its quantile by Cornish and Fisher's expansion.
    n = max(freedom, 1.0)
    t = _Z + (_Z**3 + _Z) / (4 * n) + (5 * _Z**5 + 16 * _Z**3 + 3 * _Z) / (96 * n**2)
    bound = lambda sign: jnp.where(finite, still + sign * t * error, sign * jnp.inf)
    return Estimate(value=value, error=jnp.where(finite, error, jnp.inf), low=bound(-1), high=bound(1))


def _deviation(x: jax.Array) -> jax.Array:
    """The standard deviation along the last axis; NaN or infinite where an entry is."""
    count = x.shape[-1]
    apart = x - x.mean(-1, keepdims=True)
    return jnp.sqrt((apart**2).sum(-1) / max(count - 1, 1))


def _kernel(margins: jax.Array, at: jax.Array) -> jax.Array:
    """The density of a Gaussian kernel around each of the samples (..., S) at (...), and of those that are equal."""
    finite = jnp.isfinite(margins)
    safe = jnp.where(finite, margins, 0)
    count = jnp.maximum(finite.astype(margins.dtype).sum(-1, keepdims=True), 1)
    mean = safe.sum(-1, keepdims=True) / count
    spread = jnp.sqrt((jnp.where(finite, safe - mean, 0) ** 2).sum(-1, keepdims=True) / count)
    width = 1.06 * spread * count**-0.2
    width = jnp.where(width > 0, width, 1)
    apart = jnp.where(finite, safe - jnp.where(jnp.isfinite(at), at, 0)[..., None], jnp.inf) / width
    return jnp.exp(-0.5 * apart**2) / (width * math.sqrt(2 * math.pi))


def _ranks_around(count: int, level: float) -> tuple[int, int]:
    """The ranks, from 1, of the samples between which the quantile lies with at least 95 %; 0 and count + 1 are none.

    The number of samples below the quantile is binomial.
    """
    steps = np.arange(1, count + 1)
    logarithms = np.concatenate([[0.0], np.cumsum(np.log((count + 1 - steps) / steps))])
    k = np.arange(count + 1)
    terms = np.exp(logarithms + k * np.log(level) + (count - k) * np.log1p(-level))
    cumulative = np.cumsum(terms)
    low, high = (int(np.searchsorted(cumulative, p * cumulative[-1])) for p in (0.025, 0.975))
    return low, high + 1


@jax.custom_jvp
def _linear(margins: jax.Array, weights: jax.Array, value: jax.Array) -> jax.Array:
    """A value that varies like the sum of the weights times the margins, both (..., S)."""
    return value


@_linear.defjvp
def _linear_jvp(primals: tuple, tangents: tuple) -> tuple:
    _, weights, value = primals
    return value, (weights * tangents[0]).sum(-1)
