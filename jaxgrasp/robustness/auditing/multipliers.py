"""What the multipliers of (21) and (22) prove against the public arguments, see `pyramids`."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp import linalg
from jaxgrasp.arrays import fold
from jaxgrasp.robustness.auditing.parts import (
    cross,
    divided,
    inner,
    max_last,
    min_last,
    once,
    parts_of,
    rows_of,
    sum_last,
)
from jaxgrasp.robustness.auditing.problem import Hand, Problem, edges_of, facets
from jaxgrasp.robustness.auditing.rows import Rows
from jaxgrasp.robustness.interface.solution import Solution

# Shares of the margin's natural scale between a bound and its proof. An answer counts as wrong at five times as much.
CLOSED = {"float64": 2e-7, "float32": 2e-4}


class Evidence(NamedTuple):
    """What the solver adds to its answer for the audit; lanes lead.

    rows: S_1 and S_2 as it used them.
    cone_multipliers, bound_multipliers, wrench_multipliers, actuator_multipliers, joint_multipliers: those of (21) that
        prove the upper bound, as in `Solution`.
    """

    rows: Rows
    cone_multipliers: jax.Array
    bound_multipliers: jax.Array
    wrench_multipliers: jax.Array
    actuator_multipliers: jax.Array | None
    joint_multipliers: jax.Array | None


def reserves(problem: Problem, cone_edges: int) -> list[jax.Array]:
    """What every facet keeps in reserve, (lanes, n or 1) each."""
    assert problem.reserve is not None
    kept = parts_of(problem.reserve)
    return kept if len(kept) == cone_edges else kept * cone_edges


def weighed_sum(weights: Sequence[float], parts: Sequence[jax.Array]) -> jax.Array:
    """A sum with numbers for weights."""
    return fold(jnp.add, [float(weight) * part for weight, part in zip(weights, parts, strict=True)])


def effort_unit(hand: Hand) -> jax.Array:
    """The larger limit of every actuator, (lanes, n_u); a millionth of the largest where it is less, 0 for example."""
    larger = jnp.maximum(jnp.abs(hand.upper), jnp.abs(hand.lower))
    return jnp.maximum(larger, 1e-6 * jnp.maximum(larger.max(-1, keepdims=True), 1e-6))


def _pulled(problem: Problem, cone: jax.Array, bound: jax.Array, y: jax.Array) -> list[jax.Array]:
    """A'z + G'y by components, (lanes, n) each."""
    z = parts_of(cone)
    pattern = facets(problem, edges_of(problem, cone))
    first, second, normal, *moment = (weighed_sum(weights, z) for weights in pattern.T)
    given = [part[:, None] for part in parts_of(y)]
    turned = [given[a] + moment for a, moment in enumerate(cross(given[3:], parts_of(problem.positions)))]
    along = [inner(column, turned) for column in zip(*rows_of(problem.frames), strict=True)]
    if problem.arms is not None:
        along.append(problem.arms * inner(parts_of(problem.frames[..., 2]), given[3:]))
    along = [jnp.where(problem.transmits[..., k], part, 0) for k, part in enumerate(along)]
    turning = [m + a for m, a in zip(moment, along[3:], strict=True)]
    return [first + along[0], second + along[1], normal * problem.friction - bound + along[2], *turning]


def _lost(problem: Problem, residual: Sequence[jax.Array]) -> jax.Array:
    """The most that r'f can be for the admissible forces of every contact, (lanes, n)."""
    first, second, normal, *moment = (jnp.abs(part) for part in residual)
    return (fold(jnp.add, [first, second, *moment]) * problem.friction + normal) * problem.max_force


def _held(problem: Problem, cone: jax.Array, bound: jax.Array) -> jax.Array:
    """The contacts' part of h'z, (lanes, n)."""
    return bound * problem.max_force - inner(parts_of(cone), reserves(problem, cone.shape[-1]))


@once
def _pull(cone: jax.Array, bound: jax.Array, rows: Rows) -> jax.Array:
    """The contacts' part of z'sigma, (lanes, n); -inf where a multiplier is negative and proves nothing."""
    z = [*parts_of(cone), bound]
    pull = inner(z, [*parts_of(rows.cone), rows.bound])
    return jnp.where(fold(jnp.minimum, z) >= 0, pull, -jnp.inf)


def proven_bounds(problem: Problem, evidence: Evidence, rows: Rows) -> tuple[jax.Array, jax.Array]:
    """The bound that the multipliers prove, inf where none, and whether they prove that b cannot be borne; (lanes,)."""
    cone, bound, y = evidence.cone_multipliers, evidence.bound_multipliers, evidence.wrench_multipliers

    @once
    def costs(problem: Problem, cone: jax.Array, bound: jax.Array, y: jax.Array, more: jax.Array | None) -> jax.Array:
        """The part of h'z - r'f of every contact at the most, (lanes, n)."""
        residual = _added(_pulled(problem, cone, bound, y), more)
        return jnp.where(problem.present, _held(problem, cone, bound) + _lost(problem, residual), 0)

    pull, value, more = sum_last(_pull(cone, bound, rows)), sum_last(problem.wrench * y), None
    sound = pull > -jnp.inf
    if problem.hand is not None:
        more, held, spent = _of_efforts(problem.hand, evidence, rows)
        pull, value = pull + held[0], value + held[1] + spent
        assert evidence.actuator_multipliers is not None
        sound &= min_last(evidence.actuator_multipliers, 2) >= 0
    value = value + sum_last(costs(problem, cone, bound, y, more))
    bound = jnp.where(sound & (pull > 0), value / jnp.where(pull > 0, pull, 1), jnp.inf)
    return bound, sound & (value < 0)


def _of_efforts(hand: Hand, evidence: Evidence | Solution, rows: Rows) -> tuple:
    """What the multipliers of actuators and joints add: to r, (to z'sigma, to h'z), and the most that r_u'u can be."""
    z, y = evidence.actuator_multipliers, evidence.joint_multipliers
    assert z is not None and y is not None and rows.effort is not None
    more = jnp.einsum("liav,lv->lia", hand.jacobian, y, precision="highest")
    left = jnp.einsum("...vu,...v->...u", hand.transmission, y, precision="highest")
    residual = z[..., 0] - z[..., 1] - left
    pull = (z[..., 0] * rows.effort[:, 0] + z[..., 1] * rows.effort[:, 1]).sum(-1)
    value = (z[..., 0] * hand.upper - z[..., 1] * hand.lower).sum(-1)
    return more, (pull, value), (jnp.abs(residual) * effort_unit(hand)).sum(-1)


def needs_no_less(problem: Problem, solution: Solution, rows: Rows) -> jax.Array:
    """Whether no forces need less effort, by the multipliers of (22), (lanes,).

    1/2 f'Q_0 f >= min (1/2 f'Q_0 f + r'f) - h'z - b'y with r = A'z + G'y, for all admissible f.
    """
    dtype, asked = solution.forces.dtype.name, problem.margin
    cone, bound, y = solution.cone_multipliers, solution.bound_multipliers, solution.wrench_multipliers
    pull, value, spent, more = sum_last(_pull(cone, bound, rows)), 0.0, 0.0, None
    sound = pull > -jnp.inf
    if problem.hand is not None:
        more, (moved, value), spent = _of_efforts(problem.hand, solution, rows)
        pull = pull + moved
        assert solution.actuator_multipliers is not None
        sound &= min_last(solution.actuator_multipliers, 2) >= 0

    @once
    def shares(problem: Problem, solution: Solution, more: jax.Array | None) -> list[jax.Array]:
        """Every contact's effort, part of h'z, and least of its part of 1/2 f'Q_0 f + r'f by two bounds, (lanes, n)."""
        cone, bound = solution.cone_multipliers, solution.bound_multipliers
        residual = _added(_pulled(problem, cone, bound, solution.wrench_multipliers), more)
        forces = parts_of(solution.forces)
        weighed, answered = _weighed_by_effort(problem, forces, residual)
        own = 0.5 * inner(forces, weighed)
        # Without the limits of contacts, and by the tangent at f_0 within them.
        tangent = [w + r for w, r in zip(weighed, residual, strict=True)]
        found = own, _held(problem, cone, bound), -0.5 * inner(residual, answered), -own - _lost(problem, tangent)
        return [jnp.where(problem.present, part, jnp.zeros_like(own)) for part in found]

    own, held, *bounds = shares(problem, solution, more)
    effort = sum_last(own)
    # The better bound of every contact; a full Q_0 bounds all contacts at once.
    full = problem.weights is not None and problem.weights.ndim < 4
    lower = jnp.maximum(*map(sum_last, bounds)) if full else sum_last(jnp.maximum(*bounds))
    assert asked is not None
    lower = lower - sum_last(held) - sum_last(problem.wrench * y) - value - spent + asked * pull
    strength = problem.max_force**2
    if problem.weights is not None:
        largest = max_last(jnp.abs(_acting(problem, problem.weights)), 2)
        strength = strength * (largest[:, None] if full else largest)
    unit = max_last(jnp.where(problem.present, strength, 0))
    near = CLOSED[dtype] * jnp.maximum(effort, 1e-3 * unit)
    return sound & (effort - lower <= near) & (jnp.abs(effort - solution.effort) <= near)


def _weighed_by_effort(
    problem: Problem, forces: list[jax.Array], residual: list[jax.Array]
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Q_0 f and Q_0^-1 r by components, (lanes, n) each."""
    if problem.weights is None:
        return forces, residual
    weights = _acting(problem, problem.weights)
    if weights.ndim == 4:
        blocks = rows_of(weights)
        return [inner(row, forces) for row in blocks], divided(residual, blocks)
    flat = lambda parts: jnp.stack(parts, -1).reshape(*weights.shape[:-1], 1)
    apart = lambda x: parts_of(x.reshape(*forces[0].shape, len(forces)))
    return apart(weights @ flat(forces)), apart(linalg.solve_positive(weights, flat(residual)))


def _acting(problem: Problem, weights: jax.Array) -> jax.Array:
    """Q_0 of the components of force that contacts have, the identity of the others."""
    there = problem.transmits if weights.ndim == 4 else problem.transmits.reshape(len(problem.transmits), -1)
    both = there[..., None] & there[..., None, :]
    return jnp.where(both, weights, jnp.eye(weights.shape[-1], dtype=weights.dtype))


def _added(vectors: list[jax.Array], more: jax.Array | None) -> list[jax.Array]:
    """Vectors by components and others (lanes, n, 3), if there are any."""
    return vectors if more is None else [a + b for a, b in zip(vectors, parts_of(more), strict=True)]
