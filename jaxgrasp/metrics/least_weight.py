"""The min-weight of edges as the gauge of a polytope, with what proves it.

With the mean w of the m edges and the weights alpha_k = z_k + l,

    max l  such that  sum alpha_k w_k = 0,  sum alpha_k = 1,  z >= 0

is m l = 1 - min {sum z : z >= 0, sum z_k (w_k - w) = -w}: the gauge of -w among the edges about their mean, which are
balanced points. Its dual is the twist y with (w_k - w)'y <= 1, so that w_k'y <= m l for every edge.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.metrics.columns import Columns
from jaxgrasp.metrics.wrench_space import Edges
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.dense.gauge import ACCEPTED, SETTINGS, Gauge, GaugeProblem, gauge_of

# What is left of equal weights without the combinations of the rows, as a share: less is rounding.
_FLAT = {"float64": 1e-13, "float32": 1e-5}

CLOSED = {"float64": 1e-7, "float32": 1e-4}
"""The solver's own accuracy, of weights that sum up to one times their number: there is closure above it."""


class LeastWeight(NamedTuple):
    """The min-weight of grasps with its certificates; leaves (*batch, ...)."""

    gauge: jax.Array
    """(*batch,), 1 - m l of the weights z + l; inf where no weights cancel."""
    excess: jax.Array
    """(*batch, m), z; zero where no weights cancel."""
    twist: jax.Array
    """(*batch, 6), y: w_k'y is at most the largest m l, or negative where no weights cancel."""
    idle: jax.Array
    """(*batch, 6), a twist along which no edge does any work; zero where the edges span the space."""
    spans: jax.Array
    """bool (*batch,), whether the edges span the space."""
    solved: jax.Array
    """bool (*batch,), whether excess and twist prove the same gauge."""
    valid: jax.Array
    """bool (*batch,), whether the data are admissible."""
    number: jax.Array
    """(*batch,), m, at least 1."""


def least_weight(columns: Columns) -> LeastWeight:
    """Find the min-weight of the edges of grasps; lanes trail."""
    dtype, count = columns.points.dtype, columns.number
    mean = fold(jnp.add, jnp.swapaxes(columns.points, 0, 1)) / count
    # Where equal weights are a combination of the rows, the edges lie in a plane beside the origin.
    rest = 1 - count * fold(jnp.add, mean * mean)
    cancel = (rest > _FLAT[dtype.name]) & (fold(jnp.maximum, columns.present) > 0)
    problem = GaugeProblem(
        points=(columns.points - mean[:, None]) * columns.present,
        target=-mean,
        present=columns.present,
        dropped=1 - columns.basis.kept,
        lean=mean * jnp.sqrt(count / jnp.where(cancel, rest, 1)),
    )
    record = interior_point.solve(problem, SETTINGS[dtype.name], columns.valid & cancel).record
    gap = record.upper - record.lower
    return LeastWeight(
        gauge=jnp.where(cancel, record.upper, jnp.inf),
        excess=record.z,
        # Where no weights cancel, every edge does the same work along the mean.
        twist=columns.twist(jnp.where(cancel, record.y, -mean)),
        idle=columns.idle,
        spans=columns.spans,
        solved=~cancel | (gap <= ACCEPTED[dtype.name] * jnp.maximum(1, record.lower)),
        valid=columns.valid,
        number=count,
    )


def varying(edges: Edges, found: LeastWeight) -> Gauge:
    """The gauge, y and z as functions of the edges, which were constants where they were found."""
    mean = edges.flat.sum(-2) / found.number[..., None]
    centred = jnp.where(edges.counted[..., None], edges.flat - mean[..., None, :], 0)
    usable = jnp.isfinite(found.gauge) & found.solved
    return gauge_of(centred, -mean, Gauge(found.gauge, found.twist, found.excess), usable)
