"""Central points of block programs and how they move with the data, by the implicit function theorem.

The central point for kappa > 0 solves the optimality conditions with s z = kappa in every row,

    H x + A'z + E'y = 0  (and sum sigma z = 1 where lambda is free),    E x = b,    A x + sigma lambda + s = h.

Where the data change, the left sides change by r at the point, and with W = z/s it moves by

    [H + A'WA  A'W sigma       E'] [dx     ]     [r_x + A'W r_s              ]
    [          sigma'W sigma   0 ] [dlambda] = - [r_lambda + sigma'W r_s     ]    dz = W (r_s + A dx + sigma dlambda)
    [                          0 ] [dy     ]     [r_E                        ]

The problem factors this symmetric matrix as it does in the loop: block by block, linear in their number.

Source: Amos and Kolter (2017), "OptNet"; central-path smoothing as in Tracy and Manchester (2024), "On the
differentiability of the primal-dual interior-point method".
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.fence import fenced
from jaxgrasp.solvers.block_kkt import BlockProblem, Rows, adjoint_rows, apply_rows, total
from jaxgrasp.solvers.interior_point import Iterate, Residuals

_STEPS = 30
# Newton's steps of refinement of every solve with the symmetric matrix, whose condition grows as 1 / kappa^2.
_REFINEMENTS = 1


class Centre(NamedTuple):
    """A central point and how far it is from being one: the largest residual, (*lanes)."""

    iterate: Iterate
    error: jax.Array


def central_point(problem: BlockProblem, start: Iterate, kappa: jax.Array, active: jax.Array) -> Centre:
    """Newton's method on the conditions above, from a point near by.

    s and z are the two ends of one unknown v = z - s with s z = kappa, so every iterate is complementary and no step
    needs a ratio test. A lane freezes when its residuals are rounding, or grow.

    Args:
        problem: with a strict interior.
        start: where to begin; of its s and z only the difference counts.
        kappa: (*lanes), > 0.
        active: bool (*lanes); the other lanes stay as they are.
    """
    tolerance = 64 * jnp.finfo(kappa.dtype).eps

    def on_path(v: Rows) -> tuple[Rows, Rows]:
        def ends(v: jax.Array, present: jax.Array) -> tuple[jax.Array, jax.Array]:
            # The larger one first: the other would cancel.
            large = 0.5 * (jnp.abs(v) + jnp.sqrt(v * v + 4 * kappa))
            small = kappa / large
            s, z = jnp.where(v > 0, small, large), jnp.where(v > 0, large, small)
            return jnp.where(present > 0, s, 1), jnp.where(present > 0, z, 0)

        pairs = [ends(v_g, p) for v_g, p in zip(v, problem.present, strict=True)]
        return tuple(s for s, _ in pairs), tuple(z for _, z in pairs)

    def at(x: Any, y: jax.Array, v: Rows) -> tuple[Iterate, Residuals, jax.Array]:
        iterate = Iterate(x, y, *on_path(v))
        residuals = fenced(problem.residuals)(iterate)
        return iterate, residuals, _largest(residuals, len(problem.lanes))

    def unfinished(state: tuple) -> jax.Array:
        *_, step, going = state
        return (step < _STEPS) & jnp.any(going)

    def body(state: tuple) -> tuple:
        (x, y, v), (iterate, residuals, error), worse, step, going = state
        weights = _weights(problem, iterate)
        shift = jax.tree.map(jnp.multiply, weights, residuals.rows)
        dx, dy, rows = problem.solve(problem.factor(weights), residuals, shift)
        dz = jax.tree.map(lambda w, r, c: w * (r + c), weights, residuals.rows, rows)
        dv = jax.tree.map(lambda d, r, c: d + r + c, dz, residuals.rows, rows)
        new = jax.tree.map(jnp.add, (x, y, v), (dx, dy, dv))
        there = at(*new)
        better = there[2] < error
        # Far away Newton's steps may make things worse before they get better.
        worse = jnp.where(better, 0, worse + 1)
        take = going & jnp.isfinite(there[2]) & (better | (error > 1e-6))
        state = jax.tree.map(partial(jnp.where, take), (new, there), ((x, y, v), (iterate, residuals, error)))
        going = take & (state[1][2] > tolerance) & (worse < 4)
        return (*state, worse, step + 1, going)

    v = jax.tree.map(jnp.subtract, start.z, start.s)
    first = at(start.x, start.y, v)
    count = jnp.zeros(problem.lanes, jnp.int32)
    state = ((start.x, start.y, v), first, count, jnp.zeros((), jnp.int32), active & jnp.isfinite(first[2]))
    (_, (iterate, _, error), *_) = lax.while_loop(unfinished, body, state)
    return Centre(iterate, error)


def solve_symmetric(problem: BlockProblem, weights: Rows, right: tuple) -> tuple:
    """Solve the system above for W = `weights` and right-hand sides (x, lambda or None, y).

    Linear in these, and differentiable through its matrix alone: not through the factorisation.
    """

    def matrix(unknowns: tuple) -> tuple:
        dx, dlambda, dy = unknowns
        rows = change_of_rows(problem, dx, dlambda)
        push = jax.tree.map(jnp.multiply, weights, rows)
        out = []
        for g, x, p, e in zip(problem.groups, dx, push, problem.pull_back(dy), strict=True):
            row = adjoint_rows(g, p) + e + (1 - g.present) * x
            if g.hessian is not None:
                half = fold(jnp.add, jnp.moveaxis(g.hessian * x, 1, 0))
                row = row + fold(jnp.add, g.hessian * half[:, None])
            out.append(row)
        pull = fold(jnp.add, [total(g.sigma * p) for g, p in zip(problem.groups, push, strict=True)])
        return tuple(out), pull if problem.bordered else None, problem.equality(dx) - problem.dropped * dy

    factors = problem.factor(weights)

    def solve(_: Any, right: tuple) -> tuple:
        found = problem.newton(factors, *right)
        for _ in range(_REFINEMENTS):
            lacking = jax.tree.map(jnp.subtract, right, matrix(found))
            found = jax.tree.map(jnp.add, found, problem.newton(factors, *lacking))
        return found

    return lax.custom_linear_solve(matrix, right, solve, symmetric=True)


def change_of_rows(problem: BlockProblem, dx: Rows, dlambda: jax.Array | None) -> Rows:
    """A dx + sigma dlambda."""
    out = tuple(apply_rows(g, d) for g, d in zip(problem.groups, dx, strict=True))
    if dlambda is None:
        return out
    return tuple(o + g.sigma * dlambda for o, g in zip(out, problem.groups, strict=True))


def _weights(problem: BlockProblem, iterate: Iterate) -> Rows:
    return tuple(z * p / s for z, s, p in zip(iterate.z, iterate.s, problem.present, strict=True))


def _largest(residuals: Residuals, lanes: int) -> jax.Array:
    parts = []
    for leaf in jax.tree.leaves(residuals):
        part = jnp.abs(leaf)
        while part.ndim > lanes:
            part = fold(jnp.maximum, part)
        parts.append(part)
    return fold(jnp.maximum, parts)
