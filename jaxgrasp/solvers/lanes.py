"""Batches as lanes: any leading axes and any nesting of vmap become one trailing axis, worked through in tiles.

A kernel is a function of arrays whose last axis is the lane; a leaf that all lanes share has a last axis of size 1. On
CPUs it becomes native code where it can, see `kernels`; else XLA cuts the lanes into tiles that stay in the cache.
Elsewhere they go at once, on GPUs as native code where that is asked for. A kernel may have a stage with more lanes,
one for each of several programs of a lane.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jax.experimental.xla_metadata import set_xla_metadata

from jaxgrasp.fence import fences
from jaxgrasp.kernels import fused, usable

Tree = Any
# Values of all rows of a tile: its working set has to fit in the second-level cache, and XLA's CPU backend would cut
# larger operations in parallel tasks, which it cannot do inside a tile.
TILE = 2304
LOOSE_TILE = 1024
# The same of what a tile is given: half a megabyte.
LARGEST_LEAF = 1 << 15
LARGE_TILE = 1 << 17


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
        again = lambda one: map_lanes(  # noqa: E731
            stages, jax.tree.unflatten(structure, one), shared, rows, compact=compact, tile=tile
        )
        return jax.tree.map(lambda x: jnp.zeros((0, *x.shape[1:]), x.dtype), jax.eval_shape(again, one))
    rows = rows if compact else 0
    run: list[Callable] = []
    named = lambda part: known_as and f"{known_as} {part} {structure}"  # noqa: E731
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
    @custom_vmap
    def run(leaves: list[jax.Array]) -> Tree:
        return tiled(stages, structure, shared, rows, leaves, tile, known_as)

    @run.def_vmap
    def mapped(size: int, batched: list, leaves: list[jax.Array]) -> tuple[Tree, Tree]:
        merged, still_shared, lanes = merged_axes(leaves, batched[0], shared, size)
        out = _run(stages, structure, still_shared, rows, tile, known_as)(merged)
        out = jax.tree.map(lambda x: x.reshape(size, lanes, *x.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return run


def merged_axes(
    leaves: list[jax.Array], mapped: Sequence[bool], shared: Sequence[bool], size: int
) -> tuple[list[jax.Array], tuple[bool, ...], int]:
    """Leaves with a leading mapped axis made part of the lanes, what is then still shared, and the lanes before.

    Args:
        leaves: with a leading axis of the given size where mapped, then the lanes where not shared.
        mapped: for every leaf.
        shared: for every leaf.
        size: of the mapped axis.
    """
    lanes = next(x.shape[1 if m else 0] for x, m, s in zip(leaves, mapped, shared, strict=True) if not s)
    merged = []
    for leaf, is_mapped, is_shared in zip(leaves, mapped, shared, strict=True):
        if is_shared and not is_mapped:
            merged.append(leaf)
            continue
        if is_shared:
            leaf = jnp.broadcast_to(leaf[:, None], (size, lanes, *leaf.shape[1:]))
        elif not is_mapped:
            leaf = jnp.broadcast_to(leaf, (size, *leaf.shape))
        merged.append(leaf.reshape(size * lanes, *leaf.shape[2:]))
    return merged, tuple(s and not m for s, m in zip(shared, mapped, strict=True)), lanes


def tiled(
    stages: tuple[Callable, ...],
    structure: Any,
    shared: tuple[bool, ...],
    rows: int,
    leaves: list[jax.Array],
    loose: int = LOOSE_TILE,
    known_as: str | None = None,
) -> Tree:
    """`map_lanes` of leaves, without a rule for `jax.vmap`; rows are 0 where tiles cannot be compact."""
    lanes = next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    first = lambda last: stages[0](jax.tree.unflatten(structure, last))  # noqa: E731

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
        count = math.ceil(lanes / tile)
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

    whole = partial(_in_turn, (first, *stages[1:]))

    def on_cpu() -> Tree:
        return fused(whole, leaves, shared, in_compact_tiles, known_as)

    def on_gpu() -> Tree:
        return fused(whole, leaves, shared, at_once, known_as, "cuda")

    def in_compact_tiles(leaves: list[jax.Array]) -> Tree:
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

    if jax.default_backend() == "cpu":
        return on_cpu()
    native = {"cpu": on_cpu, "cuda": on_gpu} if usable("cuda") else {"cpu": on_cpu}
    return lax.platform_dependent(**native, default=lambda: at_once(leaves))


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
