"""Slices of arrays at counters of loops, and the tables in memory that they take where an array is computed.

An argument lies in memory as it came. What a program computes does not: before the outermost loop that can have it
there, a table is filled with the entries. What the rounds of a loop stack goes to a table, too, and is read from it.
"""

from typing import Any

import numpy as np

from jaxgrasp.kernels.program.entries import array, common_kind, objects
from jaxgrasp.kernels.program.expressions import Address, Region, Table, Unsupported, Value


def sliced(lower: Any, x: np.ndarray, starts: tuple, sizes: tuple[int, ...]) -> np.ndarray:
    """Slice an array at starts of which at most one is a counter; known starts are clamped as XLA clamps them.

    Args:
        lower: the lowering.
        x: the array.
        starts: a number or a counter for every axis.
        sizes: of the slice.

    Raises:
        Unsupported: more than one start is computed, a start is not a counter, or see `_filled`.
    """
    if all(type(s) is not Value for s in starts):
        corner = [min(max(int(s), 0), n - k) for s, n, k in zip(starts, x.shape, sizes, strict=True)]
        return x[tuple(slice(c, c + k) for c, k in zip(corner, sizes, strict=True))]
    moving = [axis for axis, s in enumerate(starts) if type(s) is Value]
    (axis,) = moving if len(moving) == 1 else (None,)
    if axis is None or starts[axis].kind != "u":
        raise Unsupported("an index that differs between lanes")
    fixed = [
        0 if a == axis else min(max(int(s), 0), n - k)
        for a, (s, n, k) in enumerate(zip(starts, x.shape, sizes, strict=True))
    ]
    stride = _stride(x, axis)
    if stride is None:
        x = _filled(lower, x, starts[axis].region)
        stride = x[0].size if axis == 0 else int(np.prod(x.shape[axis + 1 :]))
    first = x[tuple(slice(c, c + k) for c, k in zip(fixed, sizes, strict=True))]
    out = [
        lower.builder.value(v.op, (v.address._replace(counter=starts[axis], stride=stride),), v.kind)
        for v in first.ravel()
    ]
    return array(out, first.shape)


def stacked(lower: Any, loop: Any, rounds: int, entries: np.ndarray) -> np.ndarray:
    """Have every round of a loop write an array to a table; return what is there after the loop."""
    entries = objects(entries)
    own = [v for v in dict.fromkeys(entries.ravel()) if type(v) is Value]
    tables = {}
    for kind in dict.fromkeys("i" if v.kind == "u" else v.kind for v in own):
        of_kind = [v for v in own if v.kind.replace("u", "i") == kind]
        table = _new(lower, kind, rounds * len(of_kind), loop.body.outer)
        loop.stacked.append((table, of_kind))
        tables |= {v: (table, place, len(of_kind)) for place, v in enumerate(of_kind)}

    def after(v: Any, number: int) -> Any:
        if type(v) is not Value:
            return v
        table, place, count = tables[v]
        return lower.builder.value("entry", (Address(table, number * count + place),), table.kind)

    out = [after(v, number) for number in range(rounds) for v in entries.ravel()]
    return array(out, (rounds, *entries.shape))


def _stride(x: np.ndarray, axis: int) -> int | None:
    """Return how many entries apart the entries of an array lie along an axis, in an argument or a table.

    None where they do not lie in one of them, at equal distances and at addresses without a counter.
    """
    flat = np.moveaxis(objects(x), axis, 0).reshape(x.shape[axis], -1)
    far = ("own", "shared", "entry")
    if all(type(v) is Value and v.op in far and v.address.counter is None for v in flat.flat):
        offsets = np.array([v.address.offset for v in flat.flat]).reshape(flat.shape)
        steps = np.diff(offsets, axis=0)
        buffers = {(v.op, v.address.buffer) for v in flat.flat}
        if len(buffers) == 1 and (not steps.size or (steps == steps.flat[0]).all()):
            return int(steps.flat[0]) if steps.size else 0
    return None


def _filled(lower: Any, x: np.ndarray, inside: Region) -> np.ndarray:
    """Fill a table with an array before a loop, the outermost one around a region that can have it; return its entries.

    Raises:
        Unsupported: the loop itself computes the array.
    """
    entries = list(objects(x).ravel())
    depth = max((v.region.depth for v in entries if type(v) is Value), default=0)
    if inside.depth <= depth:
        raise Unsupported("a long loop over what it computes")
    around: Region | None = inside
    loop = None
    while around is not None and around.depth > depth:
        loop = lower.loops.get(around, loop)
        around = around.parent
    if loop is None:
        raise Unsupported("a long loop that is not known")
    key = loop.body, tuple(id(v) if type(v) is Value else (v.dtype.char, v.tobytes()) for v in entries)
    if key not in lower.tables:
        table = lower.tables[key] = _new(lower, common_kind(x), len(entries), loop.body.outer)
        loop.filled.append((table, entries))
    table = lower.tables[key]
    out = [lower.builder.value("entry", (Address(table, i),), table.kind) for i in range(len(entries))]
    return array(out, x.shape)


def _new(lower: Any, kind: str, size: int, region: Region) -> Table:
    lower.count += 1
    return Table(lower.count, kind, size, region)
