"""Formulations for sets that are no polytopes: directions are refined until certified bounds meet.

Where every direction w has forces of its own, those that are withstood form a convex set V, {w: lambda = 1 can be had},
and the margin is the largest lambda with lambda D in V. A program for one direction finds the point of V's boundary on
it, and a bound beyond which no forces reach. Points span a polytope inside V (`expansion`): by its facets the margin is
at least min 1 / h_D(l). The member of D that reaches furthest along the normal of the worst facet is the next
direction: its own bound holds for all of D, and its point pushes the facet out. After the axes of D, a dozen directions
are enough for most grasps.

For one f_0 and blocking forces see `cuts`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.disturbance.vertices import Vertices
from jaxgrasp.lanes.direct import power_of_two
from jaxgrasp.robustness.chain.expansion import Polytope
from jaxgrasp.robustness.chain.members import SetOfLanes
from jaxgrasp.robustness.chain.verdicts import FormulationSolution
from jaxgrasp.robustness.interface.arguments import Arguments, GraspData
from jaxgrasp.solvers.status import Status

Solve = Callable[[GraspData], FormulationSolution]
# A `FormulationSolution` of NumPy's arrays, lanes leading.
OnHost = Any

# Directions of a grasp at a time, and grasps.
_AT_ONCE = 4
_LANES = 256
_MOST_ROUNDS = 60
# Members that a facet tells apart by less than this are near each other: one of them is enough for now.
_ALIKE = 0.98


class Programs:
    """Formulations for directions that are given lane by lane, in calls of one size."""

    def __init__(self, arguments: Arguments, solve: Solve, directions: int) -> None:
        """Take the arguments of all lanes, and how many directions each gets at a time."""
        self.solve, self.directions = solve, directions
        self.count = int(np.prod(arguments.batch))
        self.size = min(_LANES, power_of_two(self.count, 8))
        host = jax.tree.map(np.asarray, arguments.inputs.data)
        self.data, self.shared = replace(host, disturbances=None), replace(arguments.shared.data, disturbances=None)
        self.dtype = host.contacts.positions.dtype
        self.sets = SetOfLanes(host.disturbances.terms, arguments.shared.data.disturbances.terms)
        self.precision = {"float64": 1e-9, "float32": 1e-5}[self.dtype.name]

    def of(self, lanes: np.ndarray, wrenches: np.ndarray) -> OnHost:
        """Solve for wrenches (L, D, 6) of some lanes (L,); leaves (L, ...) on the host."""
        parts = [
            self._call(lanes[at : at + self.size], wrenches[at : at + self.size])
            for at in range(0, len(lanes), self.size)
        ]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    def _call(self, lanes: np.ndarray, wrenches: np.ndarray) -> OnHost:
        some = np.resize(lanes, self.size)
        given = np.zeros((self.size, self.directions, 6), self.dtype)
        given[: len(lanes)] = wrenches
        pick = lambda x, shared: jnp.asarray(x if shared else x[some])
        data = jax.tree.map(pick, self.data, self.shared)
        data = replace(data, disturbances=DisturbanceSet(terms=(Vertices(wrenches=jnp.asarray(given)),)))
        return jax.tree.map(lambda x: np.asarray(x)[: len(lanes)], self.solve(data))


@dataclass
class Bounds:
    """What is known of every lane: arrays (lanes,), and the worst member of its set found so far (lanes, 6)."""

    lower: np.ndarray
    upper: np.ndarray
    status: np.ndarray
    zero: np.ndarray
    """Whether some member of the set has a margin of zero, which `formulation_margin` has bounds of its own for."""
    worst: np.ndarray

    @classmethod
    def unknown(cls, worst: np.ndarray) -> "Bounds":
        """What is known at first, with some members of the sets (lanes, 6)."""
        count = len(worst)
        return cls(np.zeros(count), np.full(count, np.inf), np.zeros(count, int), np.zeros(count, bool), worst.copy())

    def note(self, lanes: np.ndarray, found: OnHost, wrenches: np.ndarray) -> None:
        """Take over what members of the sets of lanes (L,) prove, wrenches (L, D, 6), by their solutions."""
        solved = found.status == Status.SOLVED
        better = solved & (found.upper_bound < self.upper[lanes])
        worst = np.argmin(np.where(np.isnan(found.directions), np.inf, found.directions), 1)
        member = np.take_along_axis(wrenches, worst[:, None, None], 1)[:, 0]
        self.upper[lanes] = np.where(better, found.upper_bound, self.upper[lanes])
        self.zero[lanes] |= solved & (found.margin == 0)
        self.worst[lanes] = np.where(better[:, None], member, self.worst[lanes])

    def closed(self, tolerance: float) -> np.ndarray:
        """Whether the bounds are within the tolerance of each other, (lanes,)."""
        return self.zero | (np.isfinite(self.upper) & (self.lower >= (1 - tolerance) * self.upper))


@dataclass
class _Lane:
    """A grasp that is being refined: its polytope in the coordinates of the axes, and each facet's bound."""

    polytope: Polytope
    inverse: np.ndarray
    reach: np.ndarray
    members: np.ndarray
    fresh: int

    def new_directions(self) -> np.ndarray:
        """The normals of the facets whose reach is not known yet, as wrenches' coefficients (fresh, 6)."""
        normals = self.polytope.normals
        return normals[len(normals) - self.fresh :] @ self.inverse

    def add(self, wrench: np.ndarray, margin: float) -> bool:
        """Put in the point of a direction."""
        changed = self.polytope.add(margin * (self.inverse @ wrench))
        if changed is None:
            return False
        kept, new = changed
        old = len(kept) - self.fresh
        self.reach, self.members = self.reach[kept[:old]], self.members[kept[:old]]
        self.fresh = int(kept[old:].sum()) + new
        return True

    def next(self, least: float) -> np.ndarray:
        """The members of the facets that reach beyond `least`, at most `_AT_ONCE` that differ, (D, 6)."""
        directions = self.polytope.normals @ self.inverse
        chosen: list[int] = []
        for facet in np.argsort(-self.reach)[:64]:
            if self.reach[facet] <= least or len(chosen) == _AT_ONCE:
                break
            if all(self.members[k] @ directions[facet] <= _ALIKE * self.reach[facet] for k in chosen):
                chosen.append(int(facet))
        return self.members[chosen]


def refine(arguments: Arguments, solve: Solve, tolerance: float) -> FormulationSolution:
    """The solution of a formulation with forces of its own for each direction, for any set.

    Args:
        arguments: the public arguments of all lanes.
        solve: the formulation for vertices.
        tolerance: how far the bounds may be apart, as a share of the upper one.

    Returns:
        FormulationSolution with the batch's axes, see `formulation_margin`.
    """
    programs = Programs(arguments, solve, _AT_ONCE)
    bounds, live = _begin(programs)
    for _ in range(_MOST_ROUNDS):
        _reach_of_new_facets(programs, live)
        for lane, own in live.items():
            bounds.lower[lane] = max(bounds.lower[lane], 1 / own.reach.max())
        closed = bounds.closed(tolerance)
        live = {lane: own for lane, own in live.items() if not closed[lane]}
        if not live:
            break
        live = _push(programs, bounds, live, tolerance)
    last = programs.of(np.arange(programs.count), bounds.worst[:, None] * np.eye(1, _AT_ONCE)[0][:, None])
    return finish(arguments, bounds, first_direction(last, bounds.worst), tolerance)


def _begin(programs: Programs) -> tuple[Bounds, dict[int, _Lane]]:
    """Solve for the axes of every lane's set, both ways; lanes that are not decided by them get a polytope."""
    count, lanes = programs.count, np.arange(programs.count)
    every = [programs.sets.axes(lane) for lane in range(count)]
    ends, inverses = np.zeros((count, 12, 6)), []
    for lane, (axes, _) in enumerate(every):
        ends[lane, : 2 * axes.shape[1]] = np.concatenate([axes.T, -axes.T])
        inverses.append(np.linalg.pinv(axes) if np.isfinite(axes).all() else axes.T)
    bounds = Bounds.unknown(ends[:, 0])
    margins = np.zeros((count, 0))
    members = np.array([are_members for _, are_members in every], bool)
    for start in range(0, 12, _AT_ONCE):
        some = ends[:, start : start + _AT_ONCE]
        found = programs.of(lanes, some)
        decided = (bounds.status == Status.SOLVED) & ((found.status != Status.UNBOUNDED) | (start == 0))
        bounds.status = np.where(decided, found.status, bounds.status)
        margins = np.concatenate([margins, found.directions], 1)
        bounds.note(lanes[members], jax.tree.map(lambda x: x[members], found), some[members])
    live = {}
    for lane in np.flatnonzero((bounds.status == Status.SOLVED) & ~bounds.zero):
        own, inverse = margins[lane, : 2 * every[lane][0].shape[1]], inverses[lane]
        if own.min() > 0:
            polytope = Polytope(own[:, None] * (ends[lane, : len(own)] @ inverse.T))
            live[int(lane)] = _Lane(polytope, inverse, np.zeros(0), np.zeros((0, 6)), len(polytope.facets))
    # Axes that are no members say nothing about the set where nothing withstands them.
    rest = np.flatnonzero((bounds.status == Status.SOLVED) & ~bounds.zero & ~np.isin(lanes, list(live)))
    for sign in (1, -1):
        for k in range(6) if len(rest) else ():
            turned = np.array([sign * inverses[lane][min(k, len(inverses[lane]) - 1)] for lane in rest])
            some = programs.sets.reach(turned, rest)[1][:, None] * np.eye(1, _AT_ONCE)[0][:, None]
            bounds.note(rest, programs.of(rest, some), some)
    return bounds, live


def _reach_of_new_facets(programs: Programs, live: dict[int, _Lane]) -> None:
    """Find how far each lane's set reaches along the normals of its new facets."""
    new = [own.new_directions() for own in live.values()]
    lanes = np.repeat(np.array(list(live), int), [len(each) for each in new])
    reach, members = programs.sets.reach(np.concatenate([*new, np.zeros((0, 6))]), lanes)
    start = 0
    for own, each in zip(live.values(), new, strict=True):
        stop = start + len(each)
        own.reach = np.concatenate([own.reach, reach[start:stop]])
        own.members = np.concatenate([own.members, members[start:stop]])
        own.fresh, start = 0, stop


def _push(programs: Programs, bounds: Bounds, live: dict[int, _Lane], tolerance: float) -> dict[int, _Lane]:
    """Solve for the members that the worst facets of each lane ask for; the lanes where that changed something."""
    lanes = np.array(list(live), int)
    wrenches = np.zeros((len(lanes), _AT_ONCE, 6))
    for row, (lane, own) in enumerate(live.items()):
        chosen = own.next(1 / ((1 - tolerance / 2) * bounds.upper[lane]))
        wrenches[row, : len(chosen)] = chosen
    found = programs.of(lanes, wrenches)
    before = bounds.upper[lanes]
    bounds.note(lanes, found, wrenches)
    still = {}
    for row, (lane, own) in enumerate(live.items()):
        margins = found.directions[row]
        grew = [own.add(w, m) for w, m in zip(wrenches[row], margins, strict=True) if np.isfinite(m)]
        if any(grew) or bounds.upper[lane] < before[row]:
            still[lane] = own
    return still


def first_direction(found: OnHost, worst: np.ndarray) -> OnHost:
    """A solution for the first of its directions, the worst member of a set (lanes, 6)."""
    return replace(
        found, directions=found.directions[:, :1], disturbed_forces=found.disturbed_forces[:, :1], worst_wrench=worst
    )


def finish(arguments: Arguments, bounds: Bounds, found: OnHost, tolerance: float) -> FormulationSolution:
    """A solution for one direction with the bounds and statuses of the whole set.

    Args:
        arguments: the public arguments of all lanes.
        bounds: what was found for the set.
        found: the solution for its worst member, leaves (lanes, ...).
        tolerance: how far the bounds may be apart, as a share of the upper one.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        lower = np.where(bounds.zero, 0, np.minimum(bounds.lower, bounds.upper))
        gap = np.where(bounds.zero, found.gap, np.where(np.isinf(bounds.upper), np.inf, 1 - lower / bounds.upper))
        share = np.where(found.margin > 0, np.minimum(lower / found.margin, 1), 0)
    has_margin = bounds.status == Status.SOLVED
    open_status = np.where(bounds.closed(tolerance), Status.SOLVED, Status.MAX_ITERATIONS)
    status = np.where(bounds.status == Status.SOLVED, open_status, bounds.status)
    rest = found.forces[:, None]
    moved = rest + share[:, None, None, None] * (found.disturbed_forces - rest)
    unbounded = bounds.status == Status.UNBOUNDED
    where_margin = lambda x: np.where(has_margin, x, np.where(unbounded, np.inf, np.nan))
    solution = replace(
        found,
        margin=where_margin(lower),
        upper_bound=where_margin(bounds.upper),
        disturbed_forces=np.where(unbounded[:, None, None, None], found.disturbed_forces, moved),
        status=status.astype(np.int32),
        gap=np.where(unbounded, 0, where_margin(gap)),
    )
    dtype = arguments.inputs.data.contacts.positions.dtype
    lay = lambda x: jnp.asarray(x, dtype if np.issubdtype(x.dtype, np.floating) else x.dtype)
    return jax.tree.map(lambda x: lay(x).reshape(*arguments.batch, *x.shape[1:]), solution)
