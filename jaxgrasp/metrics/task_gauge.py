"""How far a wrench is inside the wrench space of a grasp, with what proves it.

With the edges u_k as columns, in coordinates in which the rows are orthonormal, it holds c / g of a wrench c, with

    g = min sum z  over z >= 0 with sum z_k u_k = c,

the gauge of c. Where the edges cancel with positive weights and span the space there always is such a z. Elsewhere
twelve more points, +-e_j / `_LIMIT`, make one. They are so short that they bear only what the edges cannot.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.metrics.columns import Columns
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.dense.gauge import ACCEPTED, SETTINGS, GaugeProblem, Record

MISSED = {"float64": 1e-8, "float32": 1e-4}
"""A wrench of which fingers exert all but this share counts as exerted, and less than this share of it as nothing."""
# The other points are so much shorter than unit wrenches.
_LIMIT = {"float64": 1e8, "float32": 1e4}
# Far from the hull the rounding of large twists spoils the last steps.
_SETTINGS = {
    "float64": SETTINGS["float64"]._replace(gap_share=0.1),
    "float32": SETTINGS["float32"]._replace(gap_share=0.5, tolerance=4e-5),
}


class TaskGauge(NamedTuple):
    """The gauge with its certificates; leaves (*batch, ...)."""

    gauge: jax.Array
    """(*batch,), g; inf where the fingers cannot exert the wrench."""
    shares: jax.Array
    """(*batch, m), z."""
    twist: jax.Array
    """(*batch, 6), y: w_k'y is at most 1 for every edge, and c'y is g."""
    solved: jax.Array
    """bool (*batch,), whether z and y prove the same gauge."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _TaskProblem(GaugeProblem):
    """The gauge of a point that may be far outside."""

    def gap_scale(self, record: Record) -> jax.Array:
        """Measure gaps by the gauge itself, which is at least about 1."""
        return jnp.maximum(record.lower, 1)


def task_gauge(columns: Columns, target: jax.Array, balance: jax.Array) -> TaskGauge:
    """Find the gauges of wrenches; lanes trail.

    Args:
        columns: the edges.
        target: c, (6, *lanes); zero where nothing is asked.
        balance: a > 0 of the edges that count, sum a_k u_k = 0, (m, *lanes); zero where there is no such a.
    """
    dtype, many = target.dtype, len(columns.present)
    limit = _LIMIT[dtype.name]
    wrench = columns.basis.coordinates(target)
    size = jnp.sqrt(fold(jnp.add, wrench * wrench))
    balanced = fold(jnp.maximum, balance) > 0
    weights = jnp.where(balanced, balance, columns.present)
    # What the weights leave is balanced by the other points, where they are there.
    unbalanced = limit * fold(jnp.add, jnp.swapaxes(columns.points * weights, 0, 1))
    lacking = 1 - jnp.where(balanced & columns.spans, jnp.ones_like(size), 0)
    others = jnp.concatenate([1 + jnp.maximum(-unbalanced, 0), 1 + jnp.maximum(unbalanced, 0)]) * lacking
    unit = jnp.concatenate([jnp.eye(6, dtype=dtype), -jnp.eye(6, dtype=dtype)], -1) / limit
    points = unit.reshape(6, 12, *[1] * size.ndim) * lacking
    problem = _TaskProblem(
        points=jnp.concatenate([columns.points, points], 1),
        target=wrench / jnp.where(size > 0, size, 1),
        present=jnp.concatenate([columns.present, jnp.ones_like(others) * lacking]),
        dropped=(1 - columns.basis.kept) * (1 - lacking),
        lean=None,
        balance=jnp.concatenate([weights, others]),
    )
    record = interior_point.solve(problem, _SETTINGS[dtype.name], columns.valid & (size > 0)).record
    shares, left = record.z[:many], fold(jnp.add, record.z[many:]) / limit
    gap = record.upper - record.lower
    return TaskGauge(
        gauge=jnp.where(left <= MISSED[dtype.name], size * fold(jnp.add, shares), jnp.inf),
        shares=size * shares,
        twist=columns.twist(record.y),
        solved=gap <= ACCEPTED[dtype.name] * jnp.maximum(record.lower, 1),
    )
