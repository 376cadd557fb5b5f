"""The audit of the chain's formulations and of (11): forces for every disturbance against the public arguments.

Forces are checked as in `pyramids`. What they cannot show, that no others do better, is shown by the multipliers of the
scaled programs, which are put together anew by XLA.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.robustness.auditing.multipliers import CLOSED, reserves
from jaxgrasp.robustness.auditing.problem import Problem
from jaxgrasp.robustness.auditing.pyramids import MISSED, balanced, row_values
from jaxgrasp.robustness.auditing.rows import own_inverse
from jaxgrasp.solvers.conic.margin import ConicMargin, ConicPoint, inner


class ChainVerdict(NamedTuple):
    """failed: bool (lanes,); margin: (lanes,), what the audit itself confirms, NaN where nothing."""

    failed: jax.Array
    margin: jax.Array


class EffortVerdict(NamedTuple):
    """failed: bool (lanes,)."""

    failed: jax.Array


def admissible(problem: Problem, forces: jax.Array, exact: bool, cone_edges: int, norm_bound: bool) -> jax.Array:
    """Whether forces (lanes, n, k) keep to their cones and bounds, (lanes,)."""
    most = problem.max_force
    slack = MISSED[forces.dtype.name] * most
    normal, friction = forces[..., 2], problem.friction
    if exact:
        square = forces[..., 0] ** 2 + forces[..., 1] ** 2
        tangent = jnp.sqrt(square if problem.arms is None else square + forces[..., 3] ** 2)
        over = tangent + friction * normal
        over = over if problem.reserve is None else over + problem.reserve[..., 0]
        within = (normal <= slack) & (over <= slack)
        if norm_bound:
            within &= jnp.sqrt((forces[..., :3] ** 2).sum(-1)) <= most + slack
    else:
        cone = row_values(problem, forces, cone_edges)[0]
        if problem.reserve is not None:
            cone = [row + kept for row, kept in zip(cone, reserves(problem, cone_edges), strict=True)]
        within = fold(jnp.logical_and, [row <= slack for row in cone])
    return ((within & (-normal <= most + slack)) | ~problem.present).all(-1)


def disturbed_wrenches(problem: Problem, margins: jax.Array) -> jax.Array:
    """B - lambda W_j, (lanes, n_d, 6), for margins (lanes, n_d)."""
    wrenches = jnp.moveaxis(wrenches_of(problem.terms), -1, 0)
    finite = jnp.where(jnp.isfinite(margins), margins, 0)
    return problem.wrench[:, None] - finite[:, :, None] * wrenches


def all_hold(problem: Problem, forces: jax.Array, wrenches: jax.Array, check: tuple[bool, int, bool]) -> jax.Array:
    """Whether forces (lanes, n_d, n, 3) answer wrenches (lanes, n_d, 6) within the rows, (lanes,).

    Args:
        problem: the public arguments.
        forces: one set of forces for each wrench.
        wrenches: what they have to supply.
        check: whether the cones are exact, n_e, and whether |f| is bounded.
    """

    def one(forces: jax.Array, wrench: jax.Array) -> jax.Array:
        return balanced(problem, forces, wrench) & admissible(problem, forces, *check)

    return jax.vmap(one, (1, 1), 1)(forces, wrenches).all(1)


def blocking_forces_stand(problem: Problem, changes: jax.Array, margin: jax.Array) -> jax.Array:
    """Whether changes (lanes, n_d, n, 3) are the blocking forces -lambda G* W_j with G* computed anew, (lanes,)."""
    inverse = own_inverse(problem)
    wrenches = wrenches_of(problem.terms)
    finite = jnp.where(jnp.isfinite(margin), margin, 0)
    wanted = -jnp.einsum("kcl,dcl->ldk", inverse, jnp.broadcast_to(wrenches, (*wrenches.shape[:2], inverse.shape[-1])))
    wanted = finite[:, None, None, None] * wanted.reshape(changes.shape)
    missed = jnp.abs(jnp.where(problem.present[:, None, :, None], changes - wanted, 0)).max(-1)
    size = jnp.maximum(problem.max_force[:, None], jnp.abs(wanted).max((1, 2, 3))[:, None, None])
    return (missed <= 10 * MISSED[changes.dtype.name] * size).all((1, 2))


def proven_bounds(program: ConicMargin, point: ConicPoint) -> jax.Array:
    """What the multipliers of conic programs prove about lambda, inf where nothing; (D, lanes).

    z in K, lambda (z'sigma + y'w) <= h'z + b'y - r'x with r = A'z + E'y, and |x| <= 1.
    """
    z = tuple(
        jnp.maximum(part, 0)
        if not rows.second_order
        else part.at[0].set(jnp.maximum(part[0], jnp.sqrt(fold(jnp.add, part[1:] ** 2))))
        for rows, part in zip(program.rows, point.z, strict=True)
    )
    pulled, sigma = program.adjoint(z)
    sides = [jnp.broadcast_to(rows.sides(), part.shape) for rows, part in zip(program.rows, z, strict=True)]
    value = inner(sides, z) + fold(jnp.add, point.y * program.rhs)
    lost = jnp.abs(pulled + program.pull_back(point.y))
    value = value + fold(jnp.add, fold(jnp.add, lost))
    pull = sigma + fold(jnp.add, program.border * point.y)
    return jnp.where(pull > 0, value / jnp.where(pull > 0, pull, 1), jnp.inf)


def settled(
    margin: jax.Array, upper: jax.Array, proven: jax.Array | None, scale: jax.Array, holds: jax.Array
) -> jax.Array:
    """Whether a margin stands that forces attain: bounds in order, close, and proven where that was looked at."""
    slack = CLOSED[margin.dtype.name] * jnp.maximum(scale, jnp.abs(jnp.where(jnp.isfinite(margin), margin, 0)))
    stands = holds & (margin <= upper) & ((upper - margin <= slack) | (margin == upper))
    return stands if proven is None else stands & (proven <= upper + slack)


def least_total_effort_stands(effort: jax.Array, lower: jax.Array, found: jax.Array, unit: jax.Array) -> jax.Array:
    """Whether the effort is that of the forces found, and the bound that the multipliers prove is close, (lanes,)."""
    near = 10 * CLOSED[effort.dtype.name] * jnp.maximum(effort, 1e-3 * unit)
    return (jnp.abs(effort - found) <= near) & (effort - lower <= near)
