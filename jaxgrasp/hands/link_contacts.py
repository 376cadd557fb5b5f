"""From the points where geoms touch or come near to the contacts of a grasp: the same for every engine.

A convex decomposition, or two flat sides, give one link many points, of which the nearest ones say little: a nanometre
decides which are kept, and whole fingers get lost. So each link has one contact, at the mean of its near points with
the mean of their normals, as in most of the field; or as many as are asked for, spread apart.

The functions take NumPy's arrays or JAX's, and the module `xp` that computes with them.
"""

from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

# Points of a link that are nearer to each other count as one, m.
_SAME = 1e-6
# Normals whose mean is shorter than this point against each other.
_OPPOSED = 1e-3
_TOP = (0.0, 0.0, 1.0)

Array = Any


class RawPoints(NamedTuple):
    """Where geoms of hand and object touch or come near in n configurations; world frame."""

    position: Array
    """(n, slots, 3), midway between the surfaces, m."""
    normal: Array
    """(n, slots, 3), outward from the object, unit."""
    distance: Array
    """(n, slots), of the surfaces, m, negative where they penetrate; inf in slots without a point."""
    link: Array
    """(slots,) or (n, slots), the body of the hand."""
    friction: Array
    """(slots,) or (n, slots), Coulomb's coefficient, 0 for contacts without friction."""
    reach: Array
    """(slots,) or (n, slots), the distance up to which a point counts as a contact, m."""
    torsional: Array
    """(slots,) or (n, slots), the torsional coefficient, m, 0 for hard contacts."""


class LinkContacts(NamedTuple):
    """The contacts of n configurations, the nearest first; world frame."""

    position: Array
    """(n, contacts, 3), m."""
    normal: Array
    """(n, contacts, 3), outward from the object, unit; +z in slots without a point."""
    distance: Array
    """(n, contacts), the least of the points', m; inf in slots without a point."""
    friction: Array
    """(n, contacts), the least of the points'."""
    torsional: Array
    """(n, contacts), likewise."""
    link: Array
    """(n, contacts)."""
    active: Array
    """(n, contacts), whether they touch."""
    touching: Array
    """(n,), how many links touch (points, where all points are contacts), also those that are left out."""
    left_out: Array
    """(n,), how many of these are left out."""


@dataclass(frozen=True)
class ContactRule:
    """Which points of a link become its contacts."""

    points_per_link: int | None
    """1 is the mean of a link's points that count; more are as many of them, spread apart; None is all points."""
    max_contacts: int | None
    """The number of links, the nearest ones, that have contacts. Where all points are contacts, the number of points:
    first the nearest of every link that touches, then the next of each. None is all."""

    def contacts(self, raw: RawPoints, links: np.ndarray, xp: ModuleType) -> LinkContacts:
        """The contacts.

        Args:
            raw: The points.
            links: (links,), the bodies of the hand that can touch.
            xp: numpy or jax.numpy.
        """
        if self.points_per_link is None:
            points = _all_points(raw, xp)
            return _kept(points, _in_turn(points, links, xp)[:, : self.max_contacts], xp)
        found = [_of_link(raw, int(link), self.points_per_link, xp) for link in links]
        stacked = LinkContacts(*(xp.stack(parts, 1) for parts in zip(*found, strict=True)))
        kept = _kept(stacked, _order(stacked.distance.min(-1), xp)[:, : self.max_contacts], xp)
        flat = lambda x: x.reshape(x.shape[0], -1, *x.shape[3:])
        return LinkContacts._make([*map(flat, kept[:-2]), kept.touching, kept.left_out])


def _kept(contacts: LinkContacts, chosen: Array, xp: ModuleType) -> LinkContacts:
    """The chosen ones along the second axis, the nearest first; a third one has the points of a link."""
    distance = contacts.distance
    distance = distance.min(-1) if distance.ndim == 3 else distance
    order = _picked(chosen, _order(_picked(distance, chosen, xp), xp), xp)
    kept = [_picked(x, order, xp) for x in contacts[:-2]]
    counts = [(x.any(-1) if x.ndim == 3 else x).sum(-1) for x in (contacts.active, kept[-1])]
    return LinkContacts._make([*kept, counts[0], counts[0] - counts[1]])


def _in_turn(points: LinkContacts, links: np.ndarray, xp: ModuleType) -> Array:
    """Points (n, slots) in the order in which they are kept: the nearest of every link that touches, then the next.

    Without turns a flat side of one link, nearer by a nanometre, would keep all others out.
    """
    near = _order(points.distance, xp)
    link, active = (_picked(x, near, xp) for x in (points.link, points.active))
    turn = sum(xp.where(link == own, xp.cumsum(link == own, -1), 0) for own in links)
    return _picked(near, _order(xp.where(active, turn, near.shape[-1] + 1), xp), xp)


def _order(values: Array, xp: ModuleType) -> Array:
    return xp.argsort(values, axis=-1, stable=True)


def _picked(x: Array, order: Array, xp: ModuleType) -> Array:
    """Those along the second axis that `order` (n, k) names."""
    return xp.take_along_axis(x, order.reshape(*order.shape, *[1] * (x.ndim - 2)), axis=1)


def _all_points(raw: RawPoints, xp: ModuleType) -> LinkContacts:
    friction, link, reach, torsional = (
        xp.broadcast_to(x, raw.distance.shape) for x in (raw.friction, raw.link, raw.reach, raw.torsional)
    )
    there = xp.isfinite(raw.distance)
    position, normal = _filled(raw, there, xp)
    active = there & (raw.distance <= reach)
    return LinkContacts(position, normal, raw.distance, friction, torsional, link, active, active, active)


def _of_link(raw: RawPoints, link: int, count: int, xp: ModuleType) -> LinkContacts:
    """The contacts of one link, (n, count, ...)."""
    if raw.link.ndim == 1:
        # Which slots are the link's is known beforehand.
        rows = np.flatnonzero(np.asarray(raw.link) == link)
        raw = RawPoints(*(x[rows] if x.ndim == 1 else x[:, rows] for x in raw))
        mine = xp.isfinite(raw.distance)
    else:
        mine = (raw.link == link) & xp.isfinite(raw.distance)
    distance = xp.where(mine, raw.distance, np.inf)
    friction, torsional = (xp.broadcast_to(x, distance.shape) for x in (raw.friction, raw.torsional))
    position, normal = _filled(raw, mine, xp)
    near = distance <= raw.reach
    active = near.any(-1)
    nearest = xp.arange(distance.shape[-1]) == distance.argmin(-1)[:, None]
    if count == 1:
        # Where nothing touches, the nearest point stands for itself.
        chosen = [xp.where(active[:, None], near, nearest)]
        there = [active]
    else:
        chosen, there = _spread(position, near, nearest, count, xp)
    parts = []
    for points, is_there in zip(chosen, there, strict=True):
        weight = points.astype(distance.dtype)
        mean = lambda x: xp.einsum("ns,nsi->ni", weight, x) / weight.sum(-1)[:, None]  # noqa: B023, E731
        direction = mean(normal)
        squared = (direction * direction).sum(-1, keepdims=True)
        # A link on both sides of a thin object has no mean direction: the nearest point's stands for it.
        own = xp.einsum("ns,nsi->ni", nearest.astype(distance.dtype), normal)
        direction = xp.where(squared > _OPPOSED**2, direction, own)
        length = xp.sqrt(xp.where(squared > _OPPOSED**2, squared, 1))
        parts.append(
            LinkContacts(
                position=mean(position),
                normal=direction / length,
                distance=xp.where(points, distance, np.inf).min(-1),
                friction=_least(friction, points, xp),
                link=xp.full(distance.shape[:1], link),
                active=is_there,
                torsional=_least(torsional, points, xp),
                touching=active,
                left_out=active,
            )
        )
    return LinkContacts(*(xp.stack(x, 1) for x in zip(*parts, strict=True)))


def _spread(position: Array, near: Array, nearest: Array, count: int, xp: ModuleType) -> tuple[list, list]:
    """Up to `count` of the near points, each the farthest from those before it, and whether there is one, (n,)."""
    chosen, there = [nearest], [near.any(-1)]
    gap = xp.full(near.shape, np.inf)
    for _ in range(count - 1):
        last = xp.einsum("ns,nsi->ni", chosen[-1].astype(position.dtype), position)
        gap = xp.minimum(gap, ((position - last[:, None]) ** 2).sum(-1))
        apart = xp.where(near, gap, -1)
        chosen.append(xp.arange(near.shape[-1]) == apart.argmax(-1)[:, None])
        there.append(apart.max(-1) > _SAME**2)
    return chosen, there


def _filled(raw: RawPoints, there: Array, xp: ModuleType) -> tuple[Array, Array]:
    """Positions and normals; slots that hold no point may hold anything, and get some that can be computed with."""
    return xp.where(there[..., None], raw.position, 0), xp.where(there[..., None], raw.normal, np.array(_TOP))


def _least(friction: Array, points: Array, xp: ModuleType) -> Array:
    """Of the points; 0 where there is none."""
    least = xp.where(points, friction, np.inf).min(-1)
    return xp.where(xp.isfinite(least), least, 0)
