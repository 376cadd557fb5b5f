"""What the solver's best points are worth in the original equality rows, before these were made orthonormal.

The solver works with E = T N, orthonormal combinations of the rows N of G (and of J'f - B u). In floating point E is
off T N by about eps over what was left of the shortest row, which the solver cannot see. So in the end points are moved
onto N x = b itself, and with w = T'y the upper bound is computed anew,

    lambda* <= [h'z + b'w + radius |A'z + N'w|_1 + e] / sigma'z,

with what rounding can have done to it: e is eps times the same sums over absolute values, twice what every term may
have lost; signs being random, longer sums lose no more. sigma is off by about eps over what was left of the shortest
row of G, as the pseudo-inverse is, and lambda* with it.

In float64 E is exact to 1e-7 where the largest forces of a grasp spread over less than nine decades, and carrying N
along would cost a tenth of a margin: points and bounds stay as they are.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import fenced
from jaxgrasp.robustness.tightening.program import ScaledProgram
from jaxgrasp.solvers.block.kkt import BlockProblem, Record, Rows, adjoint_rows, total

# The largest share of the larger of |b| and sum |f_i| that G f may miss b by in float32.
_EXACT = 1e-5


class Forces(NamedTuple):
    """Unknowns that meet the original equality rows.

    x: the point.
    exact: bool (*lanes), G f misses b by no more than rounding, in the rows that were dropped, too.
    """

    x: Rows
    exact: jax.Array


def balance(program: ScaledProgram, problem: BlockProblem, x: Rows) -> Forces:
    """Move a point onto N x = b, to the nearest one."""
    original, basis = program.original, program.basis
    if original.wrench.dtype == jnp.float64:
        return Forces(x, jnp.ones(problem.lanes, bool))

    @fenced
    def lacking(x: Rows) -> tuple[jax.Array, jax.Array]:
        gap = basis.coordinates(original.wrench - original.equality(x))
        return gap * basis.kept, fold(jnp.maximum, jnp.abs(gap[:6] * (1 - basis.kept[:6])))

    @fenced
    def move(x: Rows, gap: jax.Array) -> Rows:
        return tuple(x_g + c for x_g, c in zip(x, problem.restore(gap), strict=True))

    gap, missed = lacking(x)
    x = move(x, gap)
    load = fold(jnp.maximum, jnp.abs(original.wrench))
    applied = fold(jnp.add, fold(jnp.add, jnp.abs(program.forces(x[0])))) / program.mean
    return Forces(x, missed <= _EXACT * jnp.maximum(load, applied / 2))


def certify(program: ScaledProgram, problem: BlockProblem, record: Record) -> jax.Array:
    """Find the upper bound that the record's multipliers prove, rounding included, (*lanes)."""
    if record.upper.dtype == jnp.float64:
        return record.upper
    original, eps = program.original, jnp.finfo(record.upper.dtype).eps
    w = program.row_multipliers(record.y)

    @fenced
    def sums(z: Rows, w: jax.Array) -> tuple:
        value, pull, lost, sizes, felt = [fold(jnp.add, original.wrench * w)], [], [], [], []
        sizes.append(fold(jnp.add, jnp.abs(original.wrench * w)))
        for group, z_g, column in zip(problem.groups, z, original.columns, strict=True):
            products = column * w[:, None, None]
            value.append(total(group.h * z_g))
            sizes.append(total(jnp.abs(group.h * z_g)))
            pull.append(total(group.sigma * z_g))
            lost.append(total(jnp.abs(adjoint_rows(group, z_g) + fold(jnp.add, products))))
            # No entry of A is larger than 1.
            felt.append(total(fold(jnp.add, jnp.abs(products)) + fold(jnp.add, z_g)))
        return tuple(fold(jnp.add, parts) for parts in (value, pull, lost, sizes, felt))

    value, pull, lost, sizes, felt = sums(record.z, w)
    radius = 1 + problem.radius * jnp.where(jnp.isinf(record.lower), 0, jnp.maximum(0, -record.lower))
    upper = value + radius * (lost + eps * felt) + eps * sizes
    upper = jnp.where(pull > 0, upper / jnp.where(pull > 0, pull, 1), jnp.inf)
    return upper + 2 * eps / program.least_ratio * jnp.abs(upper)
