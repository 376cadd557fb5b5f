"""Quadratic and linear programs of any small dense data, in batch, with certificates where there is no solution."""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from jaxgrasp import linalg
from jaxgrasp.arrays import as_float, broadcast_batch
from jaxgrasp.compiling import compiled
from jaxgrasp.lanes.independent import one_lane, with_automatic_axes
from jaxgrasp.records import record
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.dense.embedding import CONSTANTS, HomogeneousEmbedding, QuadraticProgram, largest
from jaxgrasp.solvers.dense.sensitivity import solution_of, value_at
from jaxgrasp.solvers.interior_point import Iterate, Settings
from jaxgrasp.solvers.status import Status

_EQUILIBRATIONS = 10
_MAX_ITERATIONS = 60
# Steps without progress at the start, while tau finds its size, are common.
_PATIENCE = 8
# A side larger than this, in units of the others, counts as far away.
_FAR = 1e3
# Sides at least this large count as infinite, as in other solvers and in their files.
_INFINITE = 1e20


@record
class QPSolution:
    """The result of `solve_qp`; every field has the leading axes of the batch.

    Where a field has no meaning for the status it is NaN, or infinite for `objective` and the residuals.
    """

    x: jax.Array
    """(*batch, n): the minimiser; if UNBOUNDED a ray with q'x = -1, Px = 0, Ax = 0 and Gx <= 0."""
    s: jax.Array
    """(*batch, m): slacks h - Gx >= 0, inf where h is infinite; if UNBOUNDED those of the ray, -Gx."""
    y: jax.Array
    """(*batch, p): multipliers of Ax = b; if INFEASIBLE part of a certificate (y, z): A'y + G'z = 0, b'y + h'z = -1."""
    z: jax.Array
    """(*batch, m): multipliers of Gx <= h, z >= 0, 0 where h is infinite; if INFEASIBLE part of that certificate, which
    is NaN where a side is -inf."""
    objective: jax.Array
    """(*batch,): 1/2 x'Px + q'x; inf if INFEASIBLE, -inf if UNBOUNDED."""
    status: jax.Array
    """(*batch,): integers of `Status`; MAX_ITERATIONS where the best point found is not good enough."""
    primal_residual: jax.Array
    """(*batch,): max |Ax - b|, |Gx + s - h|; of the ray, max |Px|, |Ax|, |Gx + s|."""
    dual_residual: jax.Array
    """(*batch,): max |Px + q + A'y + G'z|; of the certificate r = max |A'y + G'z|: |x|_1 < 1/r is infeasible."""
    gap: jax.Array
    """(*batch,): |x'Px + q'x + b'y + h'z|."""
    iterations: jax.Array
    """(*batch,): steps taken."""


def _typical(v: jax.Array) -> jax.Array:
    """Compute the geometric mean of the nonzero entries, which a few huge ones hardly move; 1 if there are none."""
    nonzero = v != 0
    logs = jnp.where(nonzero, jnp.log(jnp.abs(jnp.where(nonzero, v, 1))), 0)
    return jnp.exp(jnp.sum(logs) / jnp.maximum(jnp.sum(nonzero, dtype=v.dtype), 1))


def _equilibrate(program: QuadraticProgram) -> tuple[QuadraticProgram, Iterate]:
    """Scale a program by Ruiz's method: rows and columns of the KKT matrix of largest entry 1, q, b and h of order 1.

    Returns:
        The scaled program, and the factors that turn its x, y, s and z into those of the program.
    """
    # The scale changes the path to the solution, not the solution: derivatives take it as constant.
    P, q, A, b, G, h = lax.stop_gradient(program)
    (p, n), m = A.shape, h.size
    rows = jnp.concatenate([A, G])
    matrix = jnp.block([[P, rows.T], [rows, jnp.zeros((p + m, p + m), P.dtype)]])

    def equilibrate(_: int, scale: jax.Array) -> jax.Array:
        largest = jnp.max(jnp.abs(matrix) * scale * scale[:, None], 1)
        return scale / jnp.sqrt(jnp.where(largest > 0, largest, 1))

    scale = lax.fori_loop(0, _EQUILIBRATIONS, equilibrate, jnp.ones_like(matrix, shape=n + p + m))
    d, e, f = scale[:n], scale[n : n + p], scale[n + p :]

    # A side that is far away, like 1e12 for none, tells nothing about the size of x, but residuals are relative to the
    # sides: its row is divided until it is no longer far.
    sides = jnp.concatenate([b * e, h * f])
    usual = _typical(jnp.where(jnp.abs(sides) <= _FAR * _typical(sides), sides, 0))
    f = f / jnp.maximum(1, h * f / (_FAR * usual))
    cost, size = 1 / _typical(q * d), 1 / usual
    P, q, A, b, G, h = program
    scaled = QuadraticProgram(
        P * d * d[:, None] * (cost / size),
        q * d * cost,
        A * d * e[:, None],
        b * e * size,
        G * d * f[:, None],
        h * f * size,
    )
    return scaled, Iterate(d / size, e / cost, 1 / (f * size), f / cost)


def _solve_one(program: QuadraticProgram) -> QPSolution:
    """Solve the program of one lane."""
    # Check the data: infinite sides, numbers that are not finite, P that is not positive semidefinite.
    constants = CONSTANTS[program.q.dtype.name]
    absent, impossible = program.h >= _INFINITE, jnp.any(program.h <= -_INFINITE)
    program = _replace_rows(program, jnp.abs(program.h) >= _INFINITE)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in program]))
    P = (program.P + program.P.T) / 2
    # Rounding in the caller's P may leave it that far from positive semidefinite.
    slack = 16 * P.shape[0] * jnp.finfo(P.dtype).eps * jnp.where(jnp.any(P != 0), largest(P), 1)
    shifted = jnp.where(finite, P / slack, 0) + jnp.eye(P.shape[0], dtype=P.dtype)
    valid = finite & jnp.all(jnp.isfinite(linalg.cholesky(shifted)))
    program = QuadraticProgram(*(jnp.where(valid, v, 0) for v in program._replace(P=P)))

    # Run the loop on the equilibrated program, as constants to the derivative.
    scaled, back = _equilibrate(program)
    settings = Settings(
        constants.tolerance, _MAX_ITERATIONS, constants.step_cap, constants.mu_floor, True, 0.0, _PATIENCE
    )
    loop = lambda valid, scaled: interior_point.solve(HomogeneousEmbedding(scaled, constants), settings, valid)
    outcome = one_lane(loop, valid & ~impossible, lax.stop_gradient(scaled))
    record, iterate = outcome.record, outcome.record.iterate
    proven = jnp.where(record.error <= constants.accept, record.status, int(Status.MAX_ITERATIONS))
    status = jnp.where(valid, jnp.where(impossible, int(Status.INFEASIBLE), proven), int(Status.INVALID_INPUT))

    # Back to the caller's units: without derivatives for the certificates, with them for the solution.
    tau, iterate = iterate.z[-1], iterate._replace(s=iterate.s[:-1], z=jnp.where(absent, 0, iterate.z[:-1]))
    unscale = lambda iterate: Iterate(*map(jnp.multiply, iterate, back))
    solution = _make_solution(lax.stop_gradient(program), unscale(iterate), tau, status, outcome.iterations)
    solved = status == Status.SOLVED
    point = unscale(solution_of(scaled, Iterate(*(v / tau for v in iterate)), solved))
    fields = {name: jnp.where(solved, v, getattr(solution, name)) for name, v in point._asdict().items()}
    objective = value_at(program, point, solution.objective, solved)
    solution = replace(solution, objective=objective, **fields)

    # Rows with infinite sides: +inf has an infinite slack and no multiplier, -inf leaves no certificate.
    nan_where_impossible = lambda v: jnp.where(impossible, jnp.nan, v)
    return replace(
        solution,
        s=jnp.where(absent & ~jnp.isnan(solution.s), jnp.inf, solution.s),
        y=nan_where_impossible(solution.y),
        z=nan_where_impossible(jnp.where(absent & ~jnp.isnan(solution.z), 0, solution.z)),
        dual_residual=jnp.where(impossible, jnp.inf, solution.dual_residual),
    )


def _replace_rows(program: QuadraticProgram, absent: jax.Array) -> QuadraticProgram:
    """Put rows 0 x <= 1 in the place of absent ones; the 1 is as large as the other sides are."""
    G, h = jnp.where(absent[:, None], 0, program.G), jnp.where(absent, 0, program.h)
    size = _typical(lax.stop_gradient(jnp.concatenate([program.b, h])))
    return program._replace(G=G, h=jnp.where(absent, size, h))


def _make_solution(
    program: QuadraticProgram, iterate: Iterate, tau: jax.Array, status: jax.Array, iterations: jax.Array
) -> QPSolution:
    """Divide the iterate by tau, or scale it to a certificate, and compute residuals in the caller's units."""
    P, q, A, b, G, h = program
    infeasible, ray, valid = status == Status.INFEASIBLE, status == Status.UNBOUNDED, status != Status.INVALID_INPUT
    has_point = ~infeasible & ~ray & valid

    # Scale a certificate to b'y + h'z = -1 and a ray to q'x = -1; neither changes the numbers of the other.
    x, s = (v / jnp.where(ray, -q @ iterate.x, tau) for v in (iterate.x, iterate.s))
    y, z = (v / jnp.where(infeasible, -b @ iterate.y - h @ iterate.z, tau) for v in (iterate.y, iterate.z))

    # Residuals, whose right-hand sides are zero for rays (b, h) and certificates (q).
    Px, pull = P @ x, A.T @ y + G.T @ z
    primal = jnp.maximum(largest(A @ x - jnp.where(ray, 0, b)), largest(G @ x + s - jnp.where(ray, 0, h)))
    dual = largest(jnp.where(infeasible, 0, Px + q) + pull)
    infinite = jnp.asarray(jnp.inf, q.dtype)
    value = jnp.where(infeasible, infinite, jnp.where(ray, -infinite, x @ Px / 2 + q @ x))
    with_x, with_y = valid & ~infeasible, valid & ~ray
    return QPSolution(
        x=jnp.where(with_x, x, jnp.nan),
        s=jnp.where(with_x, s, jnp.nan),
        y=jnp.where(with_y, y, jnp.nan),
        z=jnp.where(with_y, z, jnp.nan),
        objective=jnp.where(valid, value, jnp.nan),
        status=status,
        primal_residual=jnp.where(with_x, jnp.where(ray, jnp.maximum(primal, largest(Px)), primal), infinite),
        dual_residual=jnp.where(with_y, dual, infinite),
        gap=jnp.where(has_point, jnp.abs(x @ Px + q @ x + b @ y + h @ z), infinite),
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

    Minimises 1/2 x'Px + q'x over A x = b and G x <= h. Rows may be dependent, duplicated or zero (rows 0 x = 0 and
    0 x <= 1 pad ragged batches). A step costs O((m + n) n^2).

    Sides of h may be infinite, and 1e20 counts as infinite, like everything beyond: a row with +inf is no row, one with
    -inf cannot be met. So l <= G x <= u with any sides infinite is G = [G; -G] and h = [u; -l].

    Differentiable in all data, forward and reverse and repeatedly, at the cost of about one more step: x, s, y, z and
    objective by the implicit function theorem, see `sensitivity`. The derivatives of objective hold wherever there is a
    solution. Those of x, s, y and z hold where it is unique and strictly complementary; elsewhere they are finite, but
    mean nothing for an x, s, y or z that is not unique. Lanes that are not SOLVED, residuals, gap and status have
    derivatives that are exactly zero.

    Args:
        P: (*batch, n, n), positive semidefinite; only its symmetric part counts. None: a linear program.
        q: (*batch, n).
        A: (*batch, p, n), or None with b.
        b: (*batch, p).
        G: (*batch, m, n), or None with h.
        h: (*batch, m); may be infinite.

    Returns:
        A `QPSolution`. The leading axes of all arguments broadcast.

    Raises:
        ValueError: shapes that do not fit, one of a pair missing, or a dtype other than real numbers (tracing time).

    Status:
        SOLVED where every residual is below 1e-7 (float32: 5e-5) of 1 plus its own terms, in equilibrated units;
        INFEASIBLE and UNBOUNDED with a certificate as exact as that; MAX_ITERATIONS with the best point otherwise;
        INVALID_INPUT for data that are NaN or, but for h, infinite, or P that is not positive semidefinite.
    """
    q = as_float("q", q, ("n",))
    n = q.shape[-1]
    P = jnp.zeros((n, n), q.dtype) if P is None else as_float("P", P, (n, n))
    rows = [*_pair("A", A, "b", b, n, q.dtype), *_pair("G", G, "h", h, n, q.dtype)]
    dtype = jnp.result_type(P, q, *rows)
    if dtype.name not in CONSTANTS:
        raise ValueError(f"P, q, A, b, G, h: got dtype {dtype.name} together, wanted float32 or float64")
    program = QuadraticProgram(P, q, *rows)
    events = (2, 1, 2, 1, 2, 1)
    shapes = {name: v.shape[: v.ndim - k] for name, v, k in zip(QuadraticProgram._fields, program, events, strict=True)}
    batch = broadcast_batch(**shapes)
    # Data that all lanes share stay without a batch: XLA would fold computations on a batch of zeros while it compiles,
    # for seconds.
    shared = [bool(batch) and v.ndim == k for v, k in zip(program, events, strict=True)]
    lanes = [
        v.astype(dtype)
        if is_shared
        else jnp.broadcast_to(v, (*batch, *v.shape[v.ndim - k :]))
        .reshape(math.prod(batch), *v.shape[v.ndim - k :])
        .astype(dtype)
        for v, k, is_shared in zip(program, events, shared, strict=True)
    ]
    return _solve_lanes(tuple(shared), batch, QuadraticProgram(*lanes))


@partial(compiled, static_argnums=(0, 1))
def _solve_lanes(shared: tuple[bool, ...], batch: tuple[int, ...], lanes: QuadraticProgram) -> QPSolution:
    """Solve all lanes; `shared` tells for every field of the program whether all lanes share it."""
    solve = jax.vmap(lambda *data: _solve_one(QuadraticProgram(*data)), in_axes=tuple(None if s else 0 for s in shared))
    solution = with_automatic_axes(solve, lanes, shared)
    return jax.tree.map(lambda v: v.reshape(*batch, *v.shape[1:]), solution)


def _pair(
    rows_name: str, rows: ArrayLike | None, side_name: str, side: ArrayLike | None, n: int, dtype: jnp.dtype
) -> tuple[jax.Array, jax.Array]:
    """Check a matrix of rows and its right-hand side; both may be None, for no rows."""
    if (rows is None) != (side is None):
        missing, present = (rows_name, side_name) if rows is None else (side_name, rows_name)
        raise ValueError(f"{missing}: got None with {present} given, wanted both or none")
    if rows is None or side is None:
        return jnp.zeros((0, n), dtype), jnp.zeros((0,), dtype)
    matrix = as_float(rows_name, rows, ("rows", n))
    return matrix, as_float(side_name, side, (matrix.shape[-2],))
