"""max lambda over small blocks with cone rows in many copies, by a homogeneous embedding.

With blocks x_i of three unknowns, a scalar lambda, and for every block the same rows in J copies,

    h - A x_i - sigma_ij lambda in K      for every block i and copy j = 1 .. J,
    sum_i E_i x_i + w lambda = b          (a few equality rows),

where K is a product of orthants and second-order cones. The embedding finds an optimum, or a certificate that there is
no admissible point, without an admissible or even strictly admissible point to start from. Copies only add up in the
3x3 matrices of the blocks, so a step costs O(n (J + 1)), whatever couples the copies.

Callers scale: |x| <= 1 at admissible points with lambda >= 0, rows of E orthonormal or zero, sigma or w about 1.

Source: Vandenberghe (2010), sections 4 and 7, in the homogeneous form of Andersen, Roos and Terlaky (2003).
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxgrasp.arrays import fold, literal
from jaxgrasp.fence import fenced, repeat
from jaxgrasp.solvers import cones
from jaxgrasp.solvers.block_kkt import inverse_root, spread_over
from jaxgrasp.solvers.cones import Scaling

Parts = tuple[jax.Array, ...]
_MAX_ITERATIONS = 60
_PATIENCE = 6
# Share of the way to the boundary.
_STEP = 0.98
# Steps of iterative refinement of every Newton direction.
_REFINEMENTS = 1
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
        return fold(jnp.add, spread_over(self._matrix().T, x) * x[:, None])[:, None]

    def adjoint(self, z: jax.Array) -> jax.Array:
        """A'z summed over copies: (d, J, n, *lanes) -> (3, n, *lanes)."""
        z = _along(jnp.add, jnp.moveaxis(z, 1, 0))
        pulled = fold(jnp.add, spread_over(self._matrix(), z) * z[:, None])
        return pulled if self.stretch is None else self.stretch * pulled

    def sides(self) -> jax.Array:
        """h, (d, 1, 1, *1)."""
        h = literal(np.array(self.h), self.sigma.dtype)
        return h.reshape(-1, *[1] * (self.sigma.ndim - 1))

    def gram(self, w: Scaling) -> list[jax.Array]:
        """The entries 00, 10, 11, 20, 21, 22 of A'W^-2 A summed over copies, (n, *lanes) each."""
        pairs = [(a, b) for a in range(3) for b in range(a + 1)]
        rows = np.array(self.patterns)
        if not self.second_order:
            weights = _along(jnp.add, jnp.moveaxis(1 / (w.point * w.point), 1, 0))
            table = literal(np.stack([rows[:, a] * rows[:, b] for a, b in pairs], 1), weights.dtype)
            entries = list(fold(jnp.add, spread_over(table, weights) * weights[:, None]))
        else:
            inverse = 1 / (w.size * w.size)
            turned = cones.reflected(w.point)
            v = fold(jnp.add, spread_over(self._matrix(), turned) * turned[:, None])
            signs = np.array([1.0] + [-1.0] * (rows.shape[0] - 1))
            bent = (rows * signs[:, None]).T @ rows
            total = _along(jnp.add, inverse)
            entries = [_along(jnp.add, 2 * inverse * v[a] * v[b]) - float(bent[a, b]) * total for a, b in pairs]
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
        return _over_blocks(self.columns * x) + self.border * lam

    def pull_back(self, y: jax.Array) -> jax.Array:
        """E'y."""
        return fold(jnp.add, self.columns * y[:, None, None])

    def apply(self, x: jax.Array, lam: jax.Array) -> Parts:
        """A x + sigma lambda."""
        return tuple(part.apply(x) + part.sigma * lam for part in self.rows)

    def adjoint(self, z: Parts) -> tuple[jax.Array, jax.Array]:
        """A'z and sigma'z."""
        pulled = fold(jnp.add, [part.adjoint(z_p) for part, z_p in zip(self.rows, z, strict=True)])
        return pulled, _inner([part.sigma for part in self.rows], z)

    def lagrangian(self, point: "ConicPoint") -> jax.Array:
        """What the rows and equalities lack, weighed by the multipliers, (*lanes).

        Its derivative with respect to the data, negated, is that of the optimum (envelope theorem).
        """
        lacking = [
            lhs - part.sides() for lhs, part in zip(self.apply(point.x, point.margin), self.rows, strict=True)
        ]
        return _inner(lacking, point.z) + fold(jnp.add, point.y * (self.equality(point.x, point.margin) - self.rhs))


class ConicPoint(NamedTuple):
    """x (3, n, *lanes), lambda (*lanes), and multipliers y (eq, *lanes) and z, parts (d, J, n, *lanes)."""

    x: jax.Array
    margin: jax.Array
    y: jax.Array
    z: Parts


class ConicOutcome(NamedTuple):
    """The best point; (*lanes) each.

    point: the best one found.
    upper: certified: no admissible point has a larger lambda (for lambda >= 0).
    error: of `point`, the largest of its residuals and its gap, relative.
    infeasible: bool, there is a certificate that no point is admissible.
    residual: how far `point` misses rows and equalities.
    iterations: steps taken.
    """

    point: ConicPoint
    upper: jax.Array
    error: jax.Array
    infeasible: jax.Array
    residual: jax.Array
    iterations: jax.Array


class _State(NamedTuple):
    x: jax.Array
    lam: jax.Array
    y: jax.Array
    s: Parts
    z: Parts
    tau: jax.Array
    kappa: jax.Array


class _Residuals(NamedTuple):
    x: jax.Array
    lam: jax.Array
    y: jax.Array
    rows: Parts
    tau: jax.Array


class _Factors(NamedTuple):
    lower: list[jax.Array]
    phi: jax.Array
    root: jax.Array
    v: jax.Array
    pivot: jax.Array


class _Carry(NamedTuple):
    state: _State
    residuals: _Residuals
    best: ConicOutcome
    stalled: jax.Array
    active: jax.Array
    step: jax.Array


def solve(problem: ConicMargin, tolerance: float, active: jax.Array) -> ConicOutcome:
    """Solve until every active lane is done; others are not touched.

    Args:
        problem: what to solve.
        tolerance: largest relative residual and gap.
        active: bool (*lanes).
    """
    lanes, dtype = problem.rhs.shape[1:], problem.rhs.dtype
    shapes = [part.sigma.shape for part in problem.rows]
    units = tuple(
        cones.identity_like(part.second_order, jnp.ones(shape, dtype))
        for part, shape in zip(problem.rows, shapes, strict=True)
    )
    one, zero = jnp.ones(lanes, dtype), jnp.zeros(lanes, dtype)
    x, y = jnp.zeros((*problem.columns.shape[1:3], *lanes), dtype), jnp.zeros_like(problem.rhs)
    state = _State(x, zero, y, units, units, one, one)
    degree = 1.0 + sum(
        float(np.prod(shape[1:3])) * (1 if part.second_order else shape[0])
        for part, shape in zip(problem.rows, shapes, strict=True)
    )
    best = ConicOutcome(
        ConicPoint(x, zero, y, tuple(jnp.zeros_like(u) for u in units)),
        jnp.full(lanes, jnp.inf, dtype),
        jnp.full(lanes, jnp.inf, dtype),
        jnp.zeros(lanes, bool),
        jnp.full(lanes, jnp.inf, dtype),
        jnp.zeros(lanes, jnp.int32),
    )

    def body(carry: _Carry) -> _Carry:
        stepped = _step(problem, carry.state, carry.residuals, units, degree)
        fine = carry.active & jnp.isfinite(_total(stepped))
        state = _where(fine, stepped, carry.state)
        residuals = _residuals(problem, state)
        found = _assessed(problem, state, residuals, carry.best, tolerance)
        better = found.error < 0.9 * carry.best.error
        found = found._replace(iterations=carry.best.iterations + 1)
        best = _where(carry.active, found, carry.best)
        stalled = jnp.where(better, 0, carry.stalled + 1)
        done = (best.error <= tolerance) | best.infeasible | (stalled >= _PATIENCE) | ~fine
        return _Carry(state, residuals, best, stalled, carry.active & ~done, carry.step + 1)

    first = _Carry(state, _residuals(problem, state), best, jnp.zeros(lanes, jnp.int32), active, jnp.zeros((), jnp.int32))
    return lax.while_loop(lambda c: (c.step < _MAX_ITERATIONS) & jnp.any(c.active), body, first).best


@fenced
def _assessed(
    problem: ConicMargin, state: _State, r: _Residuals, best: ConicOutcome, tolerance: float
) -> ConicOutcome:
    """The best point with this one taken into account."""
    inverse = 1 / state.tau
    primal = jnp.maximum(fold(jnp.maximum, jnp.abs(r.y)), _most([jnp.abs(v) for v in r.rows])) * inverse
    dual = jnp.maximum(fold(jnp.maximum, fold(jnp.maximum, jnp.abs(r.x))), jnp.abs(r.lam)) * inverse
    value = fold(jnp.add, problem.rhs * state.y) + _inner([part.sides() for part in problem.rows], state.z)
    lam, bound = state.lam * inverse, value * inverse
    error = jnp.maximum(jnp.maximum(primal, dual), jnp.abs(bound - lam) / jnp.maximum(1, jnp.abs(lam)))
    error = jnp.where(jnp.isfinite(error), error, jnp.inf)

    # h'z + b'y - (A'z + E'y)'x >= lambda (sigma'z + w'y) at every admissible point; |x|_inf <= 1 for lambda >= 0.
    lost = fold(jnp.add, fold(jnp.add, jnp.abs(r.x)))
    pull = r.lam + state.tau
    radius = 1 + 3 * jnp.maximum(0, -lam)
    upper = jnp.where(pull > 0, (value + radius * lost) / jnp.where(pull > 0, pull, 1), jnp.inf)
    # With nothing on the right, (y, z) excludes every x with |x|_inf <= 1, whatever lambda is.
    size = jnp.maximum(1e-30, -value)
    infeasible = (value < 0) & (lost + jnp.abs(pull) <= tolerance * size)

    better = error < best.error
    point = ConicPoint(state.x * inverse, lam, state.y * inverse, tuple(z * inverse for z in state.z))
    return best._replace(
        point=_where(better, point, best.point),
        error=jnp.where(better, error, best.error),
        residual=jnp.where(better, primal, best.residual),
        upper=jnp.minimum(best.upper, jnp.where(jnp.isfinite(upper), upper, jnp.inf)),
        infeasible=best.infeasible | infeasible,
    )


@fenced
def _residuals(problem: ConicMargin, state: _State) -> _Residuals:
    pulled, along = problem.adjoint(state.z)
    value = fold(jnp.add, problem.rhs * state.y) + _inner([part.sides() for part in problem.rows], state.z)
    lhs = problem.apply(state.x, state.lam)
    return _Residuals(
        x=pulled + problem.pull_back(state.y),
        lam=along + fold(jnp.add, problem.border * state.y) - state.tau,
        y=problem.rhs * state.tau - problem.equality(state.x, state.lam),
        rows=tuple(s + a - part.sides() * state.tau for s, a, part in zip(state.s, lhs, problem.rows, strict=True)),
        tau=state.kappa - state.lam + value,
    )


def _step(problem: ConicMargin, state: _State, residuals: _Residuals, units: Parts, degree: float) -> _State:
    """A predictor, a corrector, and a step along it.

    Directions are a solution for the residuals plus dtau times one for the constants (c, b, h): three solves, in a loop
    so that the program has each of them once.
    """
    kinds = [part.second_order for part in problem.rows]

    @fenced
    def scale(s: Parts, z: Parts) -> tuple:
        scalings = tuple(cones.scaling(kind, s_p, z_p) for kind, s_p, z_p in zip(kinds, s, z, strict=True))
        return scalings, (_inner(s, z) + state.tau * state.kappa) / degree

    scalings, mu = scale(state.s, state.z)
    factors = _factor(problem, scalings)

    @fenced
    def right_sides(i: jax.Array, remaining: jax.Array, aims: Parts) -> tuple:
        first = i == 0
        sides = tuple(
            jnp.where(first, -part.sides(), remaining * r + cones.stretch(w, a))
            for part, r, w, a in zip(problem.rows, residuals.rows, scalings, aims, strict=True)
        )
        rhs_lam = jnp.where(first, 1, -remaining * residuals.lam)
        return -remaining * residuals.x, rhs_lam, jnp.where(first, problem.rhs, remaining * residuals.y), sides

    @fenced
    def combine(own: tuple, constant: tuple, bend: jax.Array, remaining: jax.Array, aims: Parts, aim: jax.Array) -> tuple:
        _, _, y, z, _ = own
        value = fold(jnp.add, problem.rhs * y) + _inner([part.sides() for part in problem.rows], z)
        lacking = remaining * residuals.tau + aim / state.tau - own[1] + value
        dtau = lacking / (state.kappa / state.tau + bend)
        x, lam, y, z, rows = jax.tree.map(lambda a, c: a + dtau * c, own, constant)
        # From the rows, so that these are met whatever rounding does to W: lambda-wise it is aims - W dz.
        s = tuple(cones.stretch(w, a) - r for w, a, r in zip(scalings, aims, rows, strict=True))
        scaled = tuple(cones.stretch(w, d) for w, d in zip(scalings, z, strict=True))
        slack = tuple(cones.shrink(w, d) for w, d in zip(scalings, s, strict=True))
        dkappa = (aim - state.kappa * dtau) / state.tau
        over = [_most([cones.overshoot(w, d)]) for w, d in zip(scalings * 2, slack + scaled, strict=True)]
        over = fold(jnp.maximum, [*over, -dtau / state.tau, -dkappa / state.kappa])
        return _State(x, lam, y, s, z, dtau, dkappa), slack, scaled, over

    @fenced
    def correct(i: jax.Array, direction: _State, slack: Parts, scaled: Parts, over: jax.Array) -> tuple:
        """What the next direction aims at: lambda \\ d_s and d_kappa; after the constants, the boundary itself."""
        first = i == 0
        centring = jnp.where(first, 0, (1 - 1 / jnp.maximum(over, 1)) ** 3)
        second = jnp.where(first, 0, 1)
        aims = tuple(
            cones.quotient(w, centring * mu * e - second * cones.product(kind, a, b)) - w.value
            for kind, w, a, b, e in zip(kinds, scalings, slack, scaled, units, strict=True)
        )
        aim = centring * mu - state.tau * state.kappa - second * direction.tau * direction.kappa
        return 1 - centring, aims, aim

    def phase(i: jax.Array, carry: tuple) -> tuple:
        constant, bend, (remaining, aims, aim), _, _ = carry
        own = _newton(problem, scalings, factors, *right_sides(i, remaining, aims))
        constant = _where(i == 0, own, constant)
        # = lambda_1 - b'y_1 - h'z_1, without its cancellation.
        bend = jnp.where(i == 0, fenced(_inner)(own[4], own[3]), bend)
        direction, slack, scaled, over = combine(own, constant, bend, remaining, aims, aim)
        return constant, bend, correct(i, direction, slack, scaled, over), direction, over

    zero = jnp.zeros_like(state.lam)
    nothing = jax.tree.map(jnp.zeros_like, state)
    start = (nothing.x, zero, nothing.y, nothing.z, nothing.s), zero, (zero, nothing.s, zero), nothing, zero
    *_, direction, over = repeat(3, phase, start)

    @fenced
    def advance(state: _State, direction: _State, over: jax.Array) -> _State:
        alpha = _STEP / jnp.maximum(over, _STEP)
        return jax.tree.map(lambda a, d: a + alpha * d, state, direction)

    return advance(state, direction, over)


def _factor(problem: ConicMargin, scalings: tuple[Scaling, ...]) -> _Factors:
    """Eliminate blocks, then the equalities, then lambda."""

    @fenced
    def blocks(scalings: tuple[Scaling, ...]) -> tuple:
        grams = [part.gram(w) for part, w in zip(problem.rows, scalings, strict=True)]
        lower = _cholesky([fold(jnp.add, list(entries)) for entries in zip(*grams, strict=True)])
        sigma = tuple(part.sigma for part in problem.rows)
        weighed = tuple(cones.weigh(w, v) for w, v in zip(scalings, sigma, strict=True))
        return lower, _back(lower, problem.adjoint(weighed)[0])

    lower, phi = blocks(scalings)

    @fenced
    def equalities(lower: list[jax.Array], phi: jax.Array) -> tuple:
        reduced = _down(lower, jnp.moveaxis(problem.columns, 1, 0))
        matrix = jnp.stack([_over_blocks(jnp.swapaxes(reduced * reduced[:, r][:, None], 0, 1)) for r in range(len(problem.rhs))])
        eye = jnp.eye(len(problem.rhs), dtype=phi.dtype).reshape(*matrix.shape[:2], *[1] * (problem.rhs.ndim - 1))
        # What of sigma the blocks cannot make up for; as a difference of squares it would cancel.
        rest = [part.sigma - part.apply(phi) for part in problem.rows]
        lean = _inner(*[[cones.shrink(w, v) for w, v in zip(scalings, rest, strict=True)]] * 2)
        return matrix + eye * problem.dropped, problem.border - _over_blocks(problem.columns * phi), lean

    matrix, v, lean = equalities(lower, phi)
    root = inverse_root(matrix)
    half = fenced(_times)(root, v)
    pivot = lean + fold(jnp.add, half * half)
    return _Factors(lower, phi, root, v, pivot)


def _newton(
    problem: ConicMargin,
    scalings: tuple[Scaling, ...],
    factors: _Factors,
    rhs_x: jax.Array,
    rhs_lam: jax.Array,
    rhs_y: jax.Array,
    sides: Parts,
) -> tuple:
    """(x, lambda, y, z) and the rows r = A x + sigma lambda + sides, with z = W^-2 r and

    A'z + E'y = rhs_x, sigma'z + w'y = rhs_lam, E x + w lambda = rhs_y.
    """

    @fenced
    def reduce(rhs_x: jax.Array, rhs_lam: jax.Array, sides: Parts) -> tuple:
        pulled, along = problem.adjoint(tuple(cones.weigh(w, u) for w, u in zip(scalings, sides, strict=True)))
        return rhs_x - pulled, rhs_lam - along

    @fenced
    def eliminate(right: jax.Array, right_lam: jax.Array, rhs_y: jax.Array) -> tuple:
        first = _back(factors.lower, right)
        half = _times(factors.root, _over_blocks(problem.columns * first) - rhs_y)
        across = _times(factors.root, factors.v)
        lam = right_lam - fold(jnp.add, fold(jnp.add, factors.phi * right)) - fold(jnp.add, across * half)
        lam = lam / jnp.maximum(factors.pivot, jnp.finfo(lam.dtype).tiny)
        y = fold(jnp.add, factors.root * (half + across * lam)[:, None])
        x = first - factors.phi * lam - _back(factors.lower, problem.pull_back(y))
        return x, lam, y

    @fenced
    def rows(x: jax.Array, lam: jax.Array, sides: Parts) -> tuple:
        lhs = tuple(a + u for a, u in zip(problem.apply(x, lam), sides, strict=True))
        return lhs, tuple(cones.weigh(w, v) for w, v in zip(scalings, lhs, strict=True))

    @fenced
    def lacking(x: jax.Array, lam: jax.Array, y: jax.Array, z: Parts) -> tuple:
        pulled, along = problem.adjoint(z)
        own_lam = rhs_lam - along - fold(jnp.add, problem.border * y)
        return rhs_x - pulled - problem.pull_back(y), own_lam, rhs_y - problem.equality(x, lam)

    def improve(_: jax.Array, carry: tuple) -> tuple:
        (x, lam, y), right, lhs, z, sides = carry
        more = eliminate(*right)
        more_lhs, more_z = rows(more[0], more[1], sides)
        x, lam, y, lhs, z = jax.tree.map(jnp.add, (x, lam, y, lhs, z), (*more, more_lhs, more_z))
        return (x, lam, y), lacking(x, lam, y, z), lhs, z, jax.tree.map(jnp.zeros_like, sides)

    nothing = jnp.zeros_like(rhs_x), jnp.zeros_like(rhs_lam), jnp.zeros_like(rhs_y)
    none = jax.tree.map(jnp.zeros_like, sides)
    start = nothing, (*reduce(rhs_x, rhs_lam, sides), rhs_y), none, none, sides
    (x, lam, y), _, lhs, z, _ = repeat(1 + _REFINEMENTS, improve, start)
    return x, lam, y, z, lhs


def _cholesky(entries: list[jax.Array]) -> list[jax.Array]:
    """1/L00, L10, 1/L11, L20, L21, 1/L22 of a 3x3 matrix given by 00, 10, 11, 20, 21, 22; pivots are clamped."""
    a00, a10, a11, a20, a21, a22 = entries
    eps = jnp.finfo(a00.dtype).eps
    pivot = lambda value, diagonal: lax.rsqrt(jnp.maximum(value, eps * diagonal))  # noqa: E731
    i0 = pivot(a00, a00)
    l10, l20 = a10 * i0, a20 * i0
    i1 = pivot(a11 - l10 * l10, a11)
    l21 = (a21 - l20 * l10) * i1
    return [i0, l10, i1, l20, l21, pivot(a22 - l20 * l20 - l21 * l21, a22)]


def _down(lower: list[jax.Array], rhs: jax.Array) -> jax.Array:
    """L^-1 rhs, (3, ..., n, *lanes)."""
    i0, l10, i1, l20, l21, i2 = lower
    a = rhs[0] * i0
    b = (rhs[1] - l10 * a) * i1
    return jnp.stack([a, b, (rhs[2] - l20 * a - l21 * b) * i2])


def _back(lower: list[jax.Array], rhs: jax.Array) -> jax.Array:
    """(L L')^-1 rhs, (3, n, *lanes)."""
    i0, l10, i1, l20, l21, i2 = lower
    a, b, c = _down(lower, rhs)
    c = c * i2
    b = (b - l21 * c) * i1
    return jnp.stack([(a - l10 * b - l20 * c) * i0, b, c])


def _times(matrix: jax.Array, v: jax.Array) -> jax.Array:
    return fold(jnp.add, jnp.swapaxes(matrix, 0, 1) * v[:, None])


def _over_blocks(x: jax.Array) -> jax.Array:
    """Sum over components and blocks, (eq, 3, n, *lanes) -> (eq, *lanes)."""
    return fold(jnp.add, jnp.moveaxis(fold(jnp.add, jnp.moveaxis(x, 1, 0)), 1, 0))


def _inner(a: Parts | list[jax.Array], b: Parts | list[jax.Array]) -> jax.Array:
    """Inner product of parts, (*lanes)."""
    return fold(jnp.add, [_reduce(jnp.add, u * v) for u, v in zip(a, b, strict=True)])


def _most(parts: Parts | list[jax.Array]) -> jax.Array:
    return fold(jnp.maximum, [_reduce(jnp.maximum, v) for v in parts])


def _reduce(op: jnp.ufunc, v: jax.Array) -> jax.Array:
    """Over rows, copies and blocks, (d, J, n, *lanes) -> (*lanes)."""
    for _ in range(3):
        v = _along(op, v)
    return v


def _along(op: jnp.ufunc, v: jax.Array) -> jax.Array:
    """Reduce the leading axis; spelt out while it is short, see `fold`."""
    return fold(op, v) if v.shape[0] <= _SPELT_OUT else op.reduce(v, axis=0)


def _total(state: _State) -> jax.Array:
    """Sum of everything, (*lanes): not finite where anything is not."""
    sums = [fold(jnp.add, fold(jnp.add, state.x)), state.lam, fold(jnp.add, state.y), state.tau, state.kappa]
    return fold(jnp.add, [*sums, *(_reduce(jnp.add, v) for v in (*state.s, *state.z))])


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda n, o: jnp.where(mask, n, o), new, old)
