"""(12) with blocking forces for sets that are no polytopes: members are added until certified bounds meet.

All members w of D share f_0, and contact i has to bear f_i - lambda G*_i w for each of them. For a direction a in the
contact's frame that is a row a'f_i + lambda h_D(-G*_i'a) <= c. The program for some members bounds lambda from above.
Its forces may break rows that it does not have; mixed with forces deep inside all rows they keep them, which bounds
lambda from below, and the members that break the worst rows are added.

The rows are those of a pyramid with so many edges that what it takes from Coulomb's cone, a millionth of the friction,
does not show. In one grasp of a hundred the forces have so little room that it does: these get more edges.
"""

from dataclasses import dataclass, fields, replace

import jax
import numpy as np

from jaxgrasp.contact.friction import pyramid_facets
from jaxgrasp.robustness.chain.refinement import Bounds, OnHost, Programs, Solve, finish, first_direction
from jaxgrasp.robustness.chain.verdicts import FormulationSolution
from jaxgrasp.robustness.interface.arguments import Arguments
from jaxgrasp.solvers.status import Status

# Grasps at a time: their rows are all looked at together.
_LANES = 64
# For all grasps, then for those that are left.
_EDGES = (2048, 8192)
_MOST_ROUNDS = 20
# Members that were added so many rounds ago make room for others.
_ROUNDS_KEPT = 6
# A row that is broken by less, in units of f_max, is kept to the solver's precision.
_KEPT = {"float64": 1e-9, "float32": 1e-5}


@dataclass(frozen=True)
class _Rows:
    """The rows of all contacts: facets and the bound on the normal force, for lanes (L,)."""

    normals: np.ndarray
    """a, (L, n, M, 3)."""
    reach: np.ndarray
    """h_D(-G*_i'a), (L, n, M)."""
    members: np.ndarray
    """Who attains it, (L, n, M, 6)."""
    sides: np.ndarray
    """c, (L, n, 1 or M), N."""
    kept: np.ndarray
    """(L, n, 1), by how much a row may be broken, N."""

    def of(self, some: np.ndarray) -> "_Rows":
        """Those of some lanes."""
        return _Rows(*(getattr(self, f.name)[some] for f in fields(self)))

    def mixture(self, forces: np.ndarray, deep: np.ndarray, margin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How much of forces inside all rows forces need to keep the rows, and the members that ask for it.

        Args:
            forces: f (L, n, 3), N, at margins.
            deep: g (L, n, 3), N, at a margin of 0.
            margin: (L,).

        Returns:
            The least t (L,) such that (1 - t) f + t g keeps all rows at (1 - t) margin, 1 where none does, and the
            member behind the worst row of each contact (L, n, 6).
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            over = self._over(forces) + margin[:, None, None] * self.reach
            room = -self._over(deep)
            asked = np.where(over > self.kept, over / (over + np.maximum(room, 0)), 0)
            # Rows that are kept come in the order of their slack.
            worst = np.argmax(np.where(over > self.kept, 1 + asked, over / (1 + np.abs(over))), 2)
        share = np.nan_to_num(asked.max((1, 2)), nan=1.0)
        return share, np.take_along_axis(self.members, worst[..., None, None], 2)[:, :, 0]

    def _over(self, forces: np.ndarray) -> np.ndarray:
        return np.einsum("lnma,lna->lnm", self.normals, forces) - self.sides


def refine_shared(
    arguments: Arguments, solve: Solve, first: np.ndarray, inverse: np.ndarray, tolerance: float
) -> FormulationSolution:
    """The solution of (12) with blocking forces, for any set.

    Args:
        arguments: the public arguments of all lanes.
        solve: the formulation for vertices.
        first: (lanes, D, 6), the members to begin with; those outside the range of G are among them.
        inverse: G* (lanes, 3 n_c, 6).
        tolerance: how far the bounds may be apart, as a share of the upper one.

    Returns:
        FormulationSolution with the batch's axes, see `formulation_margin`.
    """
    count, n = len(first), inverse.shape[1] // 3
    programs = Programs(arguments, solve, first.shape[1] + _ROUNDS_KEPT * n)
    bounds = Bounds.unknown(first[:, 0])
    blocks = inverse.reshape(count, n, 3, 6)
    parts = [
        _refine_some(programs, bounds, np.arange(at, min(at + _LANES, count)), first, blocks, tolerance)
        for at in range(0, count, _LANES)
    ]
    found = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return finish(arguments, bounds, found, tolerance)


def _refine_some(
    programs: Programs, bounds: Bounds, lanes: np.ndarray, first: np.ndarray, blocks: np.ndarray, tolerance: float
) -> OnHost:
    """Find the bounds of some lanes, and the best solution of each for the member of its set that binds."""
    members = np.zeros((len(lanes), programs.directions, 6))
    deep = programs.of(lanes, members).forces
    members[:, : first.shape[1]] = first[lanes]
    added = np.arange(first.shape[1], programs.directions).reshape(_ROUNDS_KEPT, -1)
    found, live = programs.of(lanes, members), np.arange(len(lanes))
    bounds.status[lanes], best = found.status, first_direction(found, first[lanes, 0])
    for edges in _EDGES:
        rows = _rows_of(programs, lanes[live], blocks[lanes[live]], edges)
        for turn in range(_MOST_ROUNDS):
            # Bounds by the programs, and by their forces mixed with others.
            before = bounds.lower[lanes[live]], bounds.upper[lanes[live]]
            bounds.note(lanes[live], found, members[live])
            share, broken = rows.mixture(found.forces, deep[live], found.margin)
            lower = np.where(found.status == Status.SOLVED, (1 - share) * found.margin, 0)
            better = lower > before[0]
            bounds.lower[lanes[live]] = np.maximum(lower, before[0])
            mixed = _mix(found, deep[live], members[live], blocks[lanes[live]], share)
            best = jax.tree.map(lambda old, new, at=live[better], rows=better: _put(old, at, new[rows]), best, mixed)

            # Add the members that break the worst row of each contact.
            moved = better | (bounds.upper[lanes[live]] < before[1])
            still = moved & ~bounds.closed(tolerance)[lanes[live]] & (found.status == Status.SOLVED)
            members[live[:, None], added[turn % _ROUNDS_KEPT]] = broken
            live, rows = live[still], rows.of(still)
            if not len(live):
                break
            found = programs.of(lanes[live], members[live])
        live = np.flatnonzero((bounds.status[lanes] == Status.SOLVED) & ~bounds.closed(tolerance)[lanes])
        if not len(live):
            break
        found = programs.of(lanes[live], members[live])
    bounds.worst[lanes] = best.worst_wrench
    return best


def _rows_of(programs: Programs, lanes: np.ndarray, blocks: np.ndarray, edges: int) -> _Rows:
    """The rows of some lanes, and how far their sets reach along them, for blocks of G* (L, n, 3, 6)."""
    contacts = programs.data.contacts
    friction, most = contacts.friction[lanes].astype(float), contacts.max_force[lanes].astype(float)
    # Without friction the rows say that a finger does not pull, see `admit`.
    friction[friction == 0] = 1
    facets = pyramid_facets(edges)
    tangents = np.broadcast_to(facets[:, :2], (*friction.shape, edges, 2))
    normals = np.concatenate([tangents, (friction[..., None] * facets[:, 2])[..., None]], -1)
    bound = np.broadcast_to([0.0, 0.0, -1.0], (*friction.shape, 1, 3))
    normals = np.concatenate([normals, bound], 2)
    loads = -np.einsum("lnma,lnae->lnme", normals, blocks).reshape(-1, 6)
    owners = np.repeat(lanes, len(loads) // len(lanes))
    reach, members = programs.sets.reach(loads, owners)
    reserve = np.zeros(())
    if programs.data.cone_margin is not None:
        reserve = programs.data.cone_margin if programs.shared.cone_margin else programs.data.cone_margin[lanes]
    # One value for all grasps, one a grasp, or one a contact.
    reserve = reserve.reshape(*reserve.shape, *[1] * (2 - reserve.ndim))
    reserve = np.where(contacts.active[lanes], reserve, 0)[..., None]
    sides = np.concatenate([np.broadcast_to(-reserve, (*friction.shape, edges)), most[..., None]], -1)
    return _Rows(
        normals,
        reach.reshape(normals.shape[:-1]),
        members.reshape(*normals.shape[:-1], 6),
        sides,
        (_KEPT[programs.dtype.name] * most)[..., None],
    )


def _mix(found: OnHost, deep: np.ndarray, members: np.ndarray, blocks: np.ndarray, share: np.ndarray) -> OnHost:
    """Solutions with a share of the deep forces, at as much less of a margin, for the member that binds."""
    rest = found.forces + share[:, None, None] * (deep - found.forces)
    margin = np.where(np.isfinite(found.margin), (1 - share) * found.margin, 0)
    at = np.maximum(found.direction, 0)[:, None, None]
    worst = np.take_along_axis(members, at, 1)[:, 0]
    answered = rest - margin[:, None, None] * np.einsum("lnae,le->lna", blocks, worst)
    mixed = first_direction(found, worst)
    direction = np.minimum(found.direction, 0)
    return replace(mixed, margin=margin, forces=rest, disturbed_forces=answered[:, None], direction=direction)


def _put(old: np.ndarray, at: np.ndarray, new: np.ndarray) -> np.ndarray:
    """A copy with other entries at some places."""
    out = np.array(old)
    out[at] = new
    return out
