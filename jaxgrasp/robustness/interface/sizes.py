"""Direct calls on batches of many sizes, by few programs.

XLA takes seconds, and keeps megabytes, for the programs of a size. So batches are filled with copies of their last
grasp up to one of few sizes, and answers are cut: powers of four up to 2,048, where that costs a millisecond or two,
then powers of two. The first large size that comes has programs of its own.
"""

from collections.abc import Hashable
from dataclasses import dataclass, replace

import jax

from jaxgrasp.contact.actuation import Actuation
from jaxgrasp.contact.contacts import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.lanes.direct import filled, is_direct, power_of_two
from jaxgrasp.robustness.interface.arguments import ACTUATION_EVENTS

# How many sizes above the small ones have programs of their own, for a function and its shapes.
_OWN = 1
_SMALL = (8, 32, 128, 512, 2048)
# Filling larger batches costs more than it saves.
_LARGEST = 1 << 16
# Arguments that are more than an array.
_TREES = {"compliance", "actuation"}

_known: dict[Hashable, set[int]] = {}


@dataclass(frozen=True)
class Filled:
    """Arguments of a direct call; `count` grasps were asked for, the others are copies."""

    contacts: Contacts
    given: dict
    count: int


def with_a_known_size(kernel: Hashable, contacts: Contacts, disturbances: DisturbanceSet, given: dict) -> Filled | None:
    """The arguments for a size that has programs; None where they are taken as they are.

    Args:
        kernel: what is to be run; it compares by value.
        contacts: the grasps.
        disturbances: the set D.
        given: the other arguments by their public names, None where not given.
    """
    if len(contacts.batch_shape) != 1 or disturbances.batch_shape or given["compliance"] is not None:
        return None
    (count,) = contacts.batch_shape
    if not isinstance(count, int) or not 1 < count <= _LARGEST or _next(count) == count:
        return None
    leaves, structure = jax.tree.flatten((contacts, disturbances, given))
    if not is_direct(leaves) or any(x.shape[:1] != (count,) for x in jax.tree.leaves(contacts)):
        return None
    shapes = tuple((x.shape[1:] if x.shape[:1] == (count,) else x.shape, x.dtype) for x in leaves)
    kind = kernel, structure, shapes
    size = _size(kind, count)
    if size == count:
        return None
    try:
        events = {"required_wrench": (6,), "effort_weights": (contacts.n_c, 3, 3)}
        spread: dict[str, jax.Array | Actuation | None] = {
            name: _spread(given[name], events.get(name, ()), count, size) for name in given.keys() - _TREES
        }
        if given["actuation"] is not None:
            spread["actuation"] = _spread_actuation(given["actuation"], contacts.n_c, count, size)
    except _OtherAxes:
        return None
    return Filled(jax.tree.map(lambda x: filled(x, size), contacts), given | spread, count)


class _OtherAxes(Exception):
    """An argument has other axes than those of the batch; `laid_out` tells of what does not fit."""


def _size(kind: Hashable, count: int) -> int:
    own = _known.setdefault(kind, set())
    if len(own) < _OWN and count > _SMALL[-2]:
        own.add(count)
    return count if count in own else _next(count)


def _next(count: int) -> int:
    """The smallest size with programs that is not below the count."""
    return next((size for size in _SMALL if size >= count), power_of_two(count, 1))


def _spread(value: jax.Array | None, event: tuple[int, ...], count: int, size: int) -> jax.Array | None:
    """An argument, filled where each grasp has its own."""
    if value is None or value.shape == event:
        return value
    if value.shape != (count, *event):
        raise _OtherAxes
    return filled(value, size)


def _spread_actuation(actuation: Actuation, contacts: int, count: int, size: int) -> Actuation:
    events = {name: getattr(actuation, name) for name in ACTUATION_EVENTS}
    events = {name: x if x is None else x.shape[x.ndim - ACTUATION_EVENTS[name] :] for name, x in events.items()}
    if events["jacobian"][0] != contacts:
        raise _OtherAxes
    parts = {name: _spread(getattr(actuation, name), event or (), count, size) for name, event in events.items()}
    return replace(actuation, **parts)
