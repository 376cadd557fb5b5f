"""Ferrari and Canny's metric of whole batches, with a proof: branch and bound over the polar of the wrench space.

The radius of the largest ball in the wrench space is 1 / max |n| over its polar, see `largest_ball`. The maximum of
|n|^2, which is convex, over the part of the polar in a box l <= n <= h is at most that of

    (l + h)'n - l'h,

a linear program. Where its bound is not above the best n so far, no nearer facet is in the box; other boxes are cut in
two. Any direction n gives a point n / h(n) of the polar, with the support function h, so every program also gives a
candidate. The boxes lie along the principal axes of the wrenches, in which the polar is stretched.
"""

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.arrays import fold
from jaxgrasp.compiling import compiled
from jaxgrasp.lanes.tiles import map_lanes
from jaxgrasp.solvers import interior_point
from jaxgrasp.solvers.dense.boxed import SETTINGS, BoxedProblem

TOLERANCE = {"float64": 1e-7, "float32": 2e-4}
"""No |n|^2 is larger than the best one by more than this share."""
# Programs of a small call and of a large one.
_CALLS = (256, 8192)
# Programs of a grasp after which the search ends without a proof.
_MOST_PROGRAMS = 5_000
# Programs of an ascent, how much closer than others they are solved, and the least gain for another one.
_ASCENTS = 12
_VERTEX = 1e-4
_GAIN = {"float64": 1e-9, "float32": 1e-5}
# How often boxes are made smaller anew that shrank to less than this.
_ENCLOSURES, _MUCH = 5, 0.01


@dataclass(kw_only=True)
class Search:
    """The state of the search in every polar of a batch.

    points: w, (grasps, groups, k, 6), in principal axes, the longest of norm 1; zero where absent.
    counts: bool (grasps, groups, k).
    """

    points: np.ndarray
    counts: np.ndarray
    best: np.ndarray = field(init=False)
    """(grasps,), the largest |n|^2 so far."""
    farthest: np.ndarray = field(init=False)
    """(grasps, 6), its n."""
    bound: np.ndarray = field(init=False)
    """(grasps,), no |n|^2 is larger."""
    programs: np.ndarray = field(init=False)
    """(grasps,), how many were solved."""

    def __post_init__(self) -> None:
        """Begin without any point of the polar."""
        count, dtype = len(self.points), self.points.dtype
        self.best, self.farthest = np.zeros(count, dtype), np.zeros((count, 6), dtype)
        self.bound, self.programs = np.full(count, np.inf, dtype), np.zeros(count, int)

    def run(self, reach: np.ndarray) -> None:
        """Find the longest n of every polar.

        Args:
            reach: (grasps, 6), no |n_j| of a polar is larger.
        """
        low, high = -reach, reach
        loose = np.arange(len(reach))
        for _ in range(_ENCLOSURES):
            if not len(loose):
                break
            low[loose], high[loose], shrunk = self._enclose(loose, low[loose], high[loose])
            loose = loose[shrunk]
        whole = low, high
        which = np.arange(len(low))
        self._ascend(which, *whole)
        bound, _ = self._largest(which, low, high)
        left = ~(bound <= self._level())
        which, low, high = _parts_about(which[left], low[left], high[left], self.farthest[left])
        bound, n = self._largest(which, low, high)
        least = np.zeros_like(self.best)
        while True:
            # Of the boxes that are given up, the bounds count.
            spent = self.programs[which] > _MOST_PROGRAMS
            np.maximum.at(least, which[spent], bound[spent])
            keep = ~spent & ~(bound <= self._level()[which])
            which, low, high, bound, n = (x[keep] for x in (which, low, high, bound, n))
            if not len(which):
                break
            low, high = _cut(low, high, n)
            which = np.concatenate([which, which])
            before, known = self.best.copy(), np.concatenate([bound, bound])
            bound, n = self._largest(which, low, high)
            # A part is in the whole.
            bound = np.minimum(bound, known)
            self._ascend(np.flatnonzero(self.best > before), *whole)
        self.bound = np.maximum(self._level(), least)

    def _level(self) -> np.ndarray:
        return self.best * (1 + TOLERANCE[self.best.dtype.name])

    def _enclose(
        self, which: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Bound every axis of polars in boxes, within a tenth: twelve programs each.

        Returns:
            The boxes, and which of them were much too large, so that rounding may have spoilt their bounds.
        """
        count, dtype = len(which), low.dtype
        axes = np.concatenate([np.eye(6, dtype=dtype), -np.eye(6, dtype=dtype)])
        twelve = np.repeat(np.arange(count), 12)
        level = np.zeros(len(twelve), dtype)
        bounds, _ = self._solve(which[twelve], low[twelve], high[twelve], np.tile(axes, (count, 1)), level, level)
        bounds = bounds.reshape(count, 2, 6)
        least, most = np.maximum(low, -bounds[:, 1]), np.minimum(high, bounds[:, 0])
        return least, most, np.any(most - least < _MUCH * (high - low), -1)

    def _ascend(self, which: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
        """Go from the best n of polars to where its own direction is largest, as long as that is farther."""
        for _ in range(_ASCENTS):
            if not len(which):
                return
            before = self.best[which]
            target = self.farthest[which]
            # Boxes will be cut at this n: it has to be a vertex of the polar but for rounding.
            self._solve(which, low[which], high[which], target, before, _VERTEX * before)
            which = which[self.best[which] > before * (1 + _GAIN[before.dtype.name])]

    def _largest(self, which: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bound |n|^2 in boxes of grasps: the bounds, and where they are attained."""
        offset = np.sum(low * high, -1)
        bound, n = self._solve(which, low, high, low + high, self._level()[which] + offset, self.best[which])
        return bound - offset, n

    def _solve(
        self,
        which: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        target: np.ndarray,
        level: np.ndarray,
        scale: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bound target'n in boxes of grasps, and take what is found as candidates."""
        bounds, points = [], []
        start = 0
        while start < len(which):
            left = len(which) - start
            size = next((size for size in _CALLS if size >= left), _CALLS[-1])
            part = slice(start, start + size)
            more = max(size - left, 0)
            pad = lambda x, more=more, part=part: np.concatenate([x[part], np.repeat(x[part][-1:], more, 0)])
            own = pad(which)
            arguments = (self.points[own], self.counts[own], pad(low), pad(high), pad(target), pad(level), pad(scale))
            bound, n, square = (np.asarray(x)[: size - more] for x in _bound(*arguments))
            bounds.append(bound)
            points.append(n)
            self._take(which[part], n, square)
            start += size
        np.add.at(self.programs, which, 1)
        return np.concatenate(bounds), np.concatenate(points)

    def _take(self, which: np.ndarray, n: np.ndarray, square: np.ndarray) -> None:
        """Keep the longest candidate of every grasp."""
        order = np.argsort(square, kind="stable")
        which, n, square = which[order], n[order], square[order]
        better = square > self.best[which]
        # The last of equal indices counts: the longest.
        self.best[which[better]] = square[better]
        self.farthest[which[better]] = n[better]


def _parts_about(
    which: np.ndarray, low: np.ndarray, high: np.ndarray, best: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut each box at its best n along all axes: at the corners of a box the linear bound is |n|^2 itself.

    Returns:
        The grasps of the 64 parts of each box, and the parts.
    """
    upper = (np.arange(64)[:, None] >> np.arange(6)) % 2 == 1
    at = np.clip(best, low, high)[:, None]
    parts_low, parts_high = np.where(upper, at, low[:, None]), np.where(upper, high[:, None], at)
    return np.repeat(which, 64), parts_low.reshape(-1, 6), parts_high.reshape(-1, 6)


def _cut(low: np.ndarray, high: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut boxes in two, all first parts before all second ones, where the linear bound is farthest from |n|^2."""
    rows = np.arange(len(low))
    axis = np.argmax((high - n) * (n - low), -1)
    least, most, at = low[rows, axis], high[rows, axis], n[rows, axis]
    # A program tells n but for its accuracy; near a side, a cut a little farther off has n in the slice.
    from_low, from_high, width = at - least, most - at, most - least
    beyond = np.where(from_low < 0.25 * width, least + 2 * from_low, at)
    at = np.where(from_high < 0.25 * width, most - 2 * from_high, beyond)
    below, above = high.copy(), low.copy()
    below[rows, axis], above[rows, axis] = at, at
    return np.concatenate([low, above]), np.concatenate([below, high])


@compiled
def _bound(points: jax.Array, *programs: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Bound target'n over parts of polars in boxes; the arguments of `_of_lanes`, lanes first."""
    arguments = (points, *programs)
    return map_lanes(
        (lambda all: _of_lanes(*all),),
        arguments,
        jax.tree.map(lambda _: False, arguments),
        math.prod(points.shape[1:3]) + points.shape[1] + 13,
        compact=True,
        known_as=f"{__name__}.{_of_lanes.__qualname__}",
    )


def _of_lanes(
    points: jax.Array,
    counts: jax.Array,
    low: jax.Array,
    high: jax.Array,
    target: jax.Array,
    level: jax.Array,
    scale: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The bound, the n of a program, within the polar, and |n|^2; lanes trail."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    w = jnp.moveaxis(points, 2, 0)
    goal = target * half
    size = fold(jnp.add, jnp.abs(goal))
    unit = 1 / jnp.where(size > 0, size, 1)
    offset = fold(jnp.add, target * middle)
    problem = BoxedProblem(
        points=w * half[:, None, None],
        heights=-fold(jnp.add, w * middle[:, None, None]),
        counts=counts.astype(w.dtype),
        target=goal * unit,
        level=(level - offset) * unit,
        scale=scale * unit,
    )
    found = interior_point.solve(problem, SETTINGS[w.dtype.name], size > 0)
    n = middle + half * found.iterate.x.v
    work = fold(jnp.add, w * n[:, None, None])
    reach = fold(jnp.add, jnp.maximum(fold(jnp.maximum, jnp.swapaxes(work, 0, 1)), 0))
    on = n / jnp.where(reach > 0, reach, 1)
    square = jnp.where(reach > 0, fold(jnp.add, on * on), 0)
    # The point of the program tells where to cut; the one of the polar is a candidate.
    return offset + size * found.record.upper, n, square
