"""Cholesky factors of P, the blocks' part of the Newton system of `kkt`: of every block, or of all of them at once."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.lanes.fence import each, fenced
from jaxgrasp.solvers.small_matrices import (
    block_diagonal,
    flatten,
    matvec,
    matvec_transposed,
    orthonormalise,
    substitute_down,
    substitute_up,
    unflatten,
)


class BlockFactor(NamedTuple):
    """The Cholesky factor L of P, and solutions with it; lists run over the k unknowns of a block."""

    below: list[jax.Array]  # L10, L20, L21 .., each (n, *lanes)
    inverse: list[jax.Array]  # 1 / diag(L), each (n, *lanes)
    columns: list[jax.Array]  # L^-1 E', each (eq, n, *lanes)
    theta: list[jax.Array]  # L^-1 p, each (n, *lanes)
    kappa: jax.Array | None  # (n, *lanes), this block's part of kappa


class CoupledFactor(NamedTuple):
    """The inverse of the Cholesky factor of P where blocks are tied together, and solutions with it."""

    inverse: jax.Array  # L^-1, (k n, k n, *lanes)
    columns: list[jax.Array]  # L^-1 E' alone, (eq, k n, *lanes)
    theta: list[jax.Array]  # empty: lambda is held
    kappa: None


Factor = BlockFactor | CoupledFactor


def solve_lower(factor: Factor, rhs: jax.Array) -> list[jax.Array]:
    """Compute L^-1 rhs for rhs (k, n, *lanes): a list over k, or one entry where blocks are tied together."""
    if isinstance(factor, CoupledFactor):
        return [matvec(factor.inverse, flatten(rhs))]
    return substitute_down(factor.below, factor.inverse, list(rhs))


def solve_upper(factor: Factor, rhs: list[jax.Array], k: int) -> jax.Array:
    """Compute L^-T rhs, (k, n, *lanes), of what `solve_lower` returns."""
    if isinstance(factor, CoupledFactor):
        return unflatten(matvec_transposed(factor.inverse, rhs[0]), k)
    return jnp.stack(substitute_up(factor.below, factor.inverse, rhs))


def couple(apart: BlockFactor, root: jax.Array, columns: jax.Array) -> CoupledFactor:
    """Make the columns of the blocks' L', and of the root of an H below them that ties them together, orthogonal.

    Args:
        apart: the factors of the blocks' A'W A.
        root: of H, (k n, k n, *lanes).
        columns: E, (eq, k, n, *lanes).
    """

    @fenced
    def stack(below: list[jax.Array], inverse: list[jax.Array], root: jax.Array) -> jax.Array:
        k, zero = len(inverse), jnp.zeros_like(inverse[0])
        row = lambda a: [1 / inverse[a], *[below[b * (b - 1) // 2 + a] for b in range(a + 1, k)]]
        upper = jnp.stack([jnp.stack([zero] * a + row(a)) for a in range(k)])
        return jnp.concatenate([block_diagonal(upper), root])

    turned = orthonormalise(stack(apart.below, apart.inverse, root))

    @fenced
    def reduce(turned: jax.Array, columns: jax.Array) -> jax.Array:
        return each(lambda column: matvec_transposed(turned, column), jax.vmap(flatten)(columns))

    return CoupledFactor(jnp.swapaxes(turned, 0, 1), [reduce(turned, columns)], [], None)
