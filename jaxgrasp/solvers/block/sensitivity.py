"""Central points of block programs and how they move with the data, by the implicit function theorem.

The central point for kappa > 0 solves the optimality conditions with s z = kappa in every row,

    H x + A'z + E'y = 0  (and sum sigma z = 1 where lambda is free),    E x = b,    A x + sigma lambda + s = h.

Where the data change, the left sides change by r at the point, and it moves by

    [H   0       E'  A'  ] [dx     ]
    [    0       0   sigma'] [dlambda] = -r
    [            0   0   ] [dy     ]
    [               -s/z ] [dz     ]

This symmetric matrix is reduced as in the loop, to rows, blocks, lambda and the equality rows, at a cost that is linear
in the number of blocks. Residuals are those of the whole system, in which nothing is as large as z/s.

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

_STEPS = 30
# Newton's step, a quarter of it, a sixteenth ...: the best of so many is taken.
_LENGTHS = 4
# Without, forward and reverse mode are 1e-7 apart; with one, 1e-10.
_REFINEMENTS = 1


class Centre(NamedTuple):
    """A central point and how far it is from being one: the largest residual, (*lanes)."""

    iterate: Iterate
    error: jax.Array


def central_point(problem: BlockProblem, start: Iterate, kappa: jax.Array, active: jax.Array) -> Centre:
    """Newton's method on the conditions above, from a point near by.

    s and z are the two ends of one unknown v = z - s with s z = kappa, so every iterate is complementary and no step
    needs a ratio test. A lane freezes when its residuals are rounding, or no step makes them smaller.

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
        return iterate, residuals, reduce_rows(jnp.maximum, jax.tree.map(jnp.abs, residuals), len(problem.lanes))

    def unfinished(state: tuple) -> jax.Array:
        *_, step, going = state
        return (step < _STEPS) & jnp.any(going)

    def body(state: tuple) -> tuple:
        point, (iterate, residuals, error), step, going = state
        weights = _weights(problem, iterate.s, iterate.z)
        shift = jax.tree.map(jnp.multiply, weights, residuals.rows)
        dx, dy, rows = problem.solve(problem.factor(weights), residuals, shift)
        dz = jax.tree.map(lambda w, r, c: w * (r + c), weights, residuals.rows, rows)
        dv = jax.tree.map(lambda d, r, c: d + r + c, dz, residuals.rows, rows)

        def shorten(i: jax.Array, best: tuple) -> tuple:
            new = jax.tree.map(lambda p, d: p + 0.25**i * d, point, (dx, dy, dv))
            there = at(*new)
            return jax.tree.map(partial(jnp.where, there[2] < best[1][2]), (new, there), best)

        new, there = repeat(_LENGTHS, shorten, (point, (iterate, residuals, error)))
        going &= there[2] < error
        point, there = jax.tree.map(partial(jnp.where, going), (new, there), (point, (iterate, residuals, error)))
        return point, there, step + 1, going & (there[2] > tolerance)

    point = start.x, start.y, jax.tree.map(jnp.subtract, start.z, start.s)
    first = at(*point)
    state = (point, first, jnp.zeros((), jnp.int32), active & jnp.isfinite(first[2]))
    _, (iterate, _, error), *_ = lax.while_loop(unfinished, body, state)
    return Centre(iterate, error)


def solve_symmetric(problem: BlockProblem, s: Rows, z: Rows, right: tuple) -> tuple:
    """Solve the system above with right-hand sides, and for unknowns, (x, lambda or None, y, z).

    Linear in these, and differentiable through its matrix alone: not through the factorisation.
    """
    present, weights = problem.present, _weights(problem, s, z)
    stiff = tuple(
        jnp.where(p > 0, s_g / jnp.where(p > 0, z_g, 1), 1) for z_g, s_g, p in zip(z, s, present, strict=True)
    )

    def matrix(unknowns: tuple) -> tuple:
        dx, dlambda, dy, dz = unknowns
        out = []
        for g, x, row, e in zip(problem.groups, dx, dz, problem.pull_back(dy), strict=True):
            left = adjoint_rows(g, row * g.present) + e + (1 - g.present) * x
            if g.hessian_root is not None:
                left = left + apply_hessian(g, x)
            out.append(left)
        rows = tuple(apply_rows(g, x) * g.present for g, x in zip(problem.groups, dx, strict=True))
        pull = None
        if dlambda is not None:
            rows = tuple(r + g.sigma * dlambda for g, r in zip(problem.groups, rows, strict=True))
            pull = fold(jnp.add, [total(g.sigma * row) for g, row in zip(problem.groups, dz, strict=True)])
        rows = jax.tree.map(lambda r, c, d: r - c * d, rows, stiff, dz)
        return tuple(out), pull, problem.equality(dx) - problem.dropped * dy, rows

    factors = problem.factor(weights)

    def eliminate(right: tuple) -> tuple:
        """By way of dz = W (A dx + sigma dlambda - r), which is all that an absent row lacks."""
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
        found = eliminate(right)
        for _ in range(_REFINEMENTS):
            lacking = jax.tree.map(jnp.subtract, right, matrix(found))
            found = jax.tree.map(jnp.add, found, eliminate(lacking))
        return found

    return lax.custom_linear_solve(matrix, right, solve, symmetric=True)


def _weights(problem: BlockProblem, s: Rows, z: Rows) -> Rows:
    return tuple(z_g * p / s_g for z_g, s_g, p in zip(z, s, problem.present, strict=True))
