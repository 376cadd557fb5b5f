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
    """One compliance Q_j for each disturbance vertex; a plain array stands for a single Q for all."""

    per_vertex: Float[Array, "..."]
    """The matrices Q_j, (*batch, n_d, n_c, 3, 3) or (*batch, n_d, 3 n_c, 3 n_c), contact frames, m/N."""

    @classmethod
    def per_direction(cls, matrices: ArrayLike) -> "Compliance":
        """Make one compliance for each disturbance vertex.

        They go with `DisturbanceSet.vertices` alone, in the order of its wrenches: a support function needs one
        pseudo-inverse.

        Args:
            matrices: (*batch, n_d, n_c, 3, 3), blocks by contact, or (*batch, n_d, 3 n_c, 3 n_c), full; contact
                frames, m/N.

        Raises:
            ValueError: fewer than three axes.
        """
        return cls(per_vertex=as_float("compliance", matrices, ("n_d", "3 n_c", "3 n_c")))


def is_full(matrices: jax.Array, contacts: int) -> bool:
    """Whether matrices of n contacts, lanes trailing, are full (k n, k n, *lanes), not blocks (n, k, k, *lanes)."""
    return matrices.shape[0] != contacts


def inverse_root(compliance: jax.Array | None, contacts: int) -> tuple[jax.Array | None, jax.Array]:
    """Compute M with M M' = Q^-1, lanes trailing, and whether Q is symmetric positive definite.

    Args:
        compliance: None for Q = I; blocks (n, k, k, *lanes) or full (k n, k n, *lanes), k = 3, or 4 for soft contacts.
        contacts: n.

    Returns:
        M, shaped like Q: the identity where Q is not usable, None for Q = I; and
        bool (*lanes), whether Q is usable.
    """
    if compliance is None:
        return None, jnp.array(True)
    full = is_full(compliance, contacts)
    axes = (0, 1) if full else (1, 2)
    matrices = jnp.moveaxis(compliance, axes, (-2, -1))
    skew = jnp.abs(matrices - jnp.swapaxes(matrices, -1, -2)).max((-2, -1))
    symmetric = skew <= 1e-5 * jnp.abs(matrices).max((-2, -1))
    root, positive = _inverse_root(matrices)
    usable = symmetric & positive
    root = jnp.where(usable[..., None, None], root, jnp.eye(root.shape[-1], dtype=root.dtype))
    return jnp.moveaxis(root, (-2, -1), axes), usable if full else usable.all(0)


@jax.custom_jvp
def _inverse_root(matrices: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute M with M M' = Q^-1 for Q (..., k, k), the identity where Q is not positive definite, and where it is."""
    root = jnp.swapaxes(linalg.inverse_root(matrices), -1, -2)
    usable = jnp.isfinite(root).all((-2, -1))
    return jnp.where(usable[..., None, None], root, jnp.eye(root.shape[-1], dtype=root.dtype)), usable


@_inverse_root.defjvp
def _inverse_root_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return dM = -1/2 M M' dQ M: then d(M M') = -Q^-1 dQ Q^-1, and only M M' matters."""
    (change,) = tangents
    root, usable = _inverse_root(*primals)
    change = jnp.where(usable[..., None, None], change + jnp.swapaxes(change, -1, -2), 0)
    moved = -0.25 * root @ (jnp.swapaxes(root, -1, -2) @ change @ root)
    return (root, usable), (moved, np.zeros(usable.shape, jax.dtypes.float0))


@jax.custom_jvp
def _inverse(rows: jax.Array) -> tuple[jax.Array, Basis]:
    """Compute N^+ (k, 6, n, *lanes) of N (6, k, n, *lanes), and the basis B = T N of its rows.

    B has orthonormal rows, so N^+ = B'T.
    """
    basis = row_basis(rows)

    @fenced
    def assemble(rows: jax.Array, operations: jax.Array) -> jax.Array:
        # On dropped rows the basis is zero, so what T holds there does not matter.
        column = lambda t: fold(jnp.add, [r * t_r for r, t_r in zip(rows, t, strict=True)])
        return jnp.moveaxis(each(column, jnp.moveaxis(operations, 1, 0)), 0, 1)

    return assemble(basis.rows, basis.operations), basis


@_inverse.defjvp
def _inverse_jvp(primals: tuple, tangents: tuple) -> tuple:
    """Return dN^+ = V - N^+ (N V + dN N^+) with V = dN' K and K = N^+' N^+ = (N N')^+, while the rank stays."""
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


def pseudo_inverse(columns: jax.Array, root: jax.Array | None) -> tuple[jax.Array, Basis]:
    """Compute G* = Q^-1 G' (G Q^-1 G')^+ (15), on the range of G; lanes trail.

    With M M' = Q^-1 and N = G M it is G* = M N^+.

    Args:
        columns: blocks of G, (6, k, n, *lanes), zero where a contact is absent.
        root: M from `inverse_root`.

    Returns:
        Blocks of G*, (k, 6, n, *lanes), and the basis of the rows of N.
    """
    inverse, basis = _inverse(_times_root(columns, root))
    if root is None:
        return inverse, basis
    return jnp.swapaxes(_root_times(jnp.swapaxes(inverse, 0, 1), root), 0, 1), basis


def pseudo_inverse_adjoint(
    columns: jax.Array, root: jax.Array | None, pulled: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """Apply the transpose of the derivative of G*, while the rank stays.

    With G* = M N^+, N = G M, and the cotangent P of N^+: that of N is K (P' - X'N) - X N^+' with X = N^+'P and
    K = N^+'N^+.

    Args:
        columns: blocks of G, (6, k, n, *lanes).
        root: M from `inverse_root`.
        pulled: cotangents of the blocks of G*, (6, k, n, *lanes).

    Returns:
        Cotangents of columns and of M (None for Q = I).
    """
    rows = columns if root is None else _times_root(columns, root)
    inverse = jnp.swapaxes(_inverse(rows)[0], 0, 1)
    # The cotangent P of N^+, as rows.
    cotangent = pulled if root is None else _root_times(pulled, _transposed(root, columns.shape[2]))

    # X = N^+'P and K.
    @fenced
    def products(inverse: jax.Array, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
        return each(lambda i: (dot(cotangent, i), dot(inverse, i)), inverse)

    # K (P' - X'N) - X N^+'.
    @fenced
    def combine(
        cross: jax.Array, gram: jax.Array, rows: jax.Array, inverse: jax.Array, cotangent: jax.Array
    ) -> jax.Array:
        crossed = jnp.swapaxes(cross, 0, 1)
        rest = cotangent - each(lambda x: fold(jnp.add, [r * x_r for r, x_r in zip(rows, x, strict=True)]), crossed)
        pair = lambda k: fold(jnp.add, [v * k_r - i * x_r for v, i, k_r, x_r in zip(rest, inverse, *k, strict=True)])
        return each(pair, (gram, cross))

    back = combine(*products(inverse, cotangent), rows, inverse, cotangent)
    if root is None:
        return back, None
    # G and M also enter by N = G M and by the last product, M N^+.
    pull = jax.vjp(lambda columns, root: (_times_root(columns, root), _root_times(inverse, root)), columns, root)[1]
    return pull((back, pulled))


def _transposed(root: jax.Array, contacts: int) -> jax.Array:
    """Transpose M, of blocks or full."""
    return jnp.swapaxes(root, 0, 1) if is_full(root, contacts) else jnp.swapaxes(root, 1, 2)


def _times_root(columns: jax.Array, root: jax.Array | None) -> jax.Array:
    """Compute G M, (6, k, n, *lanes)."""
    if root is None:
        return columns
    if not is_full(root, columns.shape[2]):
        return jnp.einsum("rcn...,nca...->ran...", columns, root)
    tall = jnp.einsum("rp...,pq...->rq...", _flatten(columns), root)
    return _unflatten(tall, columns)


def _root_times(rows: jax.Array, root: jax.Array) -> jax.Array:
    """Compute M q for every row q, (6, k, n, *lanes)."""
    if not is_full(root, rows.shape[2]):
        return jnp.einsum("nac...,rcn...->ran...", root, rows)
    return _unflatten(jnp.einsum("pq...,rq...->rp...", root, _flatten(rows)), rows)


def _flatten(blocks: jax.Array) -> jax.Array:
    """Reshape (6, k, n, *lanes) to (6, k n, *lanes), contact by contact."""
    swapped = jnp.swapaxes(blocks, 1, 2)
    return swapped.reshape(blocks.shape[0], -1, *blocks.shape[3:])


def _unflatten(rows: jax.Array, like: jax.Array) -> jax.Array:
    """Reshape (6, k n, *lanes) to blocks like (6, k, n, *lanes)."""
    return jnp.swapaxes(rows.reshape(rows.shape[0], -1, like.shape[1], *rows.shape[2:]), 1, 2)
