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
from jaxgrasp.lanes.fence import fenced, fences
from jaxgrasp.robustness.auditing.problem import Problem, facets

# Shares of the longest row between which a row may count as independent or not: there the solver's word is taken.
_DOUBTFUL = {"float64": (1e-13, 1e-6), "float32": (1e-7, 3e-3)}


class Rows(NamedTuple):
    """What the worst unit disturbance takes from every row; lanes lead.

    cone: (lanes, n, n_e), -S_1, N; 2 n_e of soft contacts.
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
    rows = fenced(_stacked_rows)(problem)
    # Where rows of the joints stand below those of G the solver does not tell their rank.
    told = rank if rows.shape[0] == 6 else None
    plain = echelon(rows, told)
    if problem.per_vertex is None:
        inverse = _weighted(rows, problem, problem.compliance, told, plain)
        found = fenced(lambda problem, inverse: _reached(problem, inverse, cone_edges))(problem, inverse)
    else:

        def answered(vertex: tuple) -> Rows:
            matrices, wrench = vertex
            inverse = _weighted(rows, problem, matrices, told, plain)
            return _reached(problem, inverse, cone_edges, wrench)

        vertices = (jnp.moveaxis(problem.per_vertex, 1, 0), wrenches_of(problem.terms))
        found = jax.tree.map(lambda x: jnp.maximum(x.max(0), 0), lax.map(answered, vertices))
    return found, fenced(_range)(problem, plain)


def own_inverse(problem: Problem) -> jax.Array:
    """G* of wrenches in N and N m, (k n, 6, lanes); for one compliance, or none."""
    rows = _stacked_rows(problem)
    inverse = _weighted(rows, problem, problem.compliance, None, echelon(rows, None))
    return inverse[:, :6] * _units(problem.size)


def _stacked_rows(problem: Problem) -> jax.Array:
    """G, and N'J' where actuators do not reach every joint direction, moments by size: (6 + r, k n, lanes)."""
    arms = jnp.broadcast_to(problem.positions[:, :, :, None], problem.frames.shape)
    blocks = jnp.concatenate([problem.frames, cross(arms, problem.frames, 2) / problem.size[:, None, None, None]], 2)
    if problem.arms is not None:
        torsion = problem.frames[..., 2] * (problem.arms / problem.size[:, None])[..., None]
        torsion = jnp.concatenate([jnp.zeros_like(torsion), torsion], -1)
        blocks = jnp.concatenate([blocks, torsion[..., None]], -1)
    rows = jnp.moveaxis(blocks, (2, 1, 3, 0), (0, 1, 2, 3)).reshape(6, -1, blocks.shape[0])
    hand = problem.hand
    if hand is None or hand.unreached is None:
        return rows
    bare = jnp.einsum("lrv,liav->rial", *_alike(hand.unreached, hand.jacobian)) / problem.size
    return jnp.concatenate([rows, bare.reshape(bare.shape[0], -1, bare.shape[-1])])


def cross(a: jax.Array, b: jax.Array, axis: int) -> jax.Array:
    """The cross product, spelt out: it then becomes part of what is around it."""
    a, b = jnp.moveaxis(a, axis, 0), jnp.moveaxis(b, axis, 0)
    product = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    return jnp.stack(product, axis)


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

    @fenced
    def chosen(rows: jax.Array, left: jax.Array, squares: jax.Array) -> tuple:
        pivot = jnp.argmax(jnp.where(left, squares, -1), 0) == jnp.arange(count)[:, None]
        return pivot, fold(jnp.add, jnp.where(pivot[:, None], rows, 0))

    @fenced
    def remainder(rows: jax.Array, row: jax.Array, shares: jax.Array) -> jax.Array:
        return row - fold(jnp.add, shares[:, None] * rows)

    @fenced
    def scaled(row: jax.Array, length: jax.Array, kept: jax.Array) -> jax.Array:
        inverse = jnp.where(kept, 1 / jnp.where(length > 0, length, 1), 0)
        return jnp.concatenate([row[:width] * inverse, row[width:] * jnp.where(kept, inverse, 1)])

    @fenced
    def without(rows: jax.Array, unit: jax.Array, shares: jax.Array, pivot: jax.Array) -> jax.Array:
        return jnp.where(pivot[:, None], unit, rows - shares[:, None] * unit)

    products = fenced(lambda rows, row: _products(rows[:, :width], row[..., :width, :]))

    def step(j: jax.Array, state: tuple) -> tuple:
        rows, left, done, stands = state
        pivot, row = chosen(rows, left, products(rows, rows))
        row = remainder(rows, row, jnp.where(left, 0, products(rows, row)))
        length = fenced(lambda row: jnp.sqrt(fold(jnp.add, row[:width] ** 2)))(row)
        kept = length > RANK_TOLERANCE[dtype.name] * longest if rank is None else j < rank
        stands &= jnp.where(kept, length > least, length <= most)
        unit = scaled(row, length, kept)
        left &= ~pivot
        rows = without(rows, unit, jnp.where(left, products(rows, unit), 0), pivot)
        return rows, left, done | pivot & kept, stands

    rows, _, kept, stands = lax.fori_loop(0, count, step, (rows, left, ~left, stands))
    units, operations = rows[:, :width], rows[:, width:]
    inverse = fenced(lambda a, b: fold(jnp.add, a[:, :, None] * b[:, None]))(units, operations)
    return Echelon(inverse, jnp.where(kept[:, None], 0, operations), stands | (rank is None))


def _products(rows: jax.Array, row: jax.Array) -> jax.Array:
    """Inner products of rows (r, k, lanes) with one (k, lanes), or with as many; (r, lanes)."""
    return fold(jnp.add, jnp.moveaxis(rows * row, 1, 0))


def _weighted(
    rows: jax.Array, problem: Problem, compliance: jax.Array | None, rank: jax.Array | None, plain: Echelon
) -> jax.Array:
    """G* (k n, r, lanes) for a compliance with lanes leading; None for Q = I."""
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
    """What the set, or a single wrench (6, lanes), takes from every row, given G* (k n, r, lanes)."""
    n, lanes = problem.present.shape[-1], inverse.shape[-1]
    units = _units(problem.size)
    # (6, n, lanes) each: the rows of G* for tangents and normal, and for moments.
    answers = inverse[:, :6].reshape(n, -1, 6, lanes)
    first, second, normal, *moment = jnp.moveaxis(answers, (1, 2), (0, 1)) * units[:, None]
    c, s, k, *pole = facets(problem, cone_edges).T[:, :, None, None]
    slip = jnp.moveaxis(problem.friction, 0, -1)
    cone = -(c * first[:, None] + s * second[:, None] + k * (slip * normal)[:, None])
    for p, m in zip(pole, moment, strict=True):
        cone = cone - p * m[:, None]
    parts = [cone.reshape(6, -1, lanes), normal]
    if problem.hand is not None:
        hand = problem.hand
        torque = jnp.einsum("liav,iacl->lvc", hand.jacobian, answers)
        effort = jnp.einsum("luv,lvc->cul", *_alike(hand.inverse, torque)) * units[:, None]
        parts += [-effort, effort]
    directions = jnp.concatenate(parts, 1)
    if wrench is None:
        reach = support(problem.terms, directions)
    else:
        reach = (directions * wrench[:, None]).sum(0)
    cone, bound, *efforts = jnp.split(reach, np.cumsum([part.shape[1] for part in parts])[:-1])
    return Rows(
        cone=jnp.where(problem.present[:, :, None], jnp.moveaxis(cone.reshape(-1, n, lanes), (0, 2), (2, 0)), 0),
        bound=jnp.where(problem.present, bound.T, 0),
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
