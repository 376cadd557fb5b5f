"""Derivatives of quadratic programs at their solutions, by the implicit function theorem.

The solution of min 1/2 x'Px + q'x, Ax = b, Gx + s = h, s >= 0 satisfies

    P x + q + A'y + G'z = 0,    A x = b,    G x + s = h,    s_i z_i = kappa_i,

with the small kappa_i at which the interior-point loop ended. Differentiating with kappa held, and putting
ds = -(s/z) dz from the last equation into the third,

    [ P  A'   G'  ] [dx]   [ -(dP x + dq + dA'y + dG'z) ]
    [ A  0    0   ] [dy] = [  db - dA x                 ]
    [ G  0  -S/Z  ] [dz]   [  dh - dG x                 ].

The matrix is symmetric, so one solve serves forward and reverse mode; it is solved by the factors of the loop itself,
regularised and refined (`HomogeneousEmbedding`), never by differentiating the loop. Where kappa -> 0 the weights s/z go
to 0 for active rows and to infinity for the others, which is the derivative of the equalities that the active rows are.

The optimal value needs no solve (envelope theorem): with x, y, z held,

    d value = 1/2 x'dP x + dq'x + y'(dA x - db) + z'(dG x - dh).

Sources: Amos and Kolter (2017), "OptNet"; Agrawal et al. (2019), "Differentiating through a cone program".
"""

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp.compiling import own_settings
from jaxgrasp.lanes.independent import one_lane
from jaxgrasp.solvers.dense.embedding import CONSTANTS, HomogeneousEmbedding, QuadraticProgram
from jaxgrasp.solvers.interior_point import Iterate

T = TypeVar("T")

# s z is raised to this value: rows that are only just active, with s and z both zero, keep a finite weight.
_KAPPA = {"float32": 1e-8, "float64": 1e-14}


@jax.custom_jvp
def solution_of(program: QuadraticProgram, point: Iterate, solved: jax.Array) -> Iterate:
    """Return the point as a function of the program that it solves.

    Args:
        program: one program, equilibrated: entries of order 1.
        point: its solution x, y, s, z, held constant: derivatives come from the program alone.
        solved: bool; derivatives are zero where it is False.

    Returns:
        The point.
    """
    return point


@solution_of.defjvp
@own_settings()
def _solution_jvp(primals: tuple, tangents: tuple) -> tuple[Iterate, Iterate]:
    """Solve the linear system of this module's docstring."""
    program, _, solved = primals
    # The point is again a function of the program, for derivatives of the derivatives.
    point = solution_of(*primals)
    P, _, A, _, G, _ = program = _where_solved(solved, program, [0.0] * 6)
    dP, dq, dA, db, dG, dh = tangents[0]
    x, y, s, z = safe = _where_solved(solved, point, [0.0, 0.0, 1.0, 1.0])
    ratio = _ratio(safe)

    # Factor the matrix as the loop does, for weights z/s.
    kkt = HomogeneousEmbedding(lax.stop_gradient(program), CONSTANTS[x.dtype.name])
    factor = lambda _, program, weights: HomogeneousEmbedding(program, kkt.constants).reduce(weights)
    factors = one_lane(factor, solved, kkt.program, lax.stop_gradient(1 / ratio))
    parts = lambda v: jnp.split(v, [x.size, x.size + y.size])

    # Solve; `custom_linear_solve` differentiates through the matrix, not through its factors.
    def matrix(v: jax.Array) -> jax.Array:
        dx, dy, dz = parts(v)
        return jnp.concatenate([P @ dx + A.T @ dy + G.T @ dz, A @ dx, G @ dx - ratio * dz])

    # One vector: JAX cannot transpose a solve with a part of the right-hand side constant.
    right = jnp.concatenate([-(dP @ x + dq + dA.T @ y + dG.T @ z), db - dA @ x, dh - dG @ x])
    solve = lambda _, right: jnp.concatenate(kkt.newton(factors, tuple(parts(right))))
    dx, dy, dz = parts(lax.custom_linear_solve(matrix, right, solve, symmetric=True))
    return point, _where_solved(solved, Iterate(dx, dy, -ratio * dz, dz), [0.0] * 4)


@jax.custom_jvp
def value_at(program: QuadraticProgram, point: Iterate, value: jax.Array, solved: jax.Array) -> jax.Array:
    """Return the optimal value as a function of the program with the solution `point` (from `solution_of`)."""
    return value


@value_at.defjvp
@own_settings()
def _value_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Differentiate the value by the envelope theorem."""
    _, point, value, solved = primals
    dP, dq, dA, db, dG, dh = tangents[0]
    x, y, _, z = _where_solved(solved, point, [0.0] * 4)
    change = x @ (dP @ x) / 2 + dq @ x + y @ (dA @ x - db) + z @ (dG @ x - dh)
    return value_at(*primals), jnp.where(solved, change, 0)


def _ratio(point: Iterate) -> jax.Array:
    """Compute s/z, with the smaller of the two raised until s z is at least kappa."""
    kappa = _KAPPA[point.s.dtype.name]
    tiny = jnp.sqrt(kappa)
    s, z = jnp.maximum(point.s, 0), jnp.maximum(point.z, 0)
    larger = jnp.maximum(jnp.maximum(s, z), tiny)
    return jnp.maximum(s, kappa / larger) / jnp.maximum(z, kappa / larger)


def _where_solved(solved: jax.Array, tree: T, harmless: Sequence[float]) -> T:
    """Return the tree where the lane is solved, else numbers that make no NaN, one for every leaf."""
    leaves, structure = jax.tree.flatten(tree)
    chosen = [jnp.where(solved, v, jnp.asarray(other, v.dtype)) for v, other in zip(leaves, harmless, strict=True)]
    return jax.tree.unflatten(structure, chosen)
