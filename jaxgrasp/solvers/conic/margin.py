"""max lambda over small blocks with cone rows in many copies.

With blocks x_i of k unknowns, a scalar lambda, and for every block the same rows in J copies,

    h - A x_i - sigma_ij lambda in K      for every block i and copy j = 1 .. J,
    sum_i E_i x_i + w lambda = b          (a few equality rows),

where K is a product of orthants and second-order cones. `embedding.solve` solves it. All copies of a block's rows have
the same x_i, so they only add up in its k x k matrix, and a step costs O(n (J + 1)).

Callers scale: |x| <= 1 at admissible points with lambda >= 0, rows of E orthonormal or zero, sigma or w about 1.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import fold, literal
from jaxgrasp.solvers.conic import cones
from jaxgrasp.solvers.conic.cones import Scaling
from jaxgrasp.solvers.small_matrices import matvec_transposed, spread_over, sum_over_blocks

Parts = tuple[jax.Array, ...]
# Axes up to this length are reduced term by term.
_LONGEST_FOLDED = 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ConeRows:
    """Rows of one kind of cone; only sigma differs between copies; lanes trail."""

    second_order: bool = field(metadata={"static": True})
    """Whether the rows of a block and copy are one second-order cone, or an orthant."""
    patterns: tuple[tuple[float, ...], ...] = field(metadata={"static": True})
    """The rows A, (d, k)."""
    h: tuple[float, ...] = field(metadata={"static": True})
    """The right-hand sides h, (d,)."""
    sigma: jax.Array
    """The column of lambda, (d, J, n, *lanes); zero where a block is absent."""
    stretch: jax.Array | None = None
    """Factors of the columns of A, (k, n, *lanes); None for 1."""
    reserve: jax.Array | None = None
    """What is taken from h, which all copies share: (d, 1, n, *lanes); None for nothing."""

    def apply(self, x: jax.Array) -> jax.Array:
        """Compute A x, which all copies share: (k, n, *lanes) -> (d, 1, n, *lanes)."""
        x = x if self.stretch is None else self.stretch * x
        return matvec_transposed(spread_over(self._matrix().T, x), x)[:, None]

    def adjoint(self, z: jax.Array) -> jax.Array:
        """Compute A'z, summed over copies: (d, J, n, *lanes) -> (k, n, *lanes)."""
        z = along(jnp.add, jnp.moveaxis(z, 1, 0))
        pulled = matvec_transposed(spread_over(self._matrix(), z), z)
        return pulled if self.stretch is None else self.stretch * pulled

    def sides(self) -> jax.Array:
        """Make h an array that broadcasts over the rows, (d, 1, 1, *1), or (d, 1, n, *lanes) less the reserve."""
        h = literal(np.array(self.h), self.sigma.dtype)
        h = h.reshape(-1, *[1] * (self.sigma.ndim - 1))
        return h if self.reserve is None else h - self.reserve

    def gram(self, w: Scaling) -> list[jax.Array]:
        """Compute the entries 00, 10, 11, 20, 21, 22, .. of A'W^-2 A summed over copies, (n, *lanes) each."""
        rows = np.array(self.patterns)
        pairs = [(a, b) for a in range(rows.shape[1]) for b in range(a + 1)]
        if w.size is None:
            weights = along(jnp.add, jnp.moveaxis(1 / (w.point * w.point), 1, 0))
            table = literal(np.stack([rows[:, a] * rows[:, b] for a, b in pairs], 1), weights.dtype)
            entries = list(matvec_transposed(spread_over(table, weights), weights))
        else:
            # W^-2 = (2 (J w)(J w)' - J) / size^2, so A'W^-2 A = (2 v v' - A'J A) / size^2 with v = A'J w.
            inverse = 1 / (w.size * w.size)
            turned = cones.reflect(w.point)
            v = matvec_transposed(spread_over(self._matrix(), turned), turned)
            signs = np.array([1.0] + [-1.0] * (rows.shape[0] - 1))
            bent = (rows * signs[:, None]).T @ rows
            total = along(jnp.add, inverse)
            entries = [along(jnp.add, 2 * inverse * v[a] * v[b]) - float(bent[a, b]) * total for a, b in pairs]
        if self.stretch is None:
            return entries
        return [e * self.stretch[a] * self.stretch[b] for e, (a, b) in zip(entries, pairs, strict=True)]

    def _matrix(self) -> jax.Array:
        return literal(np.array(self.patterns), self.sigma.dtype)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ConicMargin:
    """The program max lambda of this module's docstring; lanes trail."""

    rows: tuple[ConeRows, ...]
    columns: jax.Array
    """E, (eq, k, n, *lanes); zero where a row is dropped or a block absent."""
    border: jax.Array
    """The column w of lambda in the equality rows, (eq, *lanes)."""
    rhs: jax.Array
    """The right-hand sides b, (eq, *lanes)."""
    dropped: jax.Array
    """A mask of the equality rows, (eq, *lanes): 1 for rows that are zero, else 0."""

    def equality(self, x: jax.Array, lam: jax.Array) -> jax.Array:
        """Compute E x + w lambda, (eq, *lanes)."""
        return sum_over_blocks(self.columns * x) + self.border * lam

    def pull_back(self, y: jax.Array) -> jax.Array:
        """Compute E'y, (k, n, *lanes)."""
        return fold(jnp.add, self.columns * y[:, None, None])

    def apply(self, x: jax.Array, lam: jax.Array) -> Parts:
        """Compute A x + sigma lambda, (d, J, n, *lanes) a part."""
        return tuple(part.apply(x) + part.sigma * lam for part in self.rows)

    def adjoint(self, z: Parts) -> tuple[jax.Array, jax.Array]:
        """Compute A'z, (k, n, *lanes), and sigma'z, (*lanes)."""
        pulled = fold(jnp.add, [part.adjoint(z_p) for part, z_p in zip(self.rows, z, strict=True)])
        return pulled, inner([part.sigma for part in self.rows], z)

    def lagrangian(self, point: "ConicPoint") -> jax.Array:
        """Compute z'(A x + sigma lambda - h) + y'(E x + w lambda - b), (*lanes).

        Its derivative with respect to the data, negated, is that of the optimum (envelope theorem).
        """
        rows = [lhs - part.sides() for lhs, part in zip(self.apply(point.x, point.margin), self.rows, strict=True)]
        return inner(rows, point.z) + fold(jnp.add, point.y * (self.equality(point.x, point.margin) - self.rhs))


class ConicPoint(NamedTuple):
    """A point x (k, n, *lanes), lambda (*lanes), and multipliers y (eq, *lanes) and z, parts (d, J, n, *lanes)."""

    x: jax.Array
    margin: jax.Array
    y: jax.Array
    z: Parts


def inner(a: Parts | list[jax.Array], b: Parts | list[jax.Array]) -> jax.Array:
    """Compute the inner product of parts, (*lanes)."""
    return fold(jnp.add, [reduce(jnp.add, u * v) for u, v in zip(a, b, strict=True)])


def largest_entry(parts: Parts | list[jax.Array]) -> jax.Array:
    """Compute the largest entry of parts, (*lanes)."""
    return fold(jnp.maximum, [reduce(jnp.maximum, v) for v in parts])


def reduce(op: Any, v: jax.Array) -> jax.Array:
    """Reduce over rows, copies and blocks, (d, J, n, *lanes) -> (*lanes)."""
    for _ in range(3):
        v = along(op, v)
    return v


def along(op: Any, v: jax.Array) -> jax.Array:
    """Reduce the leading axis, by `fold` while it is short."""
    return fold(op, v) if v.shape[0] <= _LONGEST_FOLDED else op.reduce(v, axis=0)
