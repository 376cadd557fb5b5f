"""The homogeneous embedding of a small dense quadratic program, as a problem of the interior-point loop.

With tau > 0 and kappa >= 0 beside the unknowns of min 1/2 x'Px + q'x, Ax = b, Gx + s = h, s >= 0,

    P x + A'y + G'z + q tau = 0,    A x = b tau,    G x + s = h tau,
    kappa + x'Px/tau + q'x + b'y + h'z = 0,    s, z, tau, kappa >= 0,    s z = 0,    tau kappa = 0.

Where tau > 0, (x, s, y, z)/tau is optimal. Where kappa > 0, either b'y + h'z < 0 and (y, z) proves that nothing is
feasible, or q'x < 0 and x is a ray along which the objective falls for ever. To the loop, (kappa, tau) is one more row.

A step first solves, with the weights W = Z/S of the other rows,

    [ P  A'  G'    ] [dx]   [ r1 ]
    [ A  0   0     ] [dy] = [ r2 ]        for the residuals, and for (-q, b, h), by which the others move with tau,
    [ G  0  -W^-1  ] [dz]   [ r3 ]

by an orthogonal factor R of [W^1/2 G; P^1/2], R'R = P + G'W G, and one of the equalities' Schur complement
A (P + G'W G)^-1 A'. Both are regularised, which refinement takes back. The row of (kappa, tau) then gives dtau.

Source: Goulart and Chen (2024), "Clarabel: an interior-point solver for conic programs with quadratic objectives".
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import lax

from jaxgrasp import linalg
from jaxgrasp.solvers.interior_point import Iterate, Residuals
from jaxgrasp.solvers.status import Status


class Constants(NamedTuple):
    """The numbers of one precision.

    tolerance: the error at which the loop stops.
    accept: the largest error of a solution, certificate or ray.
    regularisation: the diagonal that keeps the Newton matrix regular.
    step_cap: see `interior_point.Settings`.
    mu_floor: see `interior_point.Settings`.
    """

    tolerance: float
    accept: float
    regularisation: float
    step_cap: float
    mu_floor: float


CONSTANTS = {
    "float32": Constants(3e-6, 5e-5, 1e-6, 1e-2, 1e-12),
    "float64": Constants(1e-9, 1e-7, 1e-9, 1e-2, 1e-20),
}
_REFINEMENTS = 2


class QuadraticProgram(NamedTuple):
    """The data of min 1/2 x'Px + q'x over Ax = b, Gx <= h: P (n, n), q (n,), A (p, n), b (p,), G (m, n), h (m,)."""

    P: jax.Array
    q: jax.Array
    A: jax.Array
    b: jax.Array
    G: jax.Array
    h: jax.Array


class Factors(NamedTuple):
    """The factors of the Newton matrix without the row of tau."""

    inverse: jax.Array  # (n, n), R^-1
    reduced: jax.Array  # (n, p), R^-T A'
    schur: jax.Array  # (p, p), inverse triangular factor of the Schur complement
    weights: jax.Array  # (m,), z/s


class _Newton(NamedTuple):
    """The factors of the Newton matrix of the embedding."""

    factors: Factors
    weight: jax.Array  # (), tau / kappa
    ray: tuple[jax.Array, jax.Array, jax.Array]  # the solution for (-q, b, h), by which x, y, z move with tau


class _Record(NamedTuple):
    """The best iterate so far, its error, and the status that it proves; the loop watches `upper` - `lower`."""

    lower: jax.Array
    upper: jax.Array
    error: jax.Array
    iterate: Iterate
    status: jax.Array


@dataclass(frozen=True)
class HomogeneousEmbedding:
    """The homogeneous embedding of one program as a problem of the loop: s is (s, kappa) and z is (z, tau)."""

    program: QuadraticProgram
    constants: Constants
    lanes = ()

    @cached_property
    def present(self) -> jax.Array:
        """The mask of rows: every row counts."""
        return jnp.ones((self.program.h.size + 1,), self.program.h.dtype)

    @property
    def predictor(self) -> Self:
        """The problem itself: its directions are refined in any case, to take back the regularisation."""
        return self

    def start(self) -> Iterate:
        """Start at x = y = 0 and s = z = kappa = tau = 1."""
        # No start fitted to the data does better over all families of problems; least squares can be far too large.
        q, b = self.program.q, self.program.b
        return Iterate(jnp.zeros_like(q), jnp.zeros_like(b), self.present, self.present)

    def residuals(self, iterate: Iterate) -> Residuals:
        """Compute the residuals; `dual` has the iterate beside it, as the embedding is not linear in tau."""
        P, q, A, b, G, h = self.program
        x, y, s, z, tau = iterate.x, iterate.y, iterate.s, iterate.z[:-1], iterate.z[-1]
        balance = (x @ P @ x) / tau + q @ x + b @ y + h @ z
        rows = s + jnp.append(G @ x - h * tau, balance)
        return Residuals((P @ x + A.T @ y + G.T @ z + q * tau, iterate), A @ x - b * tau, rows)

    def factor(self, weights: jax.Array) -> _Newton:
        """Factor the Newton matrix for weights (z, tau) / (s, kappa)."""
        factors, (_, q, _, b, _, h) = self.reduce(weights[:-1]), self.program
        return _Newton(factors, weights[-1], self.newton(factors, (-q, b, h)))

    def reduce(self, weights: jax.Array) -> Factors:
        """Factor P + G'WG and A (P + G'WG)^-1 A', both regularised, for weights (m,)."""
        # An orthogonal factor of P + G'WG: forming that matrix would lose half the digits, in float32 all that count.
        _, _, A, b, G, _ = self.program
        small = jnp.sqrt(self.constants.regularisation)
        inverse = _inverse_factor(jnp.concatenate([jnp.sqrt(weights[:, None]) * G, self.root]))
        reduced = inverse.T @ A.T
        schur = _inverse_factor(jnp.concatenate([reduced, small * jnp.eye(b.size, dtype=b.dtype)]))
        return Factors(inverse, reduced, schur, weights)

    @cached_property
    def root(self) -> jax.Array:
        """A triangular square root of P, regularised, (n, n)."""
        P, small = self.program.P, self.constants.regularisation
        return linalg.cholesky(P + small * jnp.eye(P.shape[0], dtype=P.dtype)).T

    def newton(self, factors: Factors, right: tuple) -> tuple:
        """Solve P x + A'y + G'z = r1, A x = r2, G x - z/w = r3; refinement also takes back the regularisation."""
        P, _, A, _, G, _ = self.program
        inverse, reduced, schur, w = factors.inverse, factors.reduced, factors.schur, factors.weights

        def refine(_: int, solution: tuple) -> tuple:
            # Residuals of the three rows, z eliminated; then y by the Schur complement, x, and z.
            x, y, z = solution
            over = right[2] - G @ x + z / w
            reduced_x = inverse.T @ (right[0] - P @ x - A.T @ y - G.T @ (z - w * over))
            dy = schur @ (schur.T @ (reduced.T @ reduced_x - right[1] + A @ x))
            dx = inverse @ (reduced_x - reduced @ dy)
            return x + dx, y + dy, z + w * (G @ dx - over)

        return lax.fori_loop(0, 1 + _REFINEMENTS, refine, tuple(map(jnp.zeros_like, right)))

    def solve(self, factors: _Newton, residuals: Residuals, shift: jax.Array) -> tuple:
        """Solve for the Newton step of the embedding, tau last."""
        P, q, A, b, G, h = self.program
        dual, (x, _, s, z) = residuals.dual
        weights = jnp.append(factors.factors.weights, factors.weight)
        # Homogeneous residuals can only vanish together with s'z, so they are made to fall in the same proportion.
        # A row's shift tells the loop's aim but for a second-order term, small in most rows: hence the median.
        aim = jnp.median(s * (shift + z - weights * residuals.rows))
        share = jnp.clip(1 - aim / jnp.mean(s * z), 0, 1)
        remaining = (1 - share) * residuals.rows
        w, tau = weights[:-1], z[-1]

        # The step while tau stays.
        right = (-share * dual, -share * residuals.primal, remaining[:-1] - shift[:-1] / w)
        dx, dy, dz = self.newton(factors.factors, right)

        # The row of (kappa, tau), linearised at x / tau, gives dtau; the pivot is a sum of squares.
        at, (x1, y1, z1) = x / tau, factors.ray
        slope = 2 * (P @ at) + q
        bend = (x1 - at) @ P @ (x1 - at) + z1 @ (z1 / w)
        dtau = (shift[-1] / weights[-1] + slope @ dx + b @ dy + h @ dz - remaining[-1]) / (1 / weights[-1] + bend)
        # From dz, not G dx - h dtau, whose rounding times the weights would swamp the multipliers of active rows.
        dz = jnp.append(dz + dtau * z1, dtau)
        return dx + dtau * x1, dy + dtau * y1, (dz - shift) / weights

    def first_record(self) -> _Record:
        """Make the record before the first step: no iterate proves anything yet."""
        infinite = jnp.asarray(jnp.inf, self.program.q.dtype)
        return _Record(
            jnp.zeros_like(infinite), infinite, infinite, self.start(), jnp.asarray(int(Status.MAX_ITERATIONS))
        )

    def assess(self, iterate: Iterate, residuals: Residuals, record: _Record) -> _Record:
        """Measure the iterate as solution, certificate and ray, each row by the size of its terms; keep the best."""
        P, q, A, b, G, h = self.program
        x, y, s, z, tau = iterate.x, iterate.y, iterate.s[:-1], iterate.z[:-1], iterate.z[-1]
        Px, Ax, Gx, Aty, Gtz = P @ x, A @ x, G @ x, A.T @ y, G.T @ z
        xPx, cost, bound = x @ Px / tau, q @ x, b @ y + h @ z
        solution = [
            _relative(residuals.dual[0], tau, Px, Aty, Gtz, q * tau),
            _relative(residuals.primal, tau, Ax, b * tau),
            _relative(residuals.rows[:-1], tau, Gx, h * tau),
            jnp.abs(xPx + cost + bound) / (tau + jnp.minimum(jnp.abs(xPx / 2 + cost), jnp.abs(xPx / 2 + bound))),
        ]
        certificate = largest(Aty + Gtz) / jnp.maximum(-bound, 0)
        ray = jnp.maximum(largest(Px), jnp.maximum(largest(Ax), largest(Gx + s))) / jnp.maximum(-cost, 0)
        errors = jnp.stack([jnp.max(jnp.stack(solution)), certificate, ray])
        errors = jnp.where(jnp.isnan(errors), jnp.inf, errors)
        best = jnp.argmin(errors)  # in the order of Status: SOLVED, INFEASIBLE, UNBOUNDED
        new = _Record(record.lower, record.upper, errors[best], iterate, best.astype(record.status.dtype))
        new = jax.tree.map(lambda n, o: jnp.where(new.error < record.error, n, o), new, record)
        # While tau finds its size the error may stay the same; as long as s'z falls, the loop makes progress.
        pace = jnp.sqrt(new.error * jnp.mean(iterate.s * iterate.z))
        return new._replace(upper=jnp.minimum(pace, record.upper))

    def gap_scale(self, record: _Record) -> jax.Array:
        """Tell the loop to stop where the error is small enough, whatever the gap."""
        return jnp.where(record.error <= self.constants.tolerance, jnp.inf, 0)


def _inverse_factor(rows: jax.Array) -> jax.Array:
    """Compute R^-1 with R'R = rows' rows, by Cholesky's factorisation in three passes.

    Each pass makes the columns of rows R^-1 more orthogonal, shifted to stay positive definite (Fukaya et al., 2020).
    The result is as accurate as LAPACK's QR, which on CPUs is far slower for batches of small matrices.
    """
    n = rows.shape[1]
    if not n:
        return rows[:0]
    identity = jnp.eye(n, dtype=rows.dtype)

    def refine(_: int, inverse: jax.Array) -> jax.Array:
        columns = rows @ inverse
        gram = columns.T @ columns
        shift = n * jnp.finfo(rows.dtype).eps * jnp.max(jnp.diag(gram))
        return inverse @ linalg.inverse_root(gram + shift * identity).T

    return lax.fori_loop(0, 3, refine, identity)


def largest(v: jax.Array) -> jax.Array:
    """Compute the maximum norm, 0 for an empty vector."""
    return jnp.max(jnp.abs(v), initial=0)


def _relative(residual: jax.Array, tau: jax.Array, *terms: jax.Array) -> jax.Array:
    """Compute the largest residual relative to tau plus the size of its terms."""
    return largest(residual / (tau + sum(jnp.abs(term) for term in terms)))
