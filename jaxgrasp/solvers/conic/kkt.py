"""The Newton system of the conic embedding, reduced to a few equality rows and lambda.

With Nesterov's and Todd's scaling W (W^-1 s = W z), a step that aims at a has ds = W a - W^2 dz, and solves

    A'dz + E'dy = r_x,    sigma'dz + w'dy = r_lambda,    E dx + w dlambda = r_y,
    dz = W^-2 (A dx + sigma dlambda + u)

for its residuals r and for the constants (c, b, h), which dtau multiplies. Substituting dz gives

    [ P         P phi             E' ] [dx     ]   [ r_x - A'W^-2 u          ]
    [ phi'P     sigma'W^-2 sigma  w' ] [dlambda] = [ r_lambda - sigma'W^-2 u ]
    [ E         w                 0  ] [dy     ]   [ r_y                     ]

with P = A'W^-2 A, of k x k blocks, and phi = P^-1 A'W^-2 sigma. The blocks are eliminated first, then the equalities by
M = E P^-1 E' and v = w - E phi, then lambda, whose pivot is

    |W^-1 (sigma - A phi)|^2 + v'M^-1 v.

As a sum of squares it stays exact where the weights W^-2 grow without bound: near an optimum, on the cones' boundary.

Source: Vandenberghe (2010), "The CVXOPT linear and quadratic cone program solvers", section 7.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced, repeat
from jaxgrasp.solvers.conic import cones
from jaxgrasp.solvers.conic.cones import Scaling
from jaxgrasp.solvers.conic.margin import ConicMargin, Parts, inner
from jaxgrasp.solvers.small_matrices import (
    SmallFactor,
    inverse_cholesky,
    matvec,
    matvec_transposed,
    small_cholesky,
    solve_lower,
    solve_small,
    sum_over_blocks,
)

# Every solution is refined iteratively this often.
_REFINEMENTS = 1


class Factors(NamedTuple):
    """The reduced Newton system, in the letters of the module's docstring."""

    blocks: SmallFactor  # Cholesky factors of the k x k blocks of P
    phi: jax.Array  # (k, n, *lanes)
    root: jax.Array  # (eq, eq, *lanes), inverse Cholesky factor of M
    v: jax.Array  # (eq, *lanes)
    pivot: jax.Array  # (*lanes), of lambda


def factor(problem: ConicMargin, scalings: tuple[Scaling, ...]) -> Factors:
    """Factor the Newton system: eliminate blocks, then the equalities, then lambda."""

    # Blocks: P = A'W^-2 A and phi = P^-1 A'W^-2 sigma.
    @fenced
    def blocks(scalings: tuple[Scaling, ...]) -> tuple:
        grams = [part.gram(w) for part, w in zip(problem.rows, scalings, strict=True)]
        lower = small_cholesky([fold(jnp.add, list(entries)) for entries in zip(*grams, strict=True)])
        sigma = tuple(part.sigma for part in problem.rows)
        weighed = tuple(cones.weigh(w, v) for w, v in zip(scalings, sigma, strict=True))
        return lower, solve_small(lower, problem.adjoint(weighed)[0])

    lower, phi = blocks(scalings)

    # Equalities: M = E P^-1 E' and v = w - E phi.
    @fenced
    def equalities(lower: SmallFactor, phi: jax.Array) -> tuple:
        reduced = solve_lower(lower, jnp.moveaxis(problem.columns, 1, 0))
        matrix = jnp.stack(
            [sum_over_blocks(jnp.swapaxes(reduced * reduced[:, r][:, None], 0, 1)) for r in range(len(problem.rhs))]
        )
        eye = jnp.eye(len(problem.rhs), dtype=phi.dtype).reshape(*matrix.shape[:2], *[1] * (problem.rhs.ndim - 1))
        # |W^-1 (sigma - A phi)|^2; as the difference of squares that it is, it would cancel.
        remainder = [part.sigma - part.apply(phi) for part in problem.rows]
        square = inner(*[[cones.shrink(w, v) for w, v in zip(scalings, remainder, strict=True)]] * 2)
        return matrix + eye * problem.dropped, problem.border - sum_over_blocks(problem.columns * phi), square

    matrix, v, square = equalities(lower, phi)
    root = inverse_cholesky(matrix)

    # Lambda: its pivot, the square plus v'M^-1 v.
    root_v = fenced(matvec)(root, v)
    pivot = square + fold(jnp.add, root_v * root_v)
    return Factors(lower, phi, root, v, pivot)


def newton(
    problem: ConicMargin,
    scalings: tuple[Scaling, ...],
    factors: Factors,
    rhs_x: jax.Array,
    rhs_lam: jax.Array,
    rhs_y: jax.Array,
    sides: Parts,
) -> tuple:
    """Solve A'z + E'y = rhs_x, sigma'z + w'y = rhs_lam, E x + w lambda = rhs_y, z = W^-2 (A x + sigma lambda + sides).

    Returns:
        x, lambda, y, z and the rows A x + sigma lambda + sides.
    """

    # Take the sides to the right: rhs - (A, sigma)'W^-2 sides.
    @fenced
    def without_sides(rhs_x: jax.Array, rhs_lam: jax.Array, sides: Parts) -> tuple:
        pulled, along = problem.adjoint(tuple(cones.weigh(w, u) for w, u in zip(scalings, sides, strict=True)))
        return rhs_x - pulled, rhs_lam - along

    # Substitute: P x + P phi lambda + E'y = rhs_x, then M y - v lambda = E P^-1 rhs_x - rhs_y, then lambda alone.
    @fenced
    def substitute(right: jax.Array, right_lam: jax.Array, rhs_y: jax.Array) -> tuple:
        first = solve_small(factors.blocks, right)
        root_y = matvec(factors.root, sum_over_blocks(problem.columns * first) - rhs_y)
        root_v = matvec(factors.root, factors.v)
        lam = right_lam - fold(jnp.add, fold(jnp.add, factors.phi * right)) - fold(jnp.add, root_v * root_y)
        lam = lam / jnp.maximum(factors.pivot, jnp.finfo(lam.dtype).tiny)
        y = matvec_transposed(factors.root, root_y + root_v * lam)
        x = first - factors.phi * lam - solve_small(factors.blocks, problem.pull_back(y))
        return x, lam, y

    @fenced
    def rows(x: jax.Array, lam: jax.Array, sides: Parts) -> tuple:
        lhs = tuple(a + u for a, u in zip(problem.apply(x, lam), sides, strict=True))
        return lhs, tuple(cones.weigh(w, v) for w, v in zip(scalings, lhs, strict=True))

    # Refine: solve again for what the solution leaves of the right-hand sides.
    @fenced
    def remainder(x: jax.Array, lam: jax.Array, y: jax.Array, z: Parts) -> tuple:
        pulled, along = problem.adjoint(z)
        remaining_lam = rhs_lam - along - fold(jnp.add, problem.border * y)
        return rhs_x - pulled - problem.pull_back(y), remaining_lam, rhs_y - problem.equality(x, lam)

    def improve(_: jax.Array, carry: tuple) -> tuple:
        (x, lam, y), right, lhs, z, sides = carry
        more = substitute(*right)
        more_lhs, more_z = rows(more[0], more[1], sides)
        x, lam, y, lhs, z = jax.tree.map(jnp.add, (x, lam, y, lhs, z), (*more, more_lhs, more_z))
        return (x, lam, y), remainder(x, lam, y, z), lhs, z, jax.tree.map(jnp.zeros_like, sides)

    nothing = jnp.zeros_like(rhs_x), jnp.zeros_like(rhs_lam), jnp.zeros_like(rhs_y)
    none = jax.tree.map(jnp.zeros_like, sides)
    start = nothing, (*without_sides(rhs_x, rhs_lam, sides), rhs_y), none, none, sides
    (x, lam, y), _, lhs, z, _ = repeat(1 + _REFINEMENTS, improve, start)
    return x, lam, y, z, lhs
