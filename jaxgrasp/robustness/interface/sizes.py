"""Direct calls on batches of many sizes, by few programs.

XLA takes seconds, and keeps megabytes, for the programs of a size. So batches are filled with copies of their last
grasp up to one of few sizes, and results are cut: powers of four up to 2,048, where that costs a millisecond or two,
then powers of two. The first large size that comes has programs of its own.
"""

from collections.abc import Hashable
from dataclasses import dataclass, replace

import jax

from jaxgrasp.lanes.direct import filled, is_direct, power_of_two
from jaxgrasp.robustness.interface.arguments import GraspData, Options, Trailing, trailing_shapes

# How many sizes above the small ones have programs of their own, for a function and its shapes.
_OWN = 1
_SMALL = (8, 32, 128, 512, 2048)
# Filling larger batches costs more than it saves.
_LARGEST = 1 << 16

_known: dict[Hashable, set[int]] = {}


@dataclass(frozen=True)
class Filled:
    """Arguments of a direct call that are filled with copies."""

    data: GraspData
    """The grasps, then copies of the last one."""
    options: Options
    """The options of the grasps and of their copies."""
    count: int
    """The number of grasps without copies."""


def fill_to_known_size(function: Hashable, data: GraspData, options: Options) -> Filled | None:
    """Fill the arguments up to a size that has programs; None where they are taken as they are.

    Args:
        function: what is to be run; it compares by value.
        data: the grasps.
        options: what is asked for.
    """
    contacts = data.contacts
    if len(contacts.batch_shape) != 1 or data.disturbances.batch_shape or data.compliance is not None:
        return None
    (count,) = contacts.batch_shape
    if not isinstance(count, int) or not 1 < count <= _LARGEST or _next(count) == count:
        return None
    leaves, structure = jax.tree.flatten((data, options))
    if not is_direct(leaves) or any(x.shape[:1] != (count,) for x in jax.tree.leaves(contacts)):
        return None
    shapes = tuple((x.shape[1:] if x.shape[:1] == (count,) else x.shape, x.dtype) for x in leaves)
    kind = function, structure, shapes
    size = _size(kind, count)
    if size == count:
        return None

    def spread(value: jax.Array, trailing: Trailing) -> jax.Array:
        """An argument, filled where each grasp has its own."""
        if value.shape == trailing.shape:
            return value
        if value.shape != (count, *trailing.shape):
            raise _OtherAxes
        return filled(value, size)

    others = replace(data, contacts=None, disturbances=None), options
    trailing, option_shapes = trailing_shapes(data, options)
    try:
        others, options = jax.tree.map(spread, others, (replace(trailing, contacts=None), option_shapes))
    except _OtherAxes:
        return None
    contacts = jax.tree.map(lambda x: filled(x, size), contacts)
    return Filled(replace(others, contacts=contacts, disturbances=data.disturbances), options, count)


class _OtherAxes(Exception):
    """An argument has other axes than those of the batch; `lay_out` tells of what does not fit."""


def _size(kind: Hashable, count: int) -> int:
    own = _known.setdefault(kind, set())
    if len(own) < _OWN and count > _SMALL[-2]:
        own.add(count)
    return count if count in own else _next(count)


def _next(count: int) -> int:
    """The smallest size of all batches that is not below the count."""
    return next((size for size in _SMALL if size >= count), power_of_two(count, 1))
