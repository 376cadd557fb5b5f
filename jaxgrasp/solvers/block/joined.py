"""Equality rows that tie the blocks of one group, forces, to those of another one, efforts of one unknown each.

    E = [ W  0 ]      W, and B, with orthonormal rows, or zeros,
        [ T -B ]      T f = B u, for every force an effort that answers it.

The rows together are not orthonormal. A point is brought onto E x = b by its forces first, then by the efforts that
answer these: with a gap g = b - E x,

    df = W'g_W,    du = B'(T df - g_T),

and the y with E'y = p, if there is one, is the transpose of that, applied to p.

Such programs are large: a hand has tens of joints and efforts. So blocks are worked on in turn, a few at a time: then
neither code nor what is kept of it grows with their number. The efforts do not reach the rows W.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxgrasp.arrays import fold
from jaxgrasp.lanes.fence import in_turn
from jaxgrasp.solvers.block.factors import BlockFactor
from jaxgrasp.solvers.small_matrices import lower_places, substitute_down, substitute_up

Tree = Any
# How many blocks of one unknown are worked on at a time.
_TOGETHER = 5


@dataclass(frozen=True)
class Joined:
    """The operations of `kkt` with the rows E.

    above: the number of rows W.
    """

    above: int

    def restore(self, groups: Any, gap: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Find the change (df, du) that closes a gap b - E x, (eq, *lanes)."""
        forces, efforts = groups
        change = _pull_back(forces, slice(0, self.above), gap[: self.above])
        lacking = gap[self.above :] - _products(forces, slice(self.above, None), change)
        return change, _pull_back(efforts, slice(self.above, None), lacking)

    def multipliers(self, groups: Any, pull: tuple[jax.Array, ...]) -> jax.Array:
        """Find the y with E'y = pull, (eq, *lanes), if there is one."""
        torques = _products(groups[1], slice(self.above, None), pull[1])
        rest = pull[0] - _pull_back(groups[0], slice(self.above, None), torques)
        return jnp.concatenate([_products(groups[0], slice(0, self.above), rest), torques])

    def equality(self, groups: Any, x: tuple[jax.Array, ...]) -> jax.Array:
        """Compute E x, (eq, *lanes)."""
        joints = slice(self.above, None)
        return _joined(_products(groups[0], slice(None), x[0]), _products(groups[1], joints, x[1]))

    def pull_back(self, groups: Any, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Compute E'y, (k, n, *lanes) a group."""
        joints = slice(self.above, None)
        return _pull_back(groups[0], slice(None), y), _pull_back(groups[1], joints, y[joints])

    def eliminate(self, problem: Any, weights: tuple) -> tuple:
        """Eliminate the blocks of both groups for weights z/s.

        Returns:
            The factors of both groups (L^-1 E' of the efforts without the rows W), E P^-1 E', and v and kappa where
            lambda is free, else None twice.
        """
        eq, above = problem.rhs.shape[0], self.above
        forces, efforts = problem.groups
        of_forces, (triangle, v, kappa) = _factor(problem, forces, weights[0], 0)
        of_efforts, (more, more_v, more_kappa) = _factor(problem, efforts, weights[1], above)
        # The lower triangles, row by row.
        matrix, corner = triangle[lower_places(eq)], more[lower_places(eq - above)]
        corner = matrix[above:, above:] + corner
        matrix = jnp.concatenate([matrix[:above], jnp.concatenate([matrix[above:, :above], corner], 1)])
        if v is None:
            return [of_forces, of_efforts], matrix, None, None
        return [of_forces, of_efforts], matrix, _joined(v, more_v), kappa + more_kappa

    def reduce(self, groups: Any, factors: Any, rhs: tuple, bordered: bool) -> tuple:
        """Compute L^-1 r of both groups, E P^-1 r, and p'P^-1 r where lambda is free, else None."""
        forces, efforts = (_reduce(g, f, r, bordered) for g, f, r in zip(groups, factors, rhs, strict=True))
        pull = forces[2] + efforts[2] if bordered else None
        return [forces[0], efforts[0]], _joined(forces[1], efforts[1]), pull

    def substitute(self, groups: Any, factors: Any, reduced: list, dy: jax.Array, dlambda: jax.Array | None) -> tuple:
        """Compute L^-T (L^-1 r - L^-1 E'dy - theta dlambda) of both groups."""
        parts = (dy, dy[self.above :])
        return tuple(
            _substitute(g, f, r, y, dlambda) for g, f, r, y in zip(groups, factors, reduced, parts, strict=True)
        )


def _joined(rows: jax.Array, of_efforts: jax.Array) -> jax.Array:
    """Add what efforts contribute to the last rows."""
    above = rows.shape[0] - of_efforts.shape[0]
    return jnp.concatenate([rows[:above], rows[above:] + of_efforts])


def _over(x: jax.Array) -> jax.Array:
    """Sum (rows, blocks, *lanes) over blocks."""
    return fold(jnp.add, jnp.moveaxis(x, 1, 0))


def _in_turn(group: Any, step: Callable, state: Tree, parts: list[tuple[Tree, int]]) -> tuple[Tree, Tree]:
    """Go through the blocks of a group, some at a time, as `in_turn`.

    Args:
        group: whose blocks these are.
        step: takes the state and a tuple of the parts of these blocks, returns the next state and results.
        state: before the first blocks, or None.
        parts: trees whose arrays have the blocks along the given axis.

    Returns:
        The last state, and results with an axis of steps in front.
    """
    k, count = group.columns.shape[1:3]
    size = 1 if k > 1 else max(d for d in range(1, _TOGETHER + 1) if count % d == 0)

    def divided(x: jax.Array, axis: int) -> jax.Array:
        return jnp.moveaxis(x.reshape(*x.shape[:axis], count // size, size, *x.shape[axis + 1 :]), axis, 0)

    trees = tuple(jax.tree.map(lambda x, axis=axis: divided(x, axis), tree) for tree, axis in parts)
    return in_turn(step, state, trees)


def _whole(x: jax.Array, axis: int) -> jax.Array:
    """Join the blocks of results of `_in_turn` along their axis."""
    x = jnp.moveaxis(x, 0, axis - 1)
    return x.reshape(*x.shape[: axis - 1], -1, *x.shape[axis + 1 :])


def _products(group: Any, rows: slice, x: jax.Array) -> jax.Array:
    """Compute some rows of E_i x_i, summed over the blocks, of x (k, n, *lanes)."""

    def step(sums: jax.Array, part: tuple) -> tuple[jax.Array, None]:
        columns, x = part
        return sums + fold(jnp.add, [_over(columns[:, a] * x[a]) for a in range(len(x))]), None

    none = jnp.zeros((group.columns[rows].shape[0], *x.shape[2:]), x.dtype)
    return _in_turn(group, step, none, [(group.columns[rows], 2), (x, 1)])[0]


def _pull_back(group: Any, rows: slice, y: jax.Array) -> jax.Array:
    """Compute E_i'y for some rows of E, (k, n, *lanes)."""

    def step(_: None, part: tuple) -> tuple[None, jax.Array]:
        return None, fold(jnp.add, part[0] * y[:, None, None])

    return _whole(_in_turn(group, step, None, [(group.columns[rows], 2)])[1], 2)


def _factor(problem: Any, group: Any, weights: jax.Array, above: int) -> tuple:
    """Eliminate a group's blocks, and sum up what they add to the rows of E below the first ones."""
    lanes, dtype, eq = problem.lanes, weights.dtype, group.columns.shape[0] - above

    def step(sums: tuple, part: tuple) -> tuple:
        columns, sigma, weights, present, root = part
        some = group._replace(columns=columns, sigma=sigma, present=present, hessian_root=root)
        found = problem.factor_block(some, weights)
        row = lambda r: fold(jnp.add, [_over(c[: r + 1] * c[r]) for c in found.columns])
        more = [jnp.concatenate([row(r) for r in range(eq)]), None, None]
        if problem.bordered:
            more[1] = fold(jnp.add, [_over(c * -t) for c, t in zip(found.columns, found.theta, strict=True)])
            more[2] = fold(jnp.add, found.kappa)
        return jax.tree.map(jnp.add, sums, tuple(more)), found._replace(kappa=None)

    zeros = lambda *shape: jnp.zeros((*shape, *lanes), dtype)
    none = (zeros(eq * (eq + 1) // 2), *((zeros(eq), zeros()) if problem.bordered else (None, None)))
    spread = lambda x, axis: jnp.broadcast_to(x, (*x.shape[: axis + 1], *lanes))
    root = None if group.hessian_root is None else spread(group.hessian_root, 2)
    parts = [(group.columns[above:], 2), (group.sigma, 1), (weights, 1), (spread(group.present, 0), 0), (root, 2)]
    sums, found = _in_turn(group, step, none, parts)
    entries = lambda many: [_whole(x, 1) for x in many]
    columns = [_whole(x, 2) for x in found.columns]
    return BlockFactor(entries(found.below), entries(found.inverse), columns, entries(found.theta), None), sums


def _parts(factor: BlockFactor) -> list[tuple[Tree, int]]:
    return [(factor.below, 0), (factor.inverse, 0), (factor.columns, 1), (factor.theta, 0)]


def _reduce(group: Any, factor: BlockFactor, rhs: jax.Array, bordered: bool) -> tuple:
    """Compute L^-1 r (k, n, *lanes), E P^-1 r and p'P^-1 r of a group."""

    def step(sums: tuple, part: tuple) -> tuple:
        below, inverse, columns, theta, rhs = part
        out = substitute_down(below, inverse, list(rhs))
        more = [fold(jnp.add, [_over(c * a) for c, a in zip(columns, out, strict=True)]), None]
        if bordered:
            more[1] = fold(jnp.add, [fold(jnp.add, t * a) for t, a in zip(theta, out, strict=True)])
        return jax.tree.map(jnp.add, sums, tuple(more)), jnp.stack(out)

    lanes, dtype = rhs.shape[2:], rhs.dtype
    none = jnp.zeros((factor.columns[0].shape[0], *lanes), dtype), jnp.zeros(lanes, dtype) if bordered else None
    sums, reduced = _in_turn(group, step, none, [*_parts(factor), (rhs, 1)])
    return _whole(reduced, 2), *sums


def _substitute(
    group: Any, factor: BlockFactor, reduced: jax.Array, dy: jax.Array, dlambda: jax.Array | None
) -> jax.Array:
    """Compute L^-T (L^-1 r - L^-1 E'dy - theta dlambda) of a group, (k, n, *lanes)."""

    def step(_: None, part: tuple) -> tuple[None, jax.Array]:
        below, inverse, columns, theta, reduced = part
        right = [a - fold(jnp.add, c * dy[:, None]) for c, a in zip(columns, reduced, strict=True)]
        if dlambda is not None:
            right = [a - t * dlambda for a, t in zip(right, theta, strict=True)]
        return None, jnp.stack(substitute_up(below, inverse, right))

    return _whole(_in_turn(group, step, None, [*_parts(factor), (reduced, 1)])[1], 2)
