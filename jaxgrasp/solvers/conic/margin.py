"""max lambda over small blocks with cone rows in many copies.

With blocks x_i of three unknowns, a scalar lambda, and for every block the same rows in J copies,

    h - A x_i - sigma_ij lambda in K      for every block i and copy j = 1 .. J,
    sum_i E_i x_i + w lambda = b          (a few equality rows),

where K is a product of orthants and second-order cones. `embedding.solve` solves it. Copies only add up in the 3x3
matrices of the blocks, so a step costs O(n (J + 1)), whatever couples the copies.

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
_SPELT_OUT = 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class ConeRows:
    """Rows of one kind of cone, the same for every block and copy but for sigma; lanes trail."""

    second_order: bool = field(metadata={"static": True})
    patterns: tuple[tuple[float, ...], ...] = field(metadata={"static": True})
    """(d, 3), A."""
    h: tuple[float, ...] = field(metadata={"static": True})
    """(d,), right-hand sides."""
    sigma: jax.Array
    """(d, J, n, *lanes), zero where absent."""
    stretch: jax.Array | None = None
    """(3, n, *lanes), what the columns of A are multiplied by; None for 1."""

    def apply(self, x: jax.Array) -> jax.Array:
        """A x: (3, n, *lanes) -> (d, 1, n, *lanes), the same for all copies."""
        x = x if self.stretch is None else self.stretch * x
        return matvec_transposed(spread_over(self._matrix().T, x), x)[:, None]

    def adjoint(self, z: jax.Array) -> jax.Array:
        """A'z summed over copies: (d, J, n, *lanes) -> (3, n, *lanes)."""
        z = along(jnp.add, jnp.moveaxis(z, 1, 0))
        pulled = matvec_transposed(spread_over(self._matrix(), z), z)
        return pulled if self.stretch is None else self.stretch * pulled

    def sides(self) -> jax.Array:
        """h, (d, 1, 1, *1)."""
        h = literal(np.array(self.h), self.sigma.dtype)
        return h.reshape(-1, *[1] * (self.sigma.ndim - 1))

    def gram(self, w: Scaling) -> list[jax.Array]:
        """The entries 00, 10, 11, 20, 21, 22 of A'W^-2 A summed over copies, (n, *lanes) each."""
        pairs = [(a, b) for a in range(3) for b in range(a + 1)]
        rows = np.array(self.patterns)
        if w.size is None:
            weights = along(jnp.add, jnp.moveaxis(1 / (w.point * w.point), 1, 0))
            table = literal(np.stack([rows[:, a] * rows[:, b] for a, b in pairs], 1), weights.dtype)
            entries = list(matvec_transposed(spread_over(table, weights), weights))
        else:
            inverse = 1 / (w.size * w.size)
            turned = cones.reflected(w.point)
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
    """The program; lanes trail."""

    rows: tuple[ConeRows, ...]
    columns: jax.Array
    """(eq, 3, n, *lanes), E; zero where dropped or absent."""
    border: jax.Array
    """(eq, *lanes), w."""
    rhs: jax.Array
    """(eq, *lanes), b."""
    dropped: jax.Array
    """(eq, *lanes), 1 for equality rows that are zero."""

    def equality(self, x: jax.Array, lam: jax.Array) -> jax.Array:
        """E x + w lambda."""
        return sum_over_blocks(self.columns * x) + self.border * lam

    def pull_back(self, y: jax.Array) -> jax.Array:
        """E'y."""
        return fold(jnp.add, self.columns * y[:, None, None])

    def apply(self, x: jax.Array, lam: jax.Array) -> Parts:
        """A x + sigma lambda."""
        return tuple(part.apply(x) + part.sigma * lam for part in self.rows)

    def adjoint(self, z: Parts) -> tuple[jax.Array, jax.Array]:
        """A'z and sigma'z."""
        pulled = fold(jnp.add, [part.adjoint(z_p) for part, z_p in zip(self.rows, z, strict=True)])
        return pulled, inner([part.sigma for part in self.rows], z)

    def lagrangian(self, point: "ConicPoint") -> jax.Array:
        """What the rows and equalities lack, weighed by the multipliers, (*lanes).

        Its derivative with respect to the data, negated, is that of the optimum (envelope theorem).
        """
        lacking = [lhs - part.sides() for lhs, part in zip(self.apply(point.x, point.margin), self.rows, strict=True)]
        return inner(lacking, point.z) + fold(jnp.add, point.y * (self.equality(point.x, point.margin) - self.rhs))


class ConicPoint(NamedTuple):
    """x (3, n, *lanes), lambda (*lanes), and multipliers y (eq, *lanes) and z, parts (d, J, n, *lanes)."""

    x: jax.Array
    margin: jax.Array
    y: jax.Array
    z: Parts


def inner(a: Parts | list[jax.Array], b: Parts | list[jax.Array]) -> jax.Array:
    """Inner product of parts, (*lanes)."""
    return fold(jnp.add, [reduce(jnp.add, u * v) for u, v in zip(a, b, strict=True)])


def most(parts: Parts | list[jax.Array]) -> jax.Array:
    """Largest entry of parts, (*lanes)."""
    return fold(jnp.maximum, [reduce(jnp.maximum, v) for v in parts])


def reduce(op: Any, v: jax.Array) -> jax.Array:
    """Over rows, copies and blocks, (d, J, n, *lanes) -> (*lanes)."""
    for _ in range(3):
        v = along(op, v)
    return v


def along(op: Any, v: jax.Array) -> jax.Array:
    """Reduce the leading axis; spelt out while it is short, see `fold`."""
    return fold(op, v) if v.shape[0] <= _SPELT_OUT else op.reduce(v, axis=0)
