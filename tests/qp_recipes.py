"""Random quadratic and linear programs by published recipes, each with what its answer must be.

Sources: the generators of ProxQP (strongly convex, not strongly convex, degenerate, box-constrained; two-sided rows are
written as two one-sided ones), random linear programs built around a known optimum, and the infeasible and unbounded
programs of QTQP's tests, whose certificates are known by construction.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

DENSITY = 0.15
CONVEXITY = 1e-2


@dataclass(frozen=True, kw_only=True)
class Program:
    """min 1/2 x'Px + q'x, Ax = b, Gx <= h, and its answer: "solved", "infeasible" or "unbounded"."""

    P: np.ndarray
    q: np.ndarray
    A: np.ndarray
    b: np.ndarray
    G: np.ndarray
    h: np.ndarray
    answer: str = "solved"
    optimum: float | None = None

    @property
    def data(self) -> tuple[np.ndarray, ...]:
        return self.P, self.q, self.A, self.b, self.G, self.h


def _sparse(rng, rows, columns):
    return rng.standard_normal((rows, columns)) * (rng.random((rows, columns)) < DENSITY)


def _sparse_convex(rng, n, convexity):
    entries = rng.standard_normal((n, n)) * (rng.random((n, n)) < DENSITY / 2)
    P = (entries + entries.T) / 2
    return P + (convexity + abs(np.linalg.eigvalsh(P)[0])) * np.eye(n)


def _orthogonal_to(rows, direction):
    return rows - np.outer(rows @ direction, direction) / (direction @ direction)


def strongly_convex(rng, n, n_eq, n_ineq):
    P, q = _sparse_convex(rng, n, CONVEXITY), rng.standard_normal(n)
    A, G, x = _sparse(rng, n_eq, n), _sparse(rng, n_ineq, n), rng.standard_normal(n)
    return Program(P=P, q=q, A=A, b=A @ x, G=G, h=G @ x + rng.random(n_ineq))


def not_strongly_convex(rng, n, n_eq, n_ineq):
    P, half = _sparse_convex(rng, n, 0.0), n_ineq // 2
    A, G, x = _sparse(rng, n_eq, n), _sparse(rng, half, n), rng.standard_normal(n)
    y, z, slack = rng.standard_normal(n_eq), rng.standard_normal(half), rng.random(half)
    q = -(P @ x + A.T @ y + G.T @ z)
    return Program(P=P, q=q, A=A, b=A @ x, G=np.vstack([G, -G]), h=np.concatenate([G @ x + slack, slack - G @ x]))


def degenerate(rng, n, n_eq, n_ineq):
    """Every inequality stands twice, with different right-hand sides."""
    P, q = _sparse_convex(rng, n, CONVEXITY), rng.standard_normal(n)
    half = n_ineq // 2
    A, G, x = _sparse(rng, n_eq, n), _sparse(rng, half, n), rng.standard_normal(n)
    G = np.vstack([G, G])
    return Program(P=P, q=q, A=A, b=A @ x, G=G, h=G @ x + rng.random(2 * half))


def duplicated_rows(rng, n, n_eq, n_ineq):
    """Every row stands twice, with the same right-hand side: rank-deficient equalities and non-unique multipliers."""
    half = strongly_convex(rng, n, max(n_eq // 2, 1), n_ineq // 2)
    A, b, G, h = (np.concatenate([half_rows, half_rows]) for half_rows in (half.A, half.b, half.G, half.h))
    return Program(P=half.P, q=half.q, A=A, b=b, G=G, h=h)


def box(rng, n, n_eq, n_ineq):
    P, q = _sparse_convex(rng, n, CONVEXITY), rng.standard_normal(n)
    A, x, slack = _sparse(rng, n_eq, n), rng.standard_normal(n), rng.random(n)
    return Program(
        P=P, q=q, A=A, b=A @ x, G=np.vstack([np.eye(n), -np.eye(n)]), h=np.concatenate([x + slack, slack - x])
    )


def feasible_sparse(rng, n, n_eq, n_ineq):
    """QTQP's feasible program: strictly complementary, P of low rank."""
    split, x, y = rng.standard_normal(n_ineq), rng.standard_normal(n), rng.standard_normal(n_eq)
    s, z = np.maximum(-split, 0), np.maximum(split, 0)
    A, G = _sparse(rng, n_eq, n), _sparse(rng, n_ineq, n)
    factor = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.01)
    P = 0.01 * factor.T @ factor
    return Program(P=P, q=-A.T @ y - G.T @ z - P @ x, A=A, b=A @ x, G=G, h=G @ x + s)


def linear(rng, n, n_eq, n_ineq):
    """A linear program with a known optimum: n - n_eq rows active with positive multipliers, the others slack."""
    A, G, x = rng.standard_normal((n_eq, n)), rng.standard_normal((n_ineq, n)), rng.standard_normal(n)
    active = np.arange(n_ineq) < n - n_eq
    s, z = np.where(active, 0, rng.random(n_ineq)), np.where(active, rng.random(n_ineq), 0)
    q = -A.T @ rng.standard_normal(n_eq) - G.T @ z
    return Program(P=np.zeros((n, n)), q=q, A=A, b=A @ x, G=G, h=G @ x + s, optimum=float(q @ x))


def degenerate_linear(rng, n, n_eq, n_ineq):
    """As `linear`, but twice as many rows meet in the optimum as a vertex needs, and few multipliers are positive."""
    A, G, x = rng.standard_normal((n_eq, n)), rng.standard_normal((n_ineq, n)), rng.standard_normal(n)
    order = np.arange(n_ineq)
    s = np.where(order < 2 * (n - n_eq), 0, rng.random(n_ineq))
    z = np.where(order < (n - n_eq) // 2, rng.random(n_ineq), 0)
    q = -A.T @ rng.standard_normal(n_eq) - G.T @ z
    return Program(P=np.zeros((n, n)), q=q, A=A, b=A @ x, G=G, h=G @ x + s, optimum=float(q @ x))


def infeasible(rng, n, n_eq, n_ineq):
    """(y, z) with z >= 0, A'y + G'z = 0 and b'y + h'z = -1 exists."""
    multipliers, right = rng.random(n_eq + n_ineq), rng.standard_normal(n_eq + n_ineq)
    rows = _orthogonal_to(rng.standard_normal((n_eq + n_ineq, n)).T, multipliers).T
    right = -right / (right @ multipliers)
    factor = rng.standard_normal((n, n))
    A, G, b, h = rows[:n_eq], rows[n_eq:], right[:n_eq], right[n_eq:]
    return Program(P=0.01 * factor.T @ factor, q=rng.standard_normal(n), A=A, b=b, G=G, h=h, answer="infeasible")


def infeasible_linear(rng, n, n_eq, n_ineq):
    """As `infeasible`, with P = 0 and a cost that some multipliers balance, so that it is not unbounded as well."""
    base = infeasible(rng, n, n_eq, n_ineq)
    q = -base.A.T @ rng.standard_normal(n_eq) - base.G.T @ rng.random(n_ineq)
    return Program(P=np.zeros((n, n)), q=q, A=base.A, b=base.b, G=base.G, h=base.h, answer="infeasible")


def unbounded(rng, n, n_eq, n_ineq):
    """A ray x with Px = 0, Ax = 0, Gx <= 0 and q'x = -1 exists, and the program is feasible."""
    factor, ray, q = rng.standard_normal((n, n)), rng.standard_normal(n), rng.standard_normal(n)
    factor = _orthogonal_to(factor, ray)
    slope = np.concatenate([np.zeros(n_eq), rng.random(n_ineq)])
    rows = _orthogonal_to(rng.standard_normal((n_eq + n_ineq, n)), ray) - np.outer(slope, ray) / (ray @ ray)
    right = rng.standard_normal(n_eq + n_ineq)
    A, G, b, h = rows[:n_eq], rows[n_eq:], right[:n_eq], right[n_eq:]
    return Program(P=0.01 * factor.T @ factor, q=-q / (q @ ray), A=A, b=b, G=G, h=h, answer="unbounded")


def unbounded_linear(rng, n, n_eq, n_ineq):
    base = unbounded(rng, n, n_eq, n_ineq)
    return Program(P=np.zeros((n, n)), q=base.q, A=base.A, b=base.b, G=base.G, h=base.h, answer="unbounded")


RECIPES: dict[str, Callable[..., Program]] = {
    recipe.__name__: recipe
    for recipe in (
        strongly_convex,
        not_strongly_convex,
        degenerate,
        duplicated_rows,
        box,
        feasible_sparse,
        linear,
        degenerate_linear,
        infeasible,
        infeasible_linear,
        unbounded,
        unbounded_linear,
    )
}

# (variables, equalities, inequalities), with room for the rows of the recipes that pair them
SIZES = ((4, 2, 8), (10, 2, 30), (20, 5, 60), (40, 10, 120), (60, 14, 236))


def batch(recipe: str, size: tuple[int, int, int], count: int, seed: int = 0) -> list[Program]:
    """`count` programs of one recipe and size; the same call always gives the same programs."""
    key = [seed, list(RECIPES).index(recipe), *size]
    return [RECIPES[recipe](np.random.default_rng([*key, lane]), *size) for lane in range(count)]


def stacked(programs: list[Program], size: tuple[int, int, int]) -> tuple[np.ndarray, ...]:
    """P, q, A, b, G, h with a leading lane axis, padded to `size` by rows 0 x = 0 and 0 x <= 1: one compilation."""

    def pad(rows, right, count, fill):
        missing = count - len(right)
        return np.pad(rows, ((0, missing), (0, 0))), np.pad(right, (0, missing), constant_values=fill)

    lanes = [(p.P, p.q, *pad(p.A, p.b, size[1], 0.0), *pad(p.G, p.h, size[2], 1.0)) for p in programs]
    return tuple(np.stack(field) for field in zip(*lanes, strict=True))


def error(solution, data: list[np.ndarray] | tuple[np.ndarray, ...]) -> float:
    """What an answer lacks, by NumPy alone: the KKT conditions, Farkas's alternative, or those of a ray of descent.

    Residuals, negative slacks and negative multipliers are absolute, the gap is relative to max(1, |objective|).
    Certificates are scaled to b'y + h'z = -1 and q'x = -1. Infinite for other statuses.
    """
    P, q, A, b, G, h = (np.asarray(v, float) for v in data)
    P = (P + P.T) / 2
    x, s, y, z = (np.asarray(v, float) for v in (solution.x, solution.s, solution.y, solution.z))
    status = int(solution.status)
    if status == 0:
        objective = x @ P @ x / 2 + q @ x
        gap = (x @ P @ x + q @ x + b @ y + h @ z) / max(1.0, abs(objective))
        faults = [A @ x - b, G @ x - h + s, P @ x + q + A.T @ y + G.T @ z, np.minimum(s, 0), np.minimum(z, 0), gap]
    elif status == 1:
        faults = [A.T @ y + G.T @ z, np.minimum(z, 0), b @ y + h @ z + 1]
    elif status == 2:
        faults = [P @ x, A @ x, np.maximum(G @ x, 0), q @ x + 1]
    else:
        return np.inf
    return max(float(np.max(np.abs(fault), initial=0.0)) for fault in faults)
