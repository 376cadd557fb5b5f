"""S_1 and S_2 computed anew, and whether b and the disturbances lie in the range of G: the audit's own way to them.

Nothing here is shared with the solver's way but the support functions of the disturbance sets. The rows of G (moments
divided by the grasp's size) are made orthonormal by Gram-Schmidt with row pivoting, twice, and

    G* = M N^+,  N = G M = L B,  N^+ = B' L^-1,  Q^-1 = M M'.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp import linalg
from jaxgrasp.arrays import fold
from jaxgrasp.contact.row_space import RANK_TOLERANCE
from jaxgrasp.disturbance.sets import support
from jaxgrasp.disturbance.vertices import wrenches_of
from jaxgrasp.lanes.fence import fences
from jaxgrasp.robustness.auditing.parts import cross, once
from jaxgrasp.robustness.auditing.problem import Problem, facets

# Shares of the longest row between which a row may count as independent or not: there the solver's word is taken.
_DOUBTFUL = {"float64": (1e-13, 1e-6), "float32": (1e-7, 3e-3)}


class Rows(NamedTuple):
    """What the worst unit disturbance takes from every row; lanes lead.

    cone: (lanes, n, n_e), -S_1, N.
    bound: (lanes, n), S_2, N.
    effort: (lanes, 2, n_u), of u <= u_max and -u <= -u_min; None without actuators.
    """

    cone: jax.Array
    bound: jax.Array
    effort: jax.Array | None


class Range(NamedTuple):
    """Whether the claimed rank can be, and what lies outside the range of G; bool (lanes,)."""

    rank_stands: jax.Array
    wrench_outside: jax.Array
    disturbance_outside: jax.Array


class Echelon(NamedTuple):
    """N^+ of N (r, k, lanes), and what its rows do not reach.

    inverse: (k, r, lanes).
    null: (r, r, lanes), vectors that no row reaches, zero where there are fewer.
    rank_stands: bool (lanes,).
    """

    inverse: jax.Array
    null: jax.Array
    rank_stands: jax.Array


def own_rows(problem: Problem, cone_edges: int, rank: jax.Array) -> tuple[Rows, Range]:
    """S_1, S_2, and where b and the set lie, with the rank (lanes,) of G that the solver claims."""
    with fences(jax.default_backend() == "cpu"):
        return _own_rows(problem, cone_edges, rank)


def _own_rows(problem: Problem, cone_edges: int, rank: jax.Array) -> tuple[Rows, Range]:
    rows = once(_stacked_rows)(problem)
    # Where rows of the joints stand below those of G the solver does not tell their rank.
    told = rank if rows.shape[0] == 6 else None
    plain = echelon(rows, told)
    if problem.per_vertex is None:
        inverse = _weighted(rows, problem, problem.compliance, told, plain)
        found = once(lambda problem, inverse: _reached(problem, inverse, cone_edges))(problem, inverse)
    else:

        def answered(vertex: tuple) -> Rows:
            matrices, wrench = vertex
            inverse = _weighted(rows, problem, matrices, told, plain)
            return _reached(problem, inverse, cone_edges, wrench)

        vertices = (jnp.moveaxis(problem.per_vertex, 1, 0), wrenches_of(problem.terms))
        found = jax.tree.map(lambda x: jnp.maximum(x.max(0), 0), lax.map(answered, vertices))
    return found, once(_range)(problem, plain)


def own_inverse(problem: Problem) -> jax.Array:
    """G* of wrenches in N and N m, (3 n, 6, lanes); for one compliance, or none."""
    rows = _stacked_rows(problem)
    inverse = _weighted(rows, problem, problem.compliance, None, echelon(rows, None))
    return inverse[:, :6] * _units(problem.size)


def _stacked_rows(problem: Problem) -> jax.Array:
    """G, and N'J' where actuators do not reach every joint direction, moments by size: (6 + r, k n, lanes)."""
    frames = jnp.moveaxis(problem.frames, (2, 1, 3, 0), (0, 1, 2, 3))
    arms = jnp.moveaxis(problem.positions, (2, 1, 0), (0, 1, 2))[:, :, None]
    blocks = jnp.concatenate([frames, jnp.stack(cross(list(arms), list(frames))) / problem.size])
    if problem.arms is not None:
        torsion = frames[:, :, 2:] * (problem.arms.T / problem.size)[:, None]
        blocks = jnp.concatenate([blocks, jnp.concatenate([jnp.zeros_like(torsion), torsion])], 2)
    rows = jnp.where(jnp.moveaxis(problem.transmits, 0, -1), blocks, 0).reshape(6, -1, blocks.shape[-1])
    hand = problem.hand
    if hand is None or hand.unreached is None:
        return rows
    bare = jnp.einsum("lrv,liav->rial", *_alike(hand.unreached, hand.jacobian)) / problem.size
    return jnp.concatenate([rows, bare.reshape(bare.shape[0], -1, bare.shape[-1])])


def echelon(rows: jax.Array, rank: jax.Array | None) -> Echelon:
    """N^+ of rows (r, k, lanes) by Gram-Schmidt with row pivoting, twice.

    Args:
        rows: N.
        rank: (lanes,), how many rows to keep; None keeps what is longer than the solver's tolerance.
    """
    count, width, lanes = rows.shape
    dtype = rows.dtype
    longest = jnp.sqrt(fold(jnp.maximum, _products(rows, rows)))
    least, most = (share * longest for share in _DOUBTFUL[dtype.name])
    # Made of the rows, so that they vary, and are divided, over the same axes of a mesh.
    none = rows[:, :1] * 0
    left, stands = (none[:, 0] == 0) | True, (none[0, 0] == 0) | True
    # The rows and, beside them, the row operations that led to them; a row that is done is a unit vector, or zero.
    rows = jnp.concatenate([rows, none + jnp.eye(count, dtype=dtype)[:, :, None]], 1)

    @once
    def chosen(rows: jax.Array, left: jax.Array, squares: jax.Array) -> tuple:
        squares = jnp.where(left, squares, -1)
        longest = squares == fold(jnp.maximum, squares)
        earlier = [longest[0] & False]
        for row in longest[:-1]:
            earlier.append(earlier[-1] | row)
        pivot = longest & ~jnp.stack(earlier)
        return pivot, fold(jnp.add, jnp.where(pivot[:, None], rows, 0))

    @once
    def remainder(rows: jax.Array, row: jax.Array, shares: jax.Array) -> jax.Array:
        return row - fold(jnp.add, shares[:, None] * rows)

    @once
    def scaled(row: jax.Array, length: jax.Array, kept: jax.Array) -> jax.Array:
        inverse = jnp.where(kept, 1 / jnp.where(length > 0, length, 1), 0)
        return jnp.concatenate([row[:width] * inverse, row[width:] * jnp.where(kept, inverse, 1)])

    products = once(lambda rows, row: _products(rows[:, :width], row[..., :width, :]))

    def step(j: jax.Array, state: tuple) -> tuple:
        rows, left, done, stands = state
        pivot, row = chosen(rows, left, products(rows, rows))
        row = remainder(rows, row, jnp.where(left, 0, products(rows, row)))
        length = once(lambda row: jnp.sqrt(fold(jnp.add, row[:width] ** 2)))(row)
        kept = length > RANK_TOLERANCE[dtype.name] * longest if rank is None else j < rank
        stands &= jnp.where(kept, length > least, length <= most)
        unit = scaled(row, length, kept)
        left &= ~pivot
        shares = jnp.where(left, products(rows, unit), 0)
        rows = jnp.where(pivot[:, None], unit, rows - shares[:, None] * unit)
        # The order of the rows is of no account. XLA would write over what it reads, and that takes twice as long.
        rows, left, done = (x[::-1] for x in (rows, left, done | pivot & kept))
        return rows, left, done, stands

    rows, _, kept, stands = lax.fori_loop(0, count, step, (rows, left, ~left, stands))
    units, operations = rows[:, :width], rows[:, width:]
    inverse = once(lambda a, b: fold(jnp.add, a[:, :, None] * b[:, None]))(units, operations)
    return Echelon(inverse, jnp.where(kept[:, None], 0, operations), stands | (rank is None))


def _products(rows: jax.Array, row: jax.Array) -> jax.Array:
    """Inner products of rows (r, k, lanes) with one (k, lanes), or with as many; (r, lanes)."""
    return fold(jnp.add, jnp.moveaxis(rows * row, 1, 0))


def _weighted(
    rows: jax.Array, problem: Problem, compliance: jax.Array | None, rank: jax.Array | None, plain: Echelon
) -> jax.Array:
    """G* (3 n, r, lanes) for a compliance with lanes leading; None for Q = I."""
    if compliance is None:
        return plain.inverse
    n, size = problem.present.shape[-1], rows.shape[1]
    there = problem.transmits.reshape(-1, size)
    if compliance.shape[-2:] != (size, size):
        blocks = jnp.eye(n, dtype=rows.dtype)[:, None, :, None] * compliance[:, :, :, None, :]
        compliance = blocks.reshape(blocks.shape[0], size, size)
    eye = jnp.eye(size, dtype=rows.dtype)
    sane = jnp.where(there[:, :, None] & there[:, None, :], compliance, eye)
    # M = L^-T for Q = L L'.
    half = jnp.swapaxes(linalg.inverse_root(sane), 1, 2)
    inverse = echelon(jnp.einsum("rkl,lkm->rml", rows, half), rank).inverse
    return jnp.einsum("lkm,mrl->krl", half, inverse)


def _reached(problem: Problem, inverse: jax.Array, cone_edges: int, wrench: jax.Array | None = None) -> Rows:
    """What the set, or a single wrench (6, lanes), takes from every row, given G* (3 n, r, lanes)."""
    n, lanes = problem.present.shape[-1], inverse.shape[-1]
    units = _units(problem.size)
    # (6, n, lanes) each: the rows of G* for tangents and normal, and for moments.
    answers = inverse[:, :6].reshape(n, -1, 6, lanes)
    first, second, normal, *moment = jnp.moveaxis(answers, (1, 2), (0, 1)) * units[:, None]
    # The rows of C and, after them, of -E: XLA puts arrays together a number at a time.
    pattern = facets(problem, cone_edges)
    rows = np.concatenate([pattern, 0 - np.eye(pattern.shape[1])[2:3]])
    slip = jnp.where(jnp.arange(len(rows))[:, None, None] < len(pattern), problem.friction.T, 1)
    c, s, k, *pole = jnp.asarray(rows, inverse.dtype).T[:, :, None, None]
    taken = c * first[:, None] + s * second[:, None] + k * slip * normal[:, None]
    for p, m in zip(pole, moment, strict=True):
        taken = taken + p * m[:, None]
    parts = [-taken.reshape(6, -1, lanes)]
    if problem.hand is not None:
        hand = problem.hand
        torque = jnp.einsum("liav,iacl->lvc", hand.jacobian, answers)
        effort = jnp.einsum("luv,lvc->cul", *_alike(hand.inverse, torque)) * units[:, None]
        parts += [-effort, effort]
    directions = jnp.concatenate(parts, 1) if len(parts) > 1 else parts[0]
    if wrench is None:
        reach = support(problem.terms, directions)
    else:
        reach = (directions * wrench[:, None]).sum(0)
    reach, *efforts = jnp.split(reach, np.cumsum([part.shape[1] for part in parts])[:-1])
    reach = jnp.where(problem.present[:, :, None], jnp.moveaxis(reach.reshape(-1, n, lanes), (0, 2), (2, 0)), 0)
    return Rows(
        cone=reach[..., :-1],
        bound=reach[..., -1],
        effort=jnp.moveaxis(jnp.stack(efforts), -1, 0) if efforts else None,
    )


def _range(problem: Problem, plain: Echelon) -> Range:
    """Where b and the set lie, by the vectors that no row of G reaches."""
    units = _units(problem.size)
    tolerance = 10 * RANK_TOLERANCE[units.dtype.name]
    null = plain.null[:, :6]
    wrench = problem.wrench.T * units
    outside = jnp.abs((null * wrench).sum(1)).max(0) > tolerance * jnp.abs(wrench).max(0)
    sharp = tuple(replace(term, width=None) for term in problem.terms)
    directions = jnp.moveaxis(null, 1, 0) * units[:, None]
    reach = support(sharp, jnp.concatenate([directions, -directions], 1)).max(0)
    return Range(plain.rank_stands, outside, reach > tolerance * (problem.reach.T * units).max(0))


def _units(size: jax.Array) -> jax.Array:
    """(6, lanes), what turns wrenches in N and N m to newtons."""
    return jnp.stack([size / size] * 3 + [1 / size] * 3)


def _alike(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Both with as many lanes."""
    lanes = max(a.shape[0], b.shape[0])
    return jnp.broadcast_to(a, (lanes, *a.shape[1:])), jnp.broadcast_to(b, (lanes, *b.shape[1:]))
