"""Central points of block programs and how they move with the data, by the implicit function theorem.

The central point for kappa > 0 solves the optimality conditions with s z = kappa in every row,

    H x + A'z + E'y = 0  (and sum sigma z = 1 where lambda is free),    E x = b,    A x + sigma lambda + s = h.

Where the data change, the left sides change by r at the point, and it moves by

    [H   0       E'  A'  ] [dx     ]
    [    0       0   sigma'] [dlambda] = -r
    [            0   0   ] [dy     ]
    [               -s/z ] [dz     ]

This symmetric matrix is reduced as in the loop (`kkt`): with dz = W (A dx + sigma dlambda - r_z), W = Z/S, it becomes
the Newton system, whose cost is linear in the number of blocks. Refinement takes the residuals of the whole system,
in which no entry is as large as z/s. As kappa -> 0, s/z goes to 0 in active rows and to infinity in the others: the
derivative becomes that of the equalities that the active rows are.

Source: Amos and Kolter (2017), "OptNet"; central-path smoothing as in Tracy and Manchester (2024), "On the
differentiability of the primal-dual interior-point method".
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced, repeat
from jaxgrasp.solvers.block.kkt import BlockProblem, Rows, adjoint_rows, apply_hessian, apply_rows, total
from jaxgrasp.solvers.interior_point import Iterate, Residuals, reduce_rows

_MAX_STEPS = 30
# A step tries this many lengths, Newton's, a quarter of it, a sixteenth ..., and takes the best.
_LENGTHS = 4
# Without refinement, forward and reverse mode are 1e-7 apart; with one step of it, 1e-10.
_REFINEMENTS = 1


class Centre(NamedTuple):
    """A central point and its error: the largest residual, (*lanes)."""

    iterate: Iterate
    error: jax.Array


def central_point(problem: BlockProblem, start: Iterate, kappa: jax.Array, active: jax.Array) -> Centre:
    """Find the central point for kappa by Newton's method, from a point near by.

    The unknown in place of s and z is v = z - s: with s z = kappa it gives both, so every iterate is complementary and
    no step needs a ratio test. A lane freezes when its residuals are rounding, or no step makes them smaller.

    Args:
        problem: a problem whose rows have a strict interior.
        start: the first point; only the difference of its s and z counts.
        kappa: (*lanes), > 0.
        active: bool (*lanes); lanes that are False stay as they are.
    """
    tolerance = 64 * jnp.finfo(kappa.dtype).eps

    def slacks_and_multipliers(v: Rows) -> tuple[Rows, Rows]:
        """Compute s and z with z - s = v and s z = kappa; 1 and 0 in absent rows."""

        def roots(v: jax.Array, present: jax.Array) -> tuple[jax.Array, jax.Array]:
            # The larger root first, (|v| + sqrt(v^2 + 4 kappa)) / 2: the smaller one would cancel.
            large = 0.5 * (jnp.abs(v) + jnp.sqrt(v * v + 4 * kappa))
            small = kappa / large
            s, z = jnp.where(v > 0, small, large), jnp.where(v > 0, large, small)
            return jnp.where(present > 0, s, 1), jnp.where(present > 0, z, 0)

        pairs = [roots(v_g, p) for v_g, p in zip(v, problem.present, strict=True)]
        return tuple(s for s, _ in pairs), tuple(z for _, z in pairs)

    def evaluate(x: Any, y: jax.Array, v: Rows) -> tuple[Iterate, Residuals, jax.Array]:
        """Compute the iterate at (x, y, v), its residuals and the largest of them."""
        iterate = Iterate(x, y, *slacks_and_multipliers(v))
        residuals = fenced(problem.residuals)(iterate)
        return iterate, residuals, reduce_rows(jnp.maximum, jax.tree.map(jnp.abs, residuals), len(problem.lanes))

    def unfinished(state: tuple) -> jax.Array:
        *_, step, unsolved = state
        return (step < _MAX_STEPS) & jnp.any(unsolved)

    def body(state: tuple) -> tuple:
        point, (iterate, residuals, error), step, unsolved = state
        # Newton's direction with dz = W (r + A dx), and dv = dz - ds with ds = -r - A dx.
        weights = _weights(problem, iterate.s, iterate.z)
        shift = jax.tree.map(jnp.multiply, weights, residuals.rows)
        dx, dy, rows = problem.solve(problem.factor(weights), residuals, shift)
        dz = jax.tree.map(lambda w, r, c: w * (r + c), weights, residuals.rows, rows)
        dv = jax.tree.map(lambda d, r, c: d + r + c, dz, residuals.rows, rows)

        # Of several lengths take the one with the smallest error.
        def shorten(i: jax.Array, best: tuple) -> tuple:
            new = jax.tree.map(lambda p, d: p + 0.25**i * d, point, (dx, dy, dv))
            evaluated = evaluate(*new)
            return jax.tree.map(partial(jnp.where, evaluated[2] < best[1][2]), (new, evaluated), best)

        old = (point, (iterate, residuals, error))
        new, evaluated = repeat(_LENGTHS, shorten, old)

        # Freeze lanes in which none is better.
        unsolved &= evaluated[2] < error
        point, evaluated = jax.tree.map(partial(jnp.where, unsolved), (new, evaluated), old)
        return point, evaluated, step + 1, unsolved & (evaluated[2] > tolerance)

    point = start.x, start.y, jax.tree.map(jnp.subtract, start.z, start.s)
    first = evaluate(*point)
    state = (point, first, jnp.zeros((), jnp.int32), active & jnp.isfinite(first[2]))
    _, (iterate, _, error), *_ = lax.while_loop(unfinished, body, state)
    return Centre(iterate, error)


def solve_symmetric(problem: BlockProblem, s: Rows, z: Rows, right: tuple) -> tuple:
    """Solve the symmetric system of this module's docstring.

    The result is linear in the right-hand side, and differentiable through the matrix alone, not the factorisation.

    Args:
        problem: the problem at the point.
        s: slacks, for every group.
        z: multipliers, for every group.
        right: the right-hand sides of the rows of x, lambda (None where it is held), y and z.

    Returns:
        The unknowns (dx, dlambda or None, dy, dz).
    """
    # s/z, and ones where a row is absent.
    present, weights = problem.present, _weights(problem, s, z)
    ratios = tuple(
        jnp.where(p > 0, s_g / jnp.where(p > 0, z_g, 1), 1) for z_g, s_g, p in zip(z, s, present, strict=True)
    )

    def matrix(unknowns: tuple) -> tuple:
        """Multiply by the matrix; absent unknowns have a 1 on its diagonal."""
        dx, dlambda, dy, dz = unknowns
        out = []
        for g, x, row, e in zip(problem.groups, dx, dz, problem.pull_back(dy), strict=True):
            stationarity = adjoint_rows(g, row * g.present) + e + (1 - g.present) * x
            if g.hessian_root is not None:
                stationarity = stationarity + apply_hessian(g, x)
            out.append(stationarity)
        rows = tuple(apply_rows(g, x) * g.present for g, x in zip(problem.groups, dx, strict=True))
        pull = None
        if dlambda is not None:
            rows = tuple(r + g.sigma * dlambda for g, r in zip(problem.groups, rows, strict=True))
            pull = fold(jnp.add, [total(g.sigma * row) for g, row in zip(problem.groups, dz, strict=True)])
        rows = jax.tree.map(lambda r, c, d: r - c * d, rows, ratios, dz)
        return tuple(out), pull, problem.equality(dx) - problem.dropped * dy, rows

    factors = problem.factor(weights)

    def eliminate(right: tuple) -> tuple:
        """Substitute dz = W (A dx + sigma dlambda - r_z) and solve the Newton system; in absent rows dz = -r_z."""
        right_x, right_lambda, right_y, right_z = right
        shift = jax.tree.map(jnp.multiply, weights, right_z)
        right_x = tuple(r + adjoint_rows(g, e) for g, r, e in zip(problem.groups, right_x, shift, strict=True))
        if right_lambda is not None:
            pulls = [total(g.sigma * e) for g, e in zip(problem.groups, shift, strict=True)]
            right_lambda = right_lambda + fold(jnp.add, pulls)
        dx, dlambda, dy = problem.newton(factors, right_x, right_lambda, right_y)
        rows = tuple(apply_rows(g, x) for g, x in zip(problem.groups, dx, strict=True))
        if dlambda is not None:
            rows = tuple(r + g.sigma * dlambda for g, r in zip(problem.groups, rows, strict=True))
        dz = jax.tree.map(lambda w, r, e, p: jnp.where(p > 0, w * (r - e), -e), weights, rows, right_z, present)
        return dx, dlambda, dy, dz

    def solve(_: Any, right: tuple) -> tuple:
        solution = eliminate(right)
        for _ in range(_REFINEMENTS):
            remainder = jax.tree.map(jnp.subtract, right, matrix(solution))
            solution = jax.tree.map(jnp.add, solution, eliminate(remainder))
        return solution

    return lax.custom_linear_solve(matrix, right, solve, symmetric=True)


def _weights(problem: BlockProblem, s: Rows, z: Rows) -> Rows:
    """Compute z/s, 0 in absent rows."""
    return tuple(z_g * p / s_g for z_g, s_g, p in zip(z, s, problem.present, strict=True))
