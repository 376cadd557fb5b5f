"""Any small dense quadratic or linear program, in batch, with certificates where there is no solution.

The loop walks on the homogeneous embedding: with tau > 0 and kappa >= 0 beside the program's own unknowns,

    P x + A'y + G'z + q tau = 0,    A x = b tau,    G x + s = h tau,
    kappa + x'Px/tau + q'x + b'y + h'z = 0,    s, z, tau, kappa >= 0,    s z = 0,    tau kappa = 0.

Where tau > 0, (x, s, y, z)/tau is optimal. Where kappa > 0, either b'y + h'z < 0 and (y, z) proves that nothing is feasible, or
q'x < 0 and x is a ray along which the objective falls for ever. The pair (kappa, tau) is to the loop one more row.

Source: Goulart and Chen, "Clarabel: an interior-point solver for conic programs with quadratic objectives" (2024).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import lu_factor, lu_solve
from jax.typing import ArrayLike

from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.interior_point import Iterate, Residuals, Settings
from jaxgrasp.solvers.status import Status


class _Constants(NamedTuple):
    """By precision: wanted and accepted error, and the diagonal that keeps the Newton matrix regular."""

    tolerance: float
    accept: float
    regularisation: float
    step_cap: float
    mu_floor: float


_CONSTANTS = {
    "float32": _Constants(3e-6, 5e-5, 1e-6, 1e-2, 1e-12),
    "float64": _Constants(1e-9, 1e-7, 1e-9, 1e-2, 1e-20),
}
_REFINEMENTS = 2
_EQUILIBRATIONS = 10
# Steps without progress at the start, while tau finds its size, are common.
_PATIENCE = 8


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class QPSolution:
    """What `solve_qp` found; every field has the leading axes of the batch.

    Where a field has no meaning for the status it is NaN, or infinite for `objective` and the residuals.
    """

    x: jax.Array
    """(*batch, n): the minimiser; if UNBOUNDED a ray with q'x = -1, Px = 0, Ax = 0 and Gx <= 0."""
    s: jax.Array
    """(*batch, m): slacks h - Gx >= 0; if UNBOUNDED those of the ray, -Gx."""
    y: jax.Array
    """(*batch, p): multipliers of Ax = b; if INFEASIBLE part of a certificate (y, z): A'y + G'z = 0, b'y + h'z = -1."""
    z: jax.Array
    """(*batch, m): multipliers of Gx <= h, z >= 0; if INFEASIBLE part of that certificate."""
    objective: jax.Array
    """(*batch,): 1/2 x'Px + q'x; inf if INFEASIBLE, -inf if UNBOUNDED."""
    status: jax.Array
    """(*batch,): integers of `Status`; MAX_ITERATIONS where the best point found is not good enough."""
    primal_residual: jax.Array
    """(*batch,): max |Ax - b|, |Gx + s - h|; of the ray, max |Px|, |Ax|, |Gx + s|."""
    dual_residual: jax.Array
    """(*batch,): max |Px + q + A'y + G'z|; of the certificate, r = max |A'y + G'z|: no x with sum |x| < 1/r is feasible."""
    gap: jax.Array
    """(*batch,): |x'Px + q'x + b'y + h'z|."""
    iterations: jax.Array
    """(*batch,): steps taken."""


class _Program(NamedTuple):
    """min 1/2 x'Px + q'x, Ax = b, Gx <= h."""

    P: jax.Array
    q: jax.Array
    A: jax.Array
    b: jax.Array
    G: jax.Array
    h: jax.Array


class _Factors(NamedTuple):
    """LU of the Newton matrix, the scaling of its last rows, the weights, and its solution for (-q, b, h)."""

    lu: tuple[jax.Array, jax.Array]
    scale: jax.Array
    weights: jax.Array
    ray: tuple[jax.Array, jax.Array, jax.Array]


class _Record(NamedTuple):
    """The best iterate so far with its error and what it shows; `upper` - `lower` is what the loop watches."""

    lower: jax.Array
    upper: jax.Array
    error: jax.Array
    iterate: Iterate
    shows: jax.Array


@dataclass(frozen=True)
class _Embedding:
    """The homogeneous embedding of one program as a problem of the loop: s is (s, kappa) and z is (z, tau)."""

    program: _Program
    constants: _Constants
    lanes = ()

    @cached_property
    def present(self) -> jax.Array:
        return jnp.ones((self.program.h.size + 1,), self.program.h.dtype)

    def start(self) -> Iterate:
        # Nothing that is fitted to the data does better over all families, and a least-squares point can be far too large.
        q, b = self.program.q, self.program.b
        return Iterate(jnp.zeros_like(q), jnp.zeros_like(b), self.present, self.present)

    def residuals(self, iterate: Iterate) -> Residuals:
        """The embedding is not linear in tau, so `dual` takes along the iterate at which it is linearised."""
        P, q, A, b, G, h = self.program
        x, y, s, z, tau = iterate.x, iterate.y, iterate.s, iterate.z[:-1], iterate.z[-1]
        balance = (x @ P @ x) / tau + q @ x + b @ y + h @ z
        rows = s + jnp.append(G @ x - h * tau, balance)
        return Residuals((P @ x + A.T @ y + G.T @ z + q * tau, iterate), A @ x - b * tau, rows)

    def factor(self, weights: jax.Array) -> _Factors:
        # The rows of G stay in the matrix: the smaller P + G'WG loses half the digits, in float32 all that count.
        P, q, A, b, G, h = self.program
        w, (p, n) = weights[:-1], A.shape
        scale, small = jnp.sqrt(w / (1 + w)), self.constants.regularisation
        rows = jnp.concatenate([A, scale[:, None] * G])
        diagonal = jnp.concatenate([jnp.full(p, small, w.dtype), 1 / (1 + w)])
        lu = lu_factor(jnp.block([[P + small * jnp.eye(n, dtype=w.dtype), rows.T], [rows, -jnp.diag(diagonal)]]))
        return _Factors(lu, scale, weights, self._newton(lu, scale, w, (-q, b, h)))

    def _newton(self, lu: tuple, scale: jax.Array, w: jax.Array, right: tuple) -> tuple:
        """Solve P x + A'y + G'z = r1, A x = r2, G x - z/w = r3 with refinement, which also takes back the regularisation."""
        P, _, A, _, G, _ = self.program
        p, n = A.shape

        def refine(_: int, solution: tuple) -> tuple:
            x, y, z = solution
            lacking = (right[0] - P @ x - A.T @ y - G.T @ z, right[1] - A @ x, scale * (right[2] - G @ x + z / w))
            step = lu_solve(lu, jnp.concatenate(lacking))
            return x + step[:n], y + step[n : n + p], z + scale * step[n + p :]

        return lax.fori_loop(0, 1 + _REFINEMENTS, refine, tuple(map(jnp.zeros_like, right)))

    def solve(self, factors: _Factors, residuals: Residuals, shift: jax.Array) -> tuple:
        P, q, A, b, G, h = self.program
        lacking, (x, _, s, z) = residuals.dual
        weights = factors.weights
        # Homogeneous residuals can only vanish together with s'z, so they are made to fall in the same proportion. A row's
        # shift shows what the loop aims at but for a second-order term; that is small in most rows, hence the median.
        aim = jnp.median(s * (shift + z - weights * residuals.rows))
        share = jnp.clip(1 - aim / jnp.mean(s * z), 0, 1)
        lag = (1 - share) * residuals.rows
        w, tau = weights[:-1], z[-1]
        dx, dy, dz = self._newton(
            factors.lu, factors.scale, w, (-share * lacking, -share * residuals.primal, lag[:-1] - shift[:-1] / w)
        )
        at, (x1, y1, z1) = x / tau, factors.ray
        slope = 2 * (P @ at) + q
        bend = (x1 - at) @ P @ (x1 - at) + z1 @ (z1 / w)
        dtau = (shift[-1] / weights[-1] + slope @ dx + b @ dy + h @ dz - lag[-1]) / (1 / weights[-1] + bend)
        # From dz, not as G dx - h dtau: times the weights, rounding in those would swamp the multipliers of active rows.
        dz = jnp.append(dz + dtau * z1, dtau)
        return dx + dtau * x1, dy + dtau * y1, (dz - shift) / weights

    def first_record(self) -> _Record:
        infinite = jnp.asarray(jnp.inf, self.program.q.dtype)
        return _Record(jnp.zeros_like(infinite), infinite, infinite, self.start(), jnp.asarray(int(Status.MAX_ITERATIONS)))

    def assess(self, iterate: Iterate, residuals: Residuals, record: _Record) -> _Record:
        """Errors of the iterate as solution, certificate and ray; each row is measured by the size of its own terms."""
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
        certificate = _largest(Aty + Gtz) / jnp.maximum(-bound, 0)
        ray = jnp.maximum(_largest(Px), jnp.maximum(_largest(Ax), _largest(Gx + s))) / jnp.maximum(-cost, 0)
        errors = jnp.stack([jnp.max(jnp.stack(solution)), certificate, ray])
        errors = jnp.where(jnp.isnan(errors), jnp.inf, errors)
        best = jnp.argmin(errors)  # in the order of Status: SOLVED, INFEASIBLE, UNBOUNDED
        new = _Record(record.lower, record.upper, errors[best], iterate, best.astype(record.shows.dtype))
        new = jax.tree.map(lambda n, o: jnp.where(new.error < record.error, n, o), new, record)
        # While tau finds its size the error may rest; as long as s'z falls, the loop is getting on.
        pace = jnp.sqrt(new.error * jnp.mean(iterate.s * iterate.z))
        return new._replace(upper=jnp.minimum(pace, record.upper))

    def gap_scale(self, record: _Record) -> jax.Array:
        """The error alone says whether a lane is finished."""
        return jnp.where(record.error <= self.constants.tolerance, jnp.inf, 0)


def _largest(v: jax.Array) -> jax.Array:
    return jnp.max(jnp.abs(v), initial=0)


def _relative(residual: jax.Array, tau: jax.Array, *terms: jax.Array) -> jax.Array:
    return _largest(residual / (tau + sum(jnp.abs(term) for term in terms)))


def _typical(v: jax.Array) -> jax.Array:
    """Geometric mean of the entries that are not zero, which a few huge right-hand sides do not drag along; 1 if none."""
    nonzero = v != 0
    logs = jnp.where(nonzero, jnp.log(jnp.abs(jnp.where(nonzero, v, 1))), 0)
    return jnp.exp(jnp.sum(logs) / jnp.maximum(jnp.sum(nonzero, dtype=v.dtype), 1))


def _equilibrated(program: _Program) -> tuple[_Program, Iterate]:
    """Ruiz's scaling: rows and columns of the KKT matrix of largest entry 1, q, b and h of order 1.

    Returns the scaled program and the factors that take its x, y, s and z back.
    """
    P, q, A, b, G, h = program
    (p, n), m = A.shape, h.size
    rows = jnp.concatenate([A, G])
    matrix = jnp.block([[P, rows.T], [rows, jnp.zeros((p + m, p + m), P.dtype)]])

    def equilibrate(_: int, scale: jax.Array) -> jax.Array:
        largest = jnp.max(jnp.abs(matrix) * scale * scale[:, None], 1)
        return scale / jnp.sqrt(jnp.where(largest > 0, largest, 1))

    scale = lax.fori_loop(0, _EQUILIBRATIONS, equilibrate, jnp.ones(n + p + m, P.dtype))
    d, e, f = scale[:n], scale[n : n + p], scale[n + p :]
    cost, size = 1 / _typical(q * d), 1 / _typical(jnp.concatenate([b * e, h * f]))
    scaled = _Program(
        P * d * d[:, None] * (cost / size), q * d * cost, A * d * e[:, None], b * e * size, G * d * f[:, None], h * f * size
    )
    return scaled, Iterate(d / size, e / cost, 1 / (f * size), f / cost)


def _solve_one(program: _Program) -> QPSolution:
    constants = _CONSTANTS[program.q.dtype.name]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in program]))
    P = (program.P + program.P.T) / 2
    # Rounding in the caller's P may leave it that far from positive semidefinite.
    slack = 16 * P.shape[0] * jnp.finfo(P.dtype).eps * jnp.where(jnp.any(P != 0), _largest(P), 1)
    shifted = jnp.where(finite, P / slack, 0) + jnp.eye(P.shape[0], dtype=P.dtype)
    valid = finite & jnp.all(jnp.isfinite(jnp.linalg.cholesky(shifted)))
    program = _Program(*(jnp.where(valid, v, 0) for v in program._replace(P=P)))
    scaled, back = _equilibrated(program)
    settings = Settings(constants.tolerance, 60, constants.step_cap, constants.mu_floor, True, 0.0, _PATIENCE)
    outcome = interior_point.solve(_Embedding(scaled, constants), settings, valid)
    record, iterate = outcome.record, outcome.record.iterate
    found = jnp.where(record.error <= constants.accept, record.shows, int(Status.MAX_ITERATIONS))
    status = jnp.where(valid, found, int(Status.INVALID_INPUT))
    unscaled = iterate._replace(s=iterate.s[:-1], z=iterate.z[:-1])
    return _answer(program, Iterate(*map(jnp.multiply, unscaled, back)), iterate.z[-1], status, outcome.iterations)


def _answer(program: _Program, iterate: Iterate, tau: jax.Array, status: jax.Array, iterations: jax.Array) -> QPSolution:
    """The iterate divided by tau, or the certificate that it is, with residuals in the caller's units."""
    P, q, A, b, G, h = program
    none, ray, valid = status == Status.INFEASIBLE, status == Status.UNBOUNDED, status != Status.INVALID_INPUT
    shown = ~none & ~ray & valid
    # A certificate is measured by b'y + h'z or q'x; neither touches the numbers of the other.
    x, s = (v / jnp.where(ray, -q @ iterate.x, tau) for v in (iterate.x, iterate.s))
    y, z = (v / jnp.where(none, -b @ iterate.y - h @ iterate.z, tau) for v in (iterate.y, iterate.z))
    Px, pull = P @ x, A.T @ y + G.T @ z
    primal = jnp.maximum(_largest(A @ x - jnp.where(ray, 0, b)), _largest(G @ x + s - jnp.where(ray, 0, h)))
    dual = _largest(jnp.where(none, 0, Px + q) + pull)
    infinite = jnp.asarray(jnp.inf, q.dtype)
    value = jnp.where(none, infinite, jnp.where(ray, -infinite, x @ Px / 2 + q @ x))
    with_x, with_y = valid & ~none, valid & ~ray
    return QPSolution(
        x=jnp.where(with_x, x, jnp.nan),
        s=jnp.where(with_x, s, jnp.nan),
        y=jnp.where(with_y, y, jnp.nan),
        z=jnp.where(with_y, z, jnp.nan),
        objective=jnp.where(valid, value, jnp.nan),
        status=status,
        primal_residual=jnp.where(with_x, jnp.where(ray, jnp.maximum(primal, _largest(Px)), primal), infinite),
        dual_residual=jnp.where(with_y, dual, infinite),
        gap=jnp.where(shown, jnp.abs(x @ Px + q @ x + b @ y + h @ z), infinite),
        iterations=iterations,
    )


def solve_qp(
    P: ArrayLike | None,
    q: ArrayLike,
    A: ArrayLike | None = None,
    b: ArrayLike | None = None,
    G: ArrayLike | None = None,
    h: ArrayLike | None = None,
) -> QPSolution:
    """Solve small dense quadratic programs, each lane of a batch to its own optimum or certificate.

    Minimises 1/2 x'Px + q'x over A x = b and G x <= h. Rows may be dependent, duplicated or zero (a row 0 x <= 1 pads ragged
    batches). Derivatives are not provided yet. The work is cubic in n + p + m.

    Args:
        P: (*batch, n, n), positive semidefinite; only its symmetric part counts. None: a linear program.
        q: (*batch, n).
        A: (*batch, p, n), or None with b.
        b: (*batch, p).
        G: (*batch, m, n), or None with h.
        h: (*batch, m), finite.

    Returns:
        A `QPSolution`. The leading axes of all arguments broadcast.

    Raises:
        ValueError: shapes that do not fit, one of a pair missing, or a dtype other than real numbers (tracing time).

    Status:
        SOLVED where every residual is below 1e-7 (float32: 1e-4) of 1 plus its own terms, in equilibrated units;
        INFEASIBLE and UNBOUNDED with a certificate as exact as that; MAX_ITERATIONS with the best point otherwise;
        INVALID_INPUT for data that are not finite, or P that is not positive semidefinite.
    """
    q = as_float("q", q, ("n",))
    n = q.shape[-1]
    P = jnp.zeros((n, n), q.dtype) if P is None else as_float("P", P, (n, n))
    rows = [*_pair("A", A, "b", b, n, q.dtype), *_pair("G", G, "h", h, n, q.dtype)]
    dtype = jnp.result_type(P, q, *rows)
    if dtype.name not in _CONSTANTS:
        raise ValueError(f"P, q, A, b, G, h: got dtype {dtype.name} together, wanted float32 or float64")
    program = _Program(P, q, *rows)
    events = _Program(2, 1, 2, 1, 2, 1)
    shapes = {name: v.shape[: v.ndim - k] for name, v, k in zip(_Program._fields, program, events, strict=True)}
    batch = broadcast_batch(**shapes)
    lanes = _Program(
        *(
            jnp.broadcast_to(v, (*batch, *v.shape[v.ndim - k :])).reshape(-1, *v.shape[v.ndim - k :]).astype(dtype)
            for v, k in zip(program, events, strict=True)
        )
    )
    solution = jax.vmap(_solve_one)(lanes)
    return jax.tree.map(lambda v: v.reshape(*batch, *v.shape[1:]), solution)


def _pair(
    rows_name: str, rows: ArrayLike | None, side_name: str, side: ArrayLike | None, n: int, dtype: jnp.dtype
) -> tuple[jax.Array, jax.Array]:
    """A matrix of rows and its right-hand side, both or none."""
    if (rows is None) != (side is None):
        missing, given = (rows_name, side_name) if rows is None else (side_name, rows_name)
        raise ValueError(f"{missing}: got None with {given} given, wanted both or none")
    if rows is None or side is None:
        return jnp.zeros((0, n), dtype), jnp.zeros((0,), dtype)
    matrix = as_float(rows_name, rows, ("rows", n))
    return matrix, as_float(side_name, side, (matrix.shape[-2],))
