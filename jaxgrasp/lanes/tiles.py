"""Batches as lanes: any leading axes and any nesting of vmap become one trailing axis, worked through in tiles.

A kernel is a function of arrays whose last axis is the lane; a leaf that all lanes share has a last axis of size 1. On
CPUs it becomes native code where it can, see `kernels`; else XLA cuts the lanes into tiles that stay in the cache.
Elsewhere they go at once, on GPUs as native code where that is asked for. A kernel may have a stage with more lanes,
one for each of several programs of a lane.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata

from jaxgrasp.kernels import fused, usable
from jaxgrasp.lanes.fence import fences, loops
from jaxgrasp.lanes.independent import independent, on_one_device

Tree = Any
# Values of all rows of a tile: its working set has to fit in the second-level cache, and XLA's CPU backend would cut
# larger operations in parallel tasks, which it cannot do inside a tile.
TILE = 2304
LOOSE_TILE = 1024
# The same of what a tile is given: half a megabyte.
LARGEST_LEAF = 1 << 15
LARGE_TILE = 1 << 17
# Of batches of any size, small ones among them.
SMALL_TILE = 64


@dataclass(frozen=True)
class Each:
    """A stage that works on several programs of every lane, as lanes of their own.

    It takes and returns (kept, {name: tree}): what is kept passes by; leaves of the trees have an axis of programs
    before the lanes, of size 1 where they share the leaf. The functions by name see one lane axis.
    """

    functions: dict[str, Callable[[Tree], Tree]]


Stage = Callable[[Tree], Tree] | Each


def map_lanes(
    stages: tuple[Stage, ...],
    arguments: Tree,
    shared: Tree,
    rows: int,
    *,
    compact: bool,
    tile: int = LOOSE_TILE,
    known_as: str | None = None,
) -> Tree:
    """Run a kernel over the leading axis of its arguments.

    Args:
        stages: the kernel, in parts that are compiled by themselves and at the same time: the first takes the tree of
            arguments with the lane axis last (size 1 where shared), each other one what the one before returns. What is
            between two `Each` becomes native code by itself, and so does every function of an `Each`.
        arguments: leaves (lanes, ...), or without the leading axis where shared.
        shared: like arguments, bool: the leaf is the same for all lanes.
        compact: the kernel is free of library calls and large reductions, so that a stage of a tile can be one function
            on CPUs.
        rows: how many rows a lane has, which sets the size of a tile.
        tile: how many lanes a tile has where it cannot be one function.
        known_as: tells the kernel from all others, see `kernels.fused`.

    Returns:
        What the last stage returns, leaves (lanes, ...).
    """
    leaves, structure = jax.tree.flatten(arguments)
    alike = jax.tree.leaves(shared)
    if any(x.size == 0 for x in leaves):
        one = [x if s else jnp.zeros((1, *x.shape[1:]), x.dtype) for x, s in zip(leaves, alike, strict=True)]
        again = lambda one: map_lanes(
            stages, jax.tree.unflatten(structure, one), shared, rows, compact=compact, tile=tile
        )
        return jax.tree.map(lambda x: jnp.zeros((0, *x.shape[1:]), x.dtype), jax.eval_shape(again, one))
    rows = rows if compact else 0
    run: list[Callable] = []
    named = lambda part: known_as and f"{known_as} {part} {structure}"
    for number, stage in enumerate(stages):
        if not isinstance(stage, Each):
            run.append(stage)
            continue
        kept, programs = _run(tuple(run), structure, tuple(alike), rows, tile, named(f"to {number}"))(leaves)
        solved = {
            name: _of_programs(stage.functions[name], own, tile, known_as and f"{known_as} {number} {name}")
            for name, own in programs.items()
        }
        leaves, structure = jax.tree.flatten((kept, solved))
        alike, run = [False] * len(leaves), []
    return _run(tuple(run), structure, tuple(alike), rows, tile, named("to the end"))(leaves)


def _of_programs(function: Callable[[Tree], Tree], programs: Tree, tile: int, known_as: str | None) -> Tree:
    """Leaves (lanes, ..., programs)."""
    leaves, structure = jax.tree.flatten(programs)
    lanes, count = leaves[0].shape[0], max(x.shape[-1] for x in leaves)
    spread = [jnp.moveaxis(jnp.broadcast_to(x, (*x.shape[:-1], count)), -1, 1) for x in leaves]
    flat = [x.reshape(lanes * count, *x.shape[2:]) for x in spread]
    name = known_as and f"{known_as} {structure}"
    out = _run((function,), structure, (False,) * len(leaves), 0, tile * count, name)(flat)
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(lanes, count, *x.shape[1:]), 1, -1), out)


def _run(
    stages: tuple[Callable, ...], structure: Any, shared: tuple[bool, ...], rows: int, tile: int, known_as: str | None
) -> Callable:
    work = partial(tiled, stages, structure, rows, tile, known_as)

    def run(leaves: list[jax.Array]) -> Tree:
        out = _outline(work, leaves, shared, known_as)
        wanted, structure = jax.tree.flatten(out)
        flat = lambda *args: jax.tree.leaves(work(*args))
        events = tuple((x.shape[1:], x.dtype) for x in wanted)
        return jax.tree.unflatten(structure, independent(flat, leaves, shared, events))

    return run


_outlines: dict[Any, Tree] = {}


def _outline(work: Callable, leaves: list[jax.Array], shared: tuple[bool, ...], known_as: str | None) -> Tree:
    """Arrays like the results for one lane, traced once for what is known by its name."""
    given = [
        jax.ShapeDtypeStruct(x.shape if s else (1, *x.shape[1:]), x.dtype) for x, s in zip(leaves, shared, strict=True)
    ]
    key = known_as, tuple((x.shape, x.dtype) for x in given), shared, jax.config.read("jax_enable_x64")
    if known_as is None or key not in _outlines:
        platform = "cpu" if jax.default_backend() == "cpu" else "other"
        with on_one_device():
            out = jax.eval_shape(lambda leaves: work(leaves, shared, platform), given)
        if known_as is None:
            return out
        _outlines[key] = out
    return _outlines[key]


def tiled(
    stages: tuple[Callable, ...],
    structure: Any,
    rows: int,
    loose: int,
    known_as: str | None,
    leaves: list[jax.Array],
    shared: tuple[bool, ...],
    platform: str,
) -> Tree:
    """The stages in turn on one device, in tiles; see `map_lanes`. Rows are 0 where tiles cannot be compact."""
    lanes = next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    first = lambda last: stages[0](jax.tree.unflatten(structure, last))

    def enter(parts: list[jax.Array]) -> Tree:
        return first([x[..., None] if s else jnp.moveaxis(x, 0, -1) for x, s in zip(parts, shared, strict=True)])

    def leave(value: Tree) -> Tree:
        lanes = max(x.shape[-1] for x in jax.tree.leaves(value))
        return jax.tree.map(lambda x: jnp.moveaxis(jnp.broadcast_to(x, (*x.shape[:-1], lanes)), -1, 0), value)

    steps = [enter, *stages[1:]]
    steps[-1] = lambda value, last=steps[-1]: leave(last(value))

    def solve(value: Tree) -> Tree:
        return _in_turn(steps, value)

    def in_tiles(leaves: list[jax.Array], tile: int, one: Callable) -> Tree:
        count = -(-lanes // tile)
        own = [x for x, s in zip(leaves, shared, strict=True) if not s]
        own = [jnp.pad(x, [(0, count * tile - lanes)] + [(0, 0)] * (x.ndim - 1)) for x in own]

        def body(parts: list[jax.Array]) -> Tree:
            batched = iter(parts)
            return one([x if s else next(batched) for x, s in zip(leaves, shared, strict=True)])

        if count == 1:
            out = jax.tree.map(lambda x: x[None], body(own))
        else:
            out = lax.map(body, [x.reshape(count, tile, *x.shape[1:]) for x in own])
        return jax.tree.map(lambda x: x.reshape(count * tile, *x.shape[2:])[:lanes], out)

    def in_compact_tiles(leaves: list[jax.Array]) -> Tree:
        # XLA aborts where it finds more than 10 kB of constants in a tile that is one function.
        leaves = lax.optimization_barrier(leaves)
        size = min(1 << max(0, (TILE // max(rows, 1)).bit_length() - 1), 64)
        largest = max(size * x.size // x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
        compact = rows > 0 and lanes > size and largest <= LARGEST_LEAF
        size = size if rows and largest <= LARGEST_LEAF else loose

        def one(parts: list[jax.Array]) -> Tree:
            with fences(True):
                if not compact:
                    return solve(parts)
                value = parts
                for step in steps:
                    value = _as_one_function(step, value)
                return value

        return in_tiles(leaves, min(size, lanes), one)

    def at_once(leaves: list[jax.Array]) -> Tree:
        return in_tiles(leaves, min(LARGE_TILE, lanes), solve)

    def in_small_tiles(leaves: list[jax.Array]) -> Tree:
        with fences(platform == "cpu"):
            return in_tiles(leaves, SMALL_TILE, solve)

    if not isinstance(lanes, int):
        # How many there are is known when the program runs.
        return in_small_tiles(leaves)

    def whole(last: list[jax.Array]) -> Tree:
        with loops():
            return _in_turn((first, *stages[1:]), last)

    if platform == "cpu":
        return fused(whole, leaves, shared, in_compact_tiles, known_as)
    if platform == "cuda" and usable("cuda"):
        return fused(whole, leaves, shared, at_once, known_as, "cuda")
    return at_once(leaves)


def _in_turn(steps: Sequence[Callable[[Tree], Tree]], value: Tree) -> Tree:
    for step in steps:
        value = step(value)
    return value


def _as_one_function(step: Callable[[Tree], Tree], value: Tree) -> Tree:
    """XLA's CPU backend emits the step as one function, free of the overhead for every operation."""

    @jax.jit
    def run(value: Tree) -> tuple[Tree, list[jax.Array]]:
        # XLA aborts where a parameter of such a function ends up unused, so each is handed on.
        return step(value), [x.ravel()[0] for x in jax.tree.leaves(value)]

    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        return run(value)[0]
