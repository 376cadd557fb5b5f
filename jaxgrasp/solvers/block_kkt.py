"""Programs whose unknowns come in small blocks with constant row patterns, tied by a few equalities and one border column.

With blocks x_i (three forces of a contact, or one bounded actuator effort), a scalar lambda and rows

    A_k x_i + sigma_ik lambda <= h_ik      for every block i and row pattern k,
    sum_i E_i x_i = b                      (a static number of equality rows),

`MarginProblem` maximises lambda, `EffortProblem` minimises 1/2 sum x_i' H_i x_i with lambda held. Patterns A_k are the same constants
for every block of a group, so A is never stored. The Newton system is reduced block by block (Cholesky of k x k), then
lambda, then the equality rows: the cost is linear in the number of blocks.

Both certify their answers at every step: for any x with E x = b, lambda_lo = min (h - A x) / sigma is attained; for any z >= 0
scaled to sum sigma z = 1, lambda* <= h'z + b'y + radius |A'z + E'y|_1, where radius bounds |x|_inf at the optimum.

Callers scale: |x| <= 1 about, sigma <= 1, the rows of E orthonormal or zero.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.fence import fenced
from jaxgrasp.solvers.interior_point import Iterate, Residuals, fold

Rows = tuple[jax.Array, ...]


class Blocks(NamedTuple):
    """A group of n blocks of k unknowns with the same m row patterns; lanes trail.

    patterns: (m, k) constants, the rows A_k.
    columns: (eq, k, n, *lanes), E_i; zero where a block is absent.
    sigma: (m, n, *lanes), the border column, >= 0; zero where absent.
    h: (m, n, *lanes), right-hand sides; one where absent.
    present: (n, *lanes), 1 or 0.
    hessian: (k, k, n, *lanes) for `EffortProblem`.
    """

    patterns: np.ndarray
    columns: jax.Array
    sigma: jax.Array
    h: jax.Array
    present: jax.Array
    hessian: jax.Array | None = None


class Record(NamedTuple):
    """Best bounds so far and the points that attain them: x for `lower`/`upper` as the problem says, (y, z) for the other."""

    lower: jax.Array
    upper: jax.Array
    x: Rows
    y: jax.Array
    z: Rows


def _apply(patterns: np.ndarray, x: jax.Array) -> jax.Array:
    """A x: (k, n, *lanes) -> (m, n, *lanes)."""
    shape = (-1,) + (1,) * (x.ndim - 1)
    terms = [patterns[:, a].astype(x.dtype).reshape(shape) * x[a] for a in range(patterns.shape[1])]
    return fold(jnp.add, terms)


def _adjoint(patterns: np.ndarray, z: jax.Array) -> list[jax.Array]:
    """A'z: (m, n, *lanes) -> k arrays (n, *lanes)."""
    return [_weigh(patterns[:, a], z) for a in range(patterns.shape[1])]


def _weigh(coefficients: np.ndarray, rows: jax.Array) -> jax.Array:
    """Sum over rows with constant coefficients; zeros cost nothing."""
    return fold(jnp.add, [rows[m] * float(c) for m, c in enumerate(coefficients) if c])


def _total(x: jax.Array) -> jax.Array:
    """Sum over blocks, (n, *lanes) -> (*lanes)."""
    return fold(jnp.add, x)


def _dot(a: list[jax.Array] | jax.Array, b: list[jax.Array] | jax.Array) -> jax.Array:
    return fold(jnp.add, [x * y for x, y in zip(a, b, strict=True)])


def _cholesky(matrix: dict, size: int) -> tuple[dict, list[jax.Array]]:
    """Unrolled Cholesky of the lower triangle; pivots clamped at eps of their diagonal. Returns L and 1/diag(L)."""
    lower, inverse = {}, []
    for j in range(size):
        pivot = matrix[j, j]
        floor = pivot * jnp.finfo(pivot.dtype).eps
        for k in range(j):
            pivot = pivot - lower[j, k] * lower[j, k]
        inverse.append(jax.lax.rsqrt(jnp.maximum(pivot, floor)))
        for i in range(j + 1, size):
            entry = matrix[i, j]
            for k in range(j):
                entry = entry - lower[i, k] * lower[j, k]
            lower[i, j] = entry * inverse[j]
    return lower, inverse


def _forward(lower: dict, inverse: list, rhs: list) -> list:
    out: list = []
    for i, entry in enumerate(rhs):
        for k in range(i):
            entry = entry - lower[i, k] * out[k]
        out.append(entry * inverse[i])
    return out


def _backward(lower: dict, inverse: list, rhs: list) -> list:
    size = len(rhs)
    out: list = [None] * size
    for i in reversed(range(size)):
        entry = rhs[i]
        for k in range(i + 1, size):
            entry = entry - lower[k, i] * out[k]
        out[i] = entry * inverse[i]
    return out


class _BlockFactor(NamedTuple):
    lower: dict
    inverse: list
    columns: list  # eq lists of k arrays: L^-1 E'
    theta: list  # L^-1 p
    phi: list  # P^-1 p


class _Factors(NamedTuple):
    blocks: list[_BlockFactor]
    border: jax.Array | None  # 1 / kappa, the inverse pivot of lambda
    v: list
    lower: dict
    inverse: list


@dataclass(frozen=True)
class BlockProblem:
    """What both programs share.

    groups: the blocks.
    rhs: (eq, *lanes), b; zero in rows that are zero in E.
    dropped: (eq, *lanes), 1 for the equality rows that are zero, else 0.
    radius: how |x|_inf at the optimum grows with a negative lambda: 1 + radius * max(0, -lambda).
    """

    groups: tuple[Blocks, ...]
    rhs: jax.Array
    dropped: jax.Array
    radius: float
    bordered = True

    @property
    def lanes(self) -> tuple[int, ...]:
        return self.rhs.shape[1:]

    @property
    def present(self) -> Rows:
        return tuple(g.present for g in self.groups)

    @property
    def equalities(self) -> int:
        return self.rhs.shape[0]

    def equality(self, x: Rows) -> list[jax.Array]:
        """E x, one array (*lanes) a row."""
        return [
            fold(jnp.add, [_total(_dot(g.columns[r], x_g)) for g, x_g in zip(self.groups, x, strict=True)])
            for r in range(self.equalities)
        ]

    def adjoint(self, y: jax.Array | list[jax.Array]) -> list[list[jax.Array]]:
        """E'y, k arrays (n, *lanes) a group."""
        return [
            [fold(jnp.add, [g.columns[r, a] * y[r] for r in range(self.equalities)]) for a in range(g.columns.shape[1])]
            for g in self.groups
        ]

    def project(self, x: Rows) -> Rows:
        """The nearest point with E x = b, for orthonormal rows."""
        gap = [b - e for b, e in zip(self.rhs, self.equality(x), strict=True)]
        return tuple(x_g + jnp.stack(c) for x_g, c in zip(x, self.adjoint(gap), strict=True))

    def factor(self, weights: Rows) -> _Factors:
        blocks, squares = [], []
        for g, w in zip(self.groups, weights, strict=True):
            lower, inverse, theta, phi = fenced(lambda w, g=g: self._factor_block(g, w))(w)
            columns = fenced(lambda c, l, i: [_forward(l, i, list(r)) for r in c])(g.columns, lower, inverse)
            blocks.append(_BlockFactor(lower, inverse, columns, theta, phi))
        matrix, v, border = fenced(self._schur)(blocks, weights)
        lower, inverse = fenced(lambda m: _cholesky(m, self.equalities))(matrix)
        return _Factors(blocks, border, v, lower, inverse)

    def _factor_block(self, g: Blocks, w: jax.Array) -> tuple:
        """L, 1/diag(L), theta = L^-1 p and phi = P^-1 p for P = A'WA (+ H), p = A'W sigma."""
        k = g.patterns.shape[1]
        gram = {(a, c): _weigh(g.patterns[:, a] * g.patterns[:, c], w) for a in range(k) for c in range(a + 1)}
        for a in range(k):
            gram[a, a] = gram[a, a] + (1 - g.present)
        if g.hessian is not None:
            gram = {(a, c): entry + g.hessian[a, c] for (a, c), entry in gram.items()}
        lower, inverse = _cholesky(gram, k)
        if not self.bordered:
            return lower, inverse, [], []
        theta = _forward(lower, inverse, _adjoint(g.patterns, w * g.sigma))
        return lower, inverse, theta, _backward(lower, inverse, theta)

    def _schur(self, blocks: list[_BlockFactor], weights: Rows) -> tuple:
        """The matrix of the equality rows after blocks and lambda are gone, with lambda's column v and inverse pivot."""
        eq = range(self.equalities)
        matrix = {
            (r, q): fold(jnp.add, [_total(_dot(f.columns[r], f.columns[q])) for f in blocks])
            for r in eq
            for q in range(r + 1)
        }
        v, border = [], None
        if self.bordered:
            squares = []
            for g, f, w in zip(self.groups, blocks, weights, strict=True):
                # As a sum of squares: sigma'W sigma - p'P^-1 p would cancel near the optimum.
                lean = fenced(lambda phi, sigma, g=g: sigma - _apply(g.patterns, jnp.stack(phi)))(f.phi, g.sigma)
                squares.append(_total(fold(jnp.add, w * lean * lean)))
            kappa = fold(jnp.add, squares)
            border = 1 / jnp.maximum(kappa, jnp.finfo(kappa.dtype).tiny)
            v = [-fold(jnp.add, [_total(_dot(f.columns[r], f.theta)) for f in blocks]) for r in eq]
            matrix = {(r, q): entry + v[r] * (v[q] * border) for (r, q), entry in matrix.items()}
        for r in eq:
            matrix[r, r] = matrix[r, r] + self.dropped[r]
        return matrix, v, border

    def _newton(self, factors: _Factors, rhs_x: list, rhs_lambda: jax.Array | None, rhs_y: list) -> tuple:
        """Solve [P p E'; p' hll 0; E 0 0] (dx, dlambda, dy) = (rhs_x, rhs_lambda, rhs_y)."""
        reduced, right, pull = fenced(self._eliminate)(factors, rhs_x, rhs_lambda, rhs_y)
        dy, dlambda = fenced(self._solve_equalities)(factors, right, pull)
        return fenced(self._substitute)(factors, reduced, dy, dlambda), dlambda, dy

    def _eliminate(self, factors: _Factors, rhs_x: list, rhs_lambda: jax.Array | None, rhs_y: list) -> tuple:
        reduced = [_forward(f.lower, f.inverse, r) for f, r in zip(factors.blocks, rhs_x, strict=True)]
        pairs = list(zip(factors.blocks, reduced, strict=True))
        right = [
            fold(jnp.add, [_total(_dot(f.columns[r], a)) for f, a in pairs]) - rhs_y[r] for r in range(self.equalities)
        ]
        if not self.bordered:
            return reduced, right, None
        pull = rhs_lambda - fold(jnp.add, [_total(_dot(f.theta, a)) for f, a in pairs])
        scaled = pull * factors.border
        return reduced, [r + v * scaled for r, v in zip(right, factors.v, strict=True)], pull

    def _solve_equalities(self, factors: _Factors, right: list, pull: jax.Array | None) -> tuple:
        dy = _backward(factors.lower, factors.inverse, _forward(factors.lower, factors.inverse, right))
        return dy, (pull - _dot(factors.v, dy)) * factors.border if self.bordered else None

    def _substitute(self, factors: _Factors, reduced: list, dy: list, dlambda: jax.Array | None) -> list:
        dx = []
        for f, a in zip(factors.blocks, reduced, strict=True):
            left = []
            for c, entry in enumerate(a):
                entry = entry - fold(jnp.add, [f.columns[r][c] * dy[r] for r in range(self.equalities)])
                left.append(entry - f.theta[c] * dlambda if self.bordered else entry)
            dx.append(jnp.stack(_backward(f.lower, f.inverse, left)))
        return dx


@dataclass(frozen=True)
class MarginProblem(BlockProblem):
    """max lambda; x is (blocks, lambda). Record: `lower` is attained by `x`, `upper` is certified by (y, z), sum sigma z = 1."""

    @cached_property
    def inverse_sigma(self) -> Rows:
        return tuple(1 / jnp.maximum(g.sigma, jnp.finfo(g.sigma.dtype).tiny * 4) for g in self.groups)

    def attained(self, x: Rows) -> jax.Array:
        """min (h - A x) / sigma, the lambda that x attains when E x = b; -huge where a row with sigma = 0 is violated."""
        parts = []
        for g, x_g, inverse in zip(self.groups, x, self.inverse_sigma, strict=True):
            eps = 8 * jnp.finfo(g.h.dtype).eps
            # A row that lambda hardly moves may miss its right-hand side by rounding.
            soft = g.h + jnp.where(g.sigma <= 1e4 * eps, eps, 0)
            ratio = (soft - _apply(g.patterns, x_g)) * inverse
            parts.append(fold(jnp.minimum, fold(jnp.minimum, ratio)))
        return fold(jnp.minimum, parts)

    def violations(self, x: Rows, lam: jax.Array) -> jax.Array:
        """Largest amount by which any row is missed, (*lanes)."""
        missed = [jnp.abs(e - b) for e, b in zip(self.equality(x), self.rhs, strict=True)]
        for g, x_g in zip(self.groups, x, strict=True):
            over = _apply(g.patterns, x_g) + g.sigma * lam - g.h
            missed.append(fold(jnp.maximum, fold(jnp.maximum, over)))
        return jnp.maximum(fold(jnp.maximum, missed), 0)

    def start(self) -> Iterate:
        blocks, slacks, scales, lambdas = [], [], [], []
        for g in self.groups:
            x = jnp.zeros((g.patterns.shape[1], *g.present.shape), g.h.dtype)
            blocks.append(x.at[-1].set(-0.6 * g.present) if g.patterns.shape[1] > 1 else x)
        blocks = self.project(tuple(blocks))
        for g, x in zip(self.groups, blocks, strict=True):
            ratio = jnp.where(g.sigma > 1e-3, (g.h - _apply(g.patterns, x)) / jnp.maximum(g.sigma, 1e-3), jnp.inf)
            lambdas.append(fold(jnp.minimum, fold(jnp.minimum, ratio)))
        low = fold(jnp.minimum, lambdas)
        low = jnp.where(jnp.isfinite(low), low, 0)
        lam = low - jnp.maximum(jnp.abs(low), 0.1)
        for g, x in zip(self.groups, blocks, strict=True):
            slacks.append(g.h - _apply(g.patterns, x) - g.sigma * lam)
        least = fold(jnp.minimum, [fold(jnp.minimum, fold(jnp.minimum, s)) for s in slacks])
        floor = jnp.maximum(0.1, -least)
        s, z = [], []
        for g, slack in zip(self.groups, slacks, strict=True):
            kept = jnp.maximum(slack, floor)
            s.append(jnp.where(g.present > 0, kept, 1))
            balance = _balance(g.patterns)
            scale = g.present / jnp.maximum(_weigh(balance > 0, kept) / np.count_nonzero(balance), 1e-6)
            z.append(balance.astype(scale.dtype).reshape((-1,) + (1,) * scale.ndim) * scale)
        scales = fold(jnp.add, [_total(fold(jnp.add, g.sigma * zz)) for g, zz in zip(self.groups, z, strict=True)])
        z = tuple(zz / jnp.maximum(scales, 1e-6) for zz in z)
        return Iterate((tuple(blocks), lam), jnp.zeros_like(self.rhs), tuple(s), z)

    def residuals(self, iterate: Iterate) -> Residuals:
        blocks, lam = iterate.x
        dual = []
        for g, z, e in zip(self.groups, iterate.z, self.adjoint(iterate.y), strict=True):
            dual.append(jnp.stack([a + c for a, c in zip(_adjoint(g.patterns, z), e, strict=True)]))
        pull = fold(jnp.add, [_total(fold(jnp.add, g.sigma * z)) for g, z in zip(self.groups, iterate.z, strict=True)]) - 1
        primal = jnp.stack([e - b for e, b in zip(self.equality(blocks), self.rhs, strict=True)])
        rows = tuple(
            (_apply(g.patterns, x) + g.sigma * lam + s - g.h) for g, x, s in zip(self.groups, blocks, iterate.s, strict=True)
        )
        return Residuals((tuple(dual), pull), primal, rows)

    def solve(self, factors: _Factors, weights: Rows, residuals: Residuals, shift: Rows) -> tuple:
        dual, pull = residuals.dual


        @fenced
        def right_hand_side(dual: Rows, pull: jax.Array, shift: Rows) -> tuple:
            rhs_x, rhs_lambda = [], -pull
            for g, d, e in zip(self.groups, dual, shift, strict=True):
                rhs_x.append([-a - c for a, c in zip(d, _adjoint(g.patterns, e), strict=True)])
                rhs_lambda = rhs_lambda - _total(fold(jnp.add, g.sigma * e))
            return rhs_x, rhs_lambda

        rhs_x, rhs_lambda = right_hand_side(dual, pull, shift)
        dx, dlambda, dy = self._newton(factors, rhs_x, rhs_lambda, [-r for r in residuals.primal])
        dx = tuple(dx)
        rows = tuple(_apply(g.patterns, d) + g.sigma * dlambda for g, d in zip(self.groups, dx, strict=True))
        return (dx, dlambda), jnp.stack(dy), rows

    def first_record(self) -> Record:
        """The smallest forces that meet E x = b attain a first bound; without a load it is lambda = 0, exactly."""
        nothing = tuple(jnp.zeros((g.patterns.shape[1], *g.present.shape), self.rhs.dtype) for g in self.groups)
        x = self.project(nothing)
        z = tuple(jnp.zeros_like(g.sigma) for g in self.groups)
        return Record(self.attained(x), jnp.full(self.lanes, jnp.inf, self.rhs.dtype), x, jnp.zeros_like(self.rhs), z)

    def assess(self, iterate: Iterate, residuals: Residuals, record: Record) -> Record:
        x = self.project(iterate.x[0])
        lower = self.attained(x)
        pull = residuals.dual[1] + 1
        lost = fold(jnp.add, [_total(fold(jnp.add, jnp.abs(d))) for d in residuals.dual[0]])
        held = fold(jnp.add, [_total(fold(jnp.add, g.h * z)) for g, z in zip(self.groups, iterate.z, strict=True)])
        value = held + _dot(iterate.y, self.rhs)
        best = jnp.maximum(lower, record.lower)
        radius = 1 + float(self.radius) * jnp.maximum(0, -best)
        scale = 1 / pull
        upper = jnp.where(pull > 0, (value + radius * lost) * scale, jnp.inf)
        rises, falls = lower > record.lower, upper < record.upper
        return Record(
            lower=best,
            upper=jnp.where(falls, upper, record.upper),
            x=tuple(jnp.where(rises, n, o) for n, o in zip(x, record.x, strict=True)),
            y=jnp.where(falls, iterate.y * scale, record.y),
            z=tuple(jnp.where(falls, n * scale, o) for n, o in zip(iterate.z, record.z, strict=True)),
        )


def _balance(patterns: np.ndarray) -> np.ndarray:
    """Multipliers t >= 0 with A't = 0: facets 1, the opposing last row whatever cancels them; a symmetric pair gives 1, 1."""
    weights = np.ones(len(patterns))
    weights[-1] = -patterns[:-1, -1].sum() / patterns[-1, -1]
    return weights
