"""Batches as lanes: any leading axes and any nesting of vmap become one trailing axis, worked through in tiles.

A kernel is a function of arrays whose last axis is the lane; a leaf that all lanes share has a last axis of size 1. On
CPUs the kernel becomes native code where it can, see `kernels`; else XLA works on tiles of lanes that stay in cache. On
other platforms all lanes go at once, on GPUs as native code where that is asked for. A kernel may have a stage with
more lanes, one for each of several programs of a lane.
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
# A compact tile has this many values for all of its rows. Its working set has to fit in the second-level cache, and
# XLA's CPU backend would cut larger operations in parallel tasks, which it cannot do inside a tile.
TILE = 2304
# Lanes of a tile that is not compact.
LOOSE_TILE = 1024
# A compact tile's largest argument has at most this many values, for the same reasons: 256 kB in float64.
LARGEST_LEAF = 1 << 15
# Lanes that go at once on other platforms than CPUs.
LARGE_TILE = 1 << 17
# Lanes of a tile where the number of lanes is not known: small batches must not be padded to large tiles.
SMALL_TILE = 64


@dataclass(frozen=True)
class Each:
    """A stage that works on several programs of every lane, as lanes of their own.

    It takes and returns (kept, {name: tree}). It passes `kept` on; leaves of the trees have an axis of programs before
    the lanes, of size 1 where the programs share the leaf.
    """

    functions: dict[str, Callable[[Tree], Tree]]
    """The function of one program by the name of its tree; its leaves have one lane axis, the last."""


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
        stages: the kernel, in parts that are compiled separately and at the same time. The first one takes the tree of
            arguments with the lane axis last (size 1 where shared), each other one takes what the one before returns.
            The stages between two `Each` become one native function, and so does every function of an `Each`.
        arguments: leaves (lanes, ...), or without the leading axis where shared.
        shared: a tree like arguments of bools, whether all lanes share the leaf.
        compact: whether the kernel is free of library calls and large reductions, so that a stage of a tile can be one
            function on CPUs.
        rows: how many rows a lane has, which sets the size of a tile.
        tile: how many lanes a tile has where it cannot be one function.
        known_as: tells the kernel from all others, see `kernels.fused`.

    Returns:
        The result of the last stage, leaves (lanes, ...).
    """
    leaves, structure = jax.tree.flatten(arguments)
    shared_leaves = jax.tree.leaves(shared)
    if any(x.size == 0 for x in leaves):
        # A batch of no lanes: the shapes of the results are those of one lane.
        one = [x if s else jnp.zeros((1, *x.shape[1:]), x.dtype) for x, s in zip(leaves, shared_leaves, strict=True)]
        again = lambda one: map_lanes(
            stages, jax.tree.unflatten(structure, one), shared, rows, compact=compact, tile=tile
        )
        return jax.tree.map(lambda x: jnp.zeros((0, *x.shape[1:]), x.dtype), jax.eval_shape(again, one))
    rows = rows if compact else 0
    pending: list[Callable] = []
    named = lambda part: known_as and f"{known_as} {part} {structure}"
    for number, stage in enumerate(stages):
        if not isinstance(stage, Each):
            pending.append(stage)
            continue
        # Run the stages up to this one, then its functions.
        run = _make_run(tuple(pending), structure, tuple(shared_leaves), rows, tile, named(f"to {number}"))
        kept, programs = run(leaves)
        solved = {
            name: _map_programs(stage.functions[name], tree, tile, known_as and f"{known_as} {number} {name}")
            for name, tree in programs.items()
        }
        leaves, structure = jax.tree.flatten((kept, solved))
        shared_leaves, pending = [False] * len(leaves), []
    return _make_run(tuple(pending), structure, tuple(shared_leaves), rows, tile, named("to the end"))(leaves)


def _map_programs(function: Callable[[Tree], Tree], programs: Tree, tile: int, known_as: str | None) -> Tree:
    """Apply a function of one program to all programs of all lanes, leaves (lanes, ..., programs)."""
    leaves, structure = jax.tree.flatten(programs)
    lanes, count = leaves[0].shape[0], max(x.shape[-1] for x in leaves)
    spread = [jnp.moveaxis(jnp.broadcast_to(x, (*x.shape[:-1], count)), -1, 1) for x in leaves]
    flat = [x.reshape(lanes * count, *x.shape[2:]) for x in spread]
    name = known_as and f"{known_as} {structure}"
    run = _make_run((function,), structure, (False,) * len(leaves), 0, tile * count, name)
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(lanes, count, *x.shape[1:]), 1, -1), run(flat))


def _make_run(
    stages: tuple[Callable, ...], structure: Any, shared: tuple[bool, ...], rows: int, tile: int, known_as: str | None
) -> Callable[[list[jax.Array]], Tree]:
    """Make the function of leaves that runs the stages as `independent` lanes."""
    work = partial(run_in_tiles, stages, structure, rows, tile, known_as)

    def run(leaves: list[jax.Array]) -> Tree:
        outputs, structure = jax.tree.flatten(_result_of_one_lane(work, leaves, shared, known_as))
        flat = lambda *args: jax.tree.leaves(work(*args))
        events = tuple((x.shape[1:], x.dtype) for x in outputs)
        return jax.tree.unflatten(structure, independent(flat, leaves, shared, events))

    return run


_results: dict[Any, Tree] = {}


def _result_of_one_lane(
    work: Callable, leaves: list[jax.Array], shared: tuple[bool, ...], known_as: str | None
) -> Tree:
    """Find shapes and dtypes of the results for one lane; stages with a name are traced only once."""
    inputs = [
        jax.ShapeDtypeStruct(x.shape if s else (1, *x.shape[1:]), x.dtype) for x, s in zip(leaves, shared, strict=True)
    ]
    key = known_as, tuple((x.shape, x.dtype) for x in inputs), shared, jax.config.read("jax_enable_x64")
    if known_as is None or key not in _results:
        platform = "cpu" if jax.default_backend() == "cpu" else "other"
        with on_one_device():
            out = jax.eval_shape(lambda leaves: work(leaves, shared, platform), inputs)
        if known_as is None:
            return out
        _results[key] = out
    return _results[key]


def run_in_tiles(
    stages: tuple[Callable, ...],
    structure: Any,
    rows: int,
    loose: int,
    known_as: str | None,
    leaves: list[jax.Array],
    shared: tuple[bool, ...],
    platform: str,
) -> Tree:
    """Run the stages in turn on one device, in tiles, see `map_lanes`.

    Args:
        stages: functions of one tree, lanes last.
        structure: that of the tree of `leaves`.
        rows: how many rows a lane has; 0 where tiles cannot be compact.
        loose: how many lanes a tile has that is not compact.
        known_as: tells the stages from all others, see `kernels.fused`.
        leaves: (lanes, ...), or without the leading axis where shared.
        shared: for every leaf, whether it is the same for all lanes.
        platform: "cpu", "cuda" or "other".
    """
    lanes = _count_lanes(leaves, shared)
    first = lambda last: stages[0](jax.tree.unflatten(structure, last))
    steps = _with_lanes_first((first, *stages[1:]), shared)
    solve = partial(_in_turn, steps)

    if not isinstance(lanes, int):
        # Where the shape is symbolic, the program learns the number of lanes only when it runs.
        with fences(platform == "cpu"):
            return _map_tiles(solve, leaves, shared, SMALL_TILE)

    at_once = lambda leaves: _map_tiles(solve, leaves, shared, min(LARGE_TILE, lanes))

    def whole(last: list[jax.Array]) -> Tree:
        with loops():
            return _in_turn((first, *stages[1:]), last)

    if platform == "cpu":
        return fused(whole, leaves, shared, partial(_run_in_cached_tiles, steps, rows, loose, shared), known_as)
    if platform == "cuda" and usable("cuda"):
        return fused(whole, leaves, shared, at_once, known_as, "cuda")
    return at_once(leaves)


def _count_lanes(leaves: list[jax.Array], shared: tuple[bool, ...]) -> Any:
    """Read the number of lanes off a leaf that has them: an int, or a symbol of `jax.export`."""
    return next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)


def _with_lanes_first(stages: tuple[Callable, ...], shared: tuple[bool, ...]) -> list[Callable]:
    """Let the first stage take its leaves, and the last one return them, with the lanes leading."""

    def enter(parts: list[jax.Array]) -> Tree:
        return stages[0]([x[..., None] if s else jnp.moveaxis(x, 0, -1) for x, s in zip(parts, shared, strict=True)])

    def leave(value: Tree) -> Tree:
        lanes = max(x.shape[-1] for x in jax.tree.leaves(value))
        return jax.tree.map(lambda x: jnp.moveaxis(jnp.broadcast_to(x, (*x.shape[:-1], lanes)), -1, 0), value)

    steps = [enter, *stages[1:]]
    steps[-1] = lambda value, last=steps[-1]: leave(last(value))
    return steps


def _map_tiles(function: Callable, leaves: list[jax.Array], shared: tuple[bool, ...], tile: int) -> Tree:
    """Apply a function of leaves to one tile of lanes after another."""
    # Pad the lanes with zeros to a whole number of tiles.
    lanes = _count_lanes(leaves, shared)
    count = -(-lanes // tile)
    batched = [x for x, s in zip(leaves, shared, strict=True) if not s]
    batched = [jnp.pad(x, [(0, count * tile - lanes)] + [(0, 0)] * (x.ndim - 1)) for x in batched]

    def body(parts: list[jax.Array]) -> Tree:
        rest = iter(parts)
        return function([x if s else next(rest) for x, s in zip(leaves, shared, strict=True)])

    if count == 1:
        out = jax.tree.map(lambda x: x[None], body(batched))
    else:
        out = lax.map(body, [x.reshape(count, tile, *x.shape[1:]) for x in batched])
    return jax.tree.map(lambda x: x.reshape(count * tile, *x.shape[2:])[:lanes], out)


def _run_in_cached_tiles(
    steps: Sequence[Callable[[Tree], Tree]], rows: int, loose: int, shared: tuple[bool, ...], leaves: list[jax.Array]
) -> Tree:
    """Run the steps in tiles that stay in a CPU's cache, each step of a tile as one function where it is compact."""
    # XLA aborts where it finds more than 10 kB of constants in a tile that is one function.
    leaves = lax.optimization_barrier(leaves)
    lanes = _count_lanes(leaves, shared)
    size = min(1 << max(0, (TILE // max(rows, 1)).bit_length() - 1), 64)
    largest = max(size * x.size // x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    compact = rows > 0 and lanes > size and largest <= LARGEST_LEAF
    size = size if rows and largest <= LARGEST_LEAF else loose

    def one(parts: list[jax.Array]) -> Tree:
        with fences(True):
            if not compact:
                return _in_turn(steps, parts)
            return _in_turn([partial(_as_one_function, step) for step in steps], parts)

    return _map_tiles(one, leaves, shared, min(size, lanes))


def _in_turn(steps: Sequence[Callable[[Tree], Tree]], value: Tree) -> Tree:
    """Apply one step after the other."""
    for step in steps:
        value = step(value)
    return value


def _as_one_function(step: Callable[[Tree], Tree], value: Tree) -> Tree:
    """Apply a step that XLA's CPU backend emits as one function, free of the overhead for every operation."""

    @jax.jit
    def run(value: Tree) -> tuple[Tree, list[jax.Array]]:
        # XLA aborts where a parameter of such a function ends up unused, so each is handed on.
        return step(value), [x.ravel()[0] for x in jax.tree.leaves(value)]

    with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
        return run(value)[0]
