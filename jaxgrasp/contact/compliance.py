"""Compliance Q (14) and the weighted pseudo-inverse of the grasp map (15)."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgrasp import linalg
from jaxgrasp.arrays import as_float, fold
from jaxgrasp.contact.row_space import Basis, dot, row_basis
from jaxgrasp.lanes.fence import each, fenced
from jaxgrasp.records import record


@record
class Compliance:
    """One compliance Q_j for each disturbance vertex; a single Q for all is given as a plain array instead."""

    per_vertex: Float[Array, "..."]

    @classmethod
    def per_direction(cls, matrices: ArrayLike) -> "Compliance":
        """Compliances, one for each disturbance vertex.

        They go with `DisturbanceSet.vertices` alone, in the order of its wrenches: a support function needs one
        pseudo-inverse.

        Args:
            matrices: (*batch, n_d, n_c, 3, 3), blocks by contact, or (*batch, n_d, 3 n_c, 3 n_c), full; contact
                frames, m/N.

        Raises:
            ValueError: fewer than three axes.
        """
        return cls(per_vertex=as_float("compliance", matrices, ("n_d", "3 n_c", "3 n_c")))


def inverse_root(compliance: jax.Array | None, contacts: int) -> tuple[jax.Array | None, jax.Array]:
    """M with M M' = Q^-1, lanes trailing, and whether Q is symmetric positive definite.

    Args:
        compliance: None for Q = I; blocks (n, 3, 3, *lanes) or full (3 n, 3 n, *lanes).
        contacts: n.

    Returns:
        blocks (n, 3, 3, *lanes) or full (3 n, 3 n, *lanes), the identity where Q is not sound, None for Q = I; and
        bool (*lanes).
    """
    if compliance is None:
        return None, jnp.array(True)
    full = compliance.shape[:2] == (3 * contacts, 3 * contacts)
    axes = (0, 1) if full else (1, 2)
    matrices = jnp.moveaxis(compliance, axes, (-2, -1))
    skew = jnp.abs(matrices - jnp.swapaxes(matrices, -1, -2)).max((-2, -1))
    symmetric = skew <= 1e-5 * jnp.abs(matrices).max((-2, -1))
    half, positive = _inverse_root(matrices)
    sound = symmetric & positive
    half = jnp.where(sound[..., None, None], half, jnp.eye(half.shape[-1], dtype=half.dtype))
    return jnp.moveaxis(half, (-2, -1), axes), sound if full else sound.all(0)


@jax.custom_jvp
def _inverse_root(matrices: jax.Array) -> tuple[jax.Array, jax.Array]:
    """M with M M' = Q^-1 for Q (..., k, k), and whether Q is positive definite; the identity where it is not."""
    half = jnp.swapaxes(linalg.inverse_root(matrices), -1, -2)
    sound = jnp.isfinite(half).all((-2, -1))
    return jnp.where(sound[..., None, None], half, jnp.eye(half.shape[-1], dtype=half.dtype)), sound


@_inverse_root.defjvp
def _inverse_root_jvp(primals: tuple, tangents: tuple) -> tuple:
    """DM = -1/2 M M' dQ M: then d(M M') = -Q^-1 dQ Q^-1, and only M M' matters."""
    (change,) = tangents
    half, sound = _inverse_root(*primals)
    change = jnp.where(sound[..., None, None], change + jnp.swapaxes(change, -1, -2), 0)
    moved = -0.25 * half @ (jnp.swapaxes(half, -1, -2) @ change @ half)
    return (half, sound), (moved, np.zeros(sound.shape, jax.dtypes.float0))


@jax.custom_jvp
def _inverse(rows: jax.Array) -> tuple[jax.Array, Basis]:
    """N^+ (3, 6, n, *lanes) of N (6, 3, n, *lanes), and the basis B = T N of its rows."""
    basis = row_basis(rows)

    @fenced
    def assemble(rows: jax.Array, operations: jax.Array) -> jax.Array:
        # On dropped rows the basis is zero, so what T holds there does not matter.
        column = lambda t: fold(jnp.add, [r * t_r for r, t_r in zip(rows, t, strict=True)])
        return jnp.moveaxis(each(column, jnp.moveaxis(operations, 1, 0)), 0, 1)

    return assemble(basis.rows, basis.operations), basis


@_inverse.defjvp
def _inverse_jvp(primals: tuple, tangents: tuple) -> tuple:
    """While the rank stays: dN^+ = V - N^+ (N V + dN N^+) with V = dN' K and K = N^+' N^+ = (N N')^+."""
    (rows,), (change,) = primals, tangents
    inverse, basis = _inverse(rows)

    @fenced
    def turn(rows: jax.Array, change: jax.Array, inverse: jax.Array) -> tuple[jax.Array, jax.Array]:
        columns = jnp.swapaxes(inverse, 0, 1)
        gram = each(lambda column: dot(columns, column), columns)
        turned = each(lambda k: fold(jnp.add, [c * k_r for c, k_r in zip(change, k, strict=True)]), gram)
        both = each(lambda pair: dot(rows, pair[0]) + dot(change, pair[1]), (turned, columns))
        return turned, both

    @fenced
    def assemble(inverse: jax.Array, turned: jax.Array, both: jax.Array) -> jax.Array:
        columns = jnp.swapaxes(inverse, 0, 1)
        column = lambda v: v[0] - fold(jnp.add, [c * b for c, b in zip(columns, v[1], strict=True)])
        return jnp.swapaxes(each(column, (turned, both)), 0, 1)

    still = jax.tree.map(jnp.zeros_like, basis)
    return (inverse, basis), (assemble(inverse, *turn(rows, change, inverse)), still)


def pseudo_inverse(columns: jax.Array, half: jax.Array | None) -> tuple[jax.Array, Basis]:
    """G* = Q^-1 G' (G Q^-1 G')^+ (15), on the range of G; lanes trail.

    Args:
        columns: (6, 3, n, *lanes), blocks of G, zero where absent.
        half: from `inverse_root`.

    Returns:
        (3, 6, n, *lanes), blocks of G*, and the basis of the rows of G.
    """
    inverse, basis = _inverse(_times_half(columns, half))
    if half is None:
        return inverse, basis
    return jnp.swapaxes(_half_times(jnp.swapaxes(inverse, 0, 1), half), 0, 1), basis


def pseudo_inverse_adjoint(
    columns: jax.Array, half: jax.Array | None, pulled: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """The transpose of the derivative of G*, while the rank stays.

    With G* = M N^+, N = G M, and the cotangent P of N^+: that of N is K (P' - X'N) - X N^+' with X = N^+'P and
    K = N^+'N^+.

    Args:
        columns: (6, 3, n, *lanes).
        half: M, see `inverse_root`.
        pulled: (6, 3, n, *lanes), cotangents of the blocks of G*.

    Returns:
        Cotangents of columns and of M.
    """
    rows = columns if half is None else _times_half(columns, half)
    inverse = jnp.swapaxes(_inverse(rows)[0], 0, 1)
    own = pulled if half is None else _half_times(pulled, _swapped(half, columns.shape[2]))

    @fenced
    def products(inverse: jax.Array, own: jax.Array) -> tuple[jax.Array, jax.Array]:
        return each(lambda i: (dot(own, i), dot(inverse, i)), inverse)

    @fenced
    def combine(cross: jax.Array, gram: jax.Array, rows: jax.Array, inverse: jax.Array, own: jax.Array) -> jax.Array:
        left = jnp.swapaxes(cross, 0, 1)
        rest = own - each(lambda x: fold(jnp.add, [r * x_r for r, x_r in zip(rows, x, strict=True)]), left)
        pair = lambda k: fold(jnp.add, [v * k_r - i * x_r for v, i, k_r, x_r in zip(rest, inverse, *k, strict=True)])
        return each(pair, (gram, cross))

    back = combine(*products(inverse, own), rows, inverse, own)
    if half is None:
        return back, None
    pull = jax.vjp(lambda columns, half: (_times_half(columns, half), _half_times(inverse, half)), columns, half)[1]
    return pull((back, pulled))


def _swapped(half: jax.Array, contacts: int) -> jax.Array:
    """M'."""
    return jnp.swapaxes(half, 0, 1) if half.shape[:2] == (3 * contacts,) * 2 else jnp.swapaxes(half, 1, 2)


def _times_half(columns: jax.Array, half: jax.Array | None) -> jax.Array:
    """G M, (6, 3, n, *lanes)."""
    if half is None:
        return columns
    if half.shape[:2] != (3 * columns.shape[2],) * 2:
        return jnp.einsum("rcn...,nca...->ran...", columns, half)
    tall = jnp.einsum("rp...,pq...->rq...", _flatten(columns), half)
    return _unflatten(tall)


def _half_times(rows: jax.Array, half: jax.Array) -> jax.Array:
    """M q for every row q, (6, 3, n, *lanes)."""
    if half.shape[:2] != (3 * rows.shape[2],) * 2:
        return jnp.einsum("nac...,rcn...->ran...", half, rows)
    return _unflatten(jnp.einsum("pq...,rq...->rp...", half, _flatten(rows)))


def _flatten(blocks: jax.Array) -> jax.Array:
    """(6, 3, n, *lanes) -> (6, 3 n, *lanes), contact by contact."""
    swapped = jnp.swapaxes(blocks, 1, 2)
    return swapped.reshape(blocks.shape[0], -1, *blocks.shape[3:])


def _unflatten(rows: jax.Array) -> jax.Array:
    return jnp.swapaxes(rows.reshape(rows.shape[0], -1, 3, *rows.shape[2:]), 1, 2)
