"""Functions of independent lanes as a primitive of JAX, so that any program may contain them.

A plain element-wise function of JAX works wherever it is put: in a sharded program every device computes its part, in
`jax.shard_map` a result varies over the axes over which its arguments do, a program for another platform gets that
platform's code. What a function of lanes is made of (loops over tiles, compiled kernels) offers none of that by
itself. `independent` binds one to a primitive with these rules:

    types        a result has the lanes' sharding and varies like the arguments, which are made alike first
    mapped axes  become lanes
    devices      each computes its own lanes, and nothing is sent; what is inside sees arrays of one device
    platforms    the function is told for which it is traced
"""

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.experimental.custom_partitioning import ArrayMapping, SdyShardingRule, custom_partitioning
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir, xla
from jax.sharding import AbstractMesh, AxisType, NamedSharding, PartitionSpec

from jaxgrasp.compiling import own_settings
from jaxgrasp.kernels import allowed

Tree = Any
Events = tuple[tuple[tuple[int, ...], Any], ...]
# Of the leaves, which all lanes share, and of the platform.
Function = Callable[[list[jax.Array], tuple[bool, ...], str], list[jax.Array]]


def independent(function: Function, leaves: Sequence[jax.Array], shared: tuple[bool, ...], out: Events) -> list:
    """Run a function of lanes.

    Args:
        function: of a list like `leaves`, of `shared`, which `jax.vmap` may have changed, and of the platform ("cpu",
            "cuda" or "other"); returns leaves (lanes, ...).
        leaves: (lanes, ...), or without the leading axis where shared.
        shared: for every leaf, whether it is the same for all lanes.
        out: shape without lanes and dtype of everything that the function returns.

    Returns:
        Leaves (lanes, ...).
    """
    given = alike(leaves, shared)
    devices = _needs_devices() if allowed() else None
    return _independent_p.bind(*given, function=function, shared=shared, out=out, devices=devices)


def one_lane(function: Callable[..., Tree], active: jax.Array, *arguments: Tree) -> Tree:
    """Run a function of one lane as `independent`; mapped by `jax.vmap`, it is one of many lanes.

    Args:
        function: takes `active` and the other arguments; it is not differentiated.
        active: a scalar, which every lane has for itself.
        arguments: trees of arrays.
    """
    leaves, structure = jax.tree.flatten((active, *arguments))

    def at(leaves: Sequence[jax.Array]) -> Tree:
        return function(*jax.tree.unflatten(structure, leaves))

    def run(leaves: list[jax.Array], shared: tuple[bool, ...], _: str) -> list[jax.Array]:
        axes = [None if s else 0 for s in shared]
        return jax.vmap(lambda *one: jax.tree.leaves(at(one)), in_axes=axes)(*leaves)

    with on_one_device():
        like = jax.eval_shape(at, [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves])
    wanted, structure_out = jax.tree.flatten(like)
    shared = (False,) + (True,) * (len(leaves) - 1)
    out = independent(run, [leaves[0][None], *leaves[1:]], shared, tuple((x.shape, x.dtype) for x in wanted))
    return jax.tree.unflatten(structure_out, [x[0] for x in out])


@contextlib.contextmanager
def on_one_device() -> Iterator[None]:
    """What is traced inside knows of no mesh."""
    with jax.sharding.use_abstract_mesh(AbstractMesh((), ())), own_settings():
        yield


def alike(leaves: Sequence[jax.Array], shared: Sequence[bool]) -> list[jax.Array]:
    """The leaves with the same varying axes and the same sharding of the lanes, as JAX's own operations have them."""
    leaves = [jnp.asarray(x) for x in leaves]
    varying = [jax.typeof(x).manual_axis_type.varying for x in leaves]
    every = frozenset().union(*varying)
    for i, own in enumerate(varying):
        if every - own:
            leaves[i] = jax.lax.pcast(leaves[i], tuple(sorted(every - own)), to="varying")
    if not any(_explicit(x) for x in leaves):
        return leaves
    lead = next((s for s in (_lead(x) for x, s in zip(leaves, shared, strict=True) if not s) if s is not None), None)
    wanted = [_spread(None if s else lead, x.ndim) for x, s in zip(leaves, shared, strict=True)]
    return [
        x if not _explicit(x) and not tuple(filter(None, spec)) or jax.typeof(x).sharding.spec == spec
        else jax.sharding.reshard(x, spec)
        for x, spec in zip(leaves, wanted, strict=True)
    ]  # fmt: skip


def automatically(function: Callable[..., Tree], leaves: Sequence[jax.Array], shared: Sequence[bool]) -> Tree:
    """A function of lanes, of which JAX need not know how each operation inside is divided.

    Args:
        function: of the leaves; returns leaves (lanes, ...).
        leaves: (lanes, ...), or without the leading axis where shared.
        shared: for every leaf.
    """
    given = alike(leaves, shared)
    own = next((x for x, s in zip(given, shared, strict=True) if not s), None)
    if own is None or not _explicit(own):
        return function(*given)
    with jax.sharding.use_abstract_mesh(jax.typeof(own).sharding.mesh):
        return jax.sharding.auto_axes(function, out_sharding=PartitionSpec(_lead(own)))(*given)


def _explicit(x: jax.Array) -> bool:
    return AxisType.Explicit in jax.typeof(x).sharding.mesh.axis_types


def _lead(x: jax.Array) -> Any:
    """Over which axes of the mesh the lanes are divided."""
    return jax.typeof(x).sharding.spec[0]


def _spread(lead: Any, ndim: int) -> PartitionSpec:
    return PartitionSpec(*([lead, *[None] * (ndim - 1)] if ndim else []))


def types(avals: Sequence[Any], shared: Sequence[bool], out: Events) -> list:
    """The types of results that have the lanes of arguments which are `alike`."""
    own = next(a for a, s in zip(avals, shared, strict=True) if not s)
    lead = own.sharding.spec[0]
    return [
        ShapedArray(
            (own.shape[0], *shape),
            dtype,
            sharding=own.sharding.update(spec=_spread(lead, len(shape) + 1)),
            manual_axis_type=own.manual_axis_type,
        )
        for shape, dtype in out
    ]


_independent_p = Primitive("independent")
_independent_p.multiple_results = True
_independent_p.def_impl(partial(xla.apply_primitive, _independent_p))
_independent_p.def_abstract_eval(lambda *avals, shared, out, **_: types(avals, shared, out))


def _lower(ctx: Any, *leaves: Any, function: Function, shared: Any, out: Events, devices: Any, platform: str) -> Any:
    def run(*leaves: jax.Array) -> list[jax.Array]:
        with on_one_device():
            return function(list(leaves), shared, platform)

    plain = lambda avals: [ShapedArray(a.shape, a.dtype) for a in avals]
    inside = ctx.replace(avals_in=plain(ctx.avals_in), avals_out=plain(ctx.avals_out))
    divided = devices is not None and _is_divided(ctx.module_context.axis_context)
    with on_one_device():
        lowered = mlir.lower_fun(_divided(run, shared, inside) if divided else run, multiple_results=True)
        return lowered(inside, *leaves)


def _is_divided(context: Any) -> bool:
    """Whether XLA divides this program over devices: not where it has one, nor inside `jax.shard_map`."""
    return getattr(context, "num_devices", 1) > 1 and getattr(context, "abstract_mesh", None) is not None


def _divided(run: Callable, shared: tuple[bool, ...], ctx: Any) -> Callable:
    """The function with its rule for XLA's partitioner: lanes may be divided, nothing else."""
    names = iter(range(10_000))
    others: list[str] = []

    def mapping(ndim: int, has_lanes: bool) -> ArrayMapping:
        own = [f"d{next(names)}" for _ in range(ndim - has_lanes)]
        others.extend(own)
        return ArrayMapping(*["lanes"] * has_lanes, *own)

    operands = tuple(mapping(len(a.shape), not s) for a, s in zip(ctx.avals_in, shared, strict=True))
    results = tuple(mapping(len(a.shape), True) for a in ctx.avals_out)
    rule = SdyShardingRule(operands, results, need_replication_factors=tuple(others))

    def partition(mesh: Any, given: tuple, wanted: list) -> tuple:
        lead = next(x.sharding.spec[0] for x, s in zip(given, shared, strict=True) if not s)
        place = lambda x, s: NamedSharding(mesh, _spread(None if s else lead, len(x.shape)))
        return mesh, run, [place(x, False) for x in wanted], tuple(map(place, given, shared))

    divided = custom_partitioning(run)
    divided.def_partition(partition, sharding_rule=rule)
    return divided


mlir.register_lowering(_independent_p, partial(_lower, platform="other"))
for _name in ("cpu", "cuda"):
    mlir.register_lowering(_independent_p, partial(_lower, platform=_name), platform=_name)


def _batch(args: Any, dims: Any, *, shared: Any, **params: Any) -> tuple[list, list]:
    merged, still, size, lanes = merged_axes(args, dims, shared)
    out = _independent_p.bind(*alike(merged, still), shared=still, **params)
    return [x.reshape(size, lanes, *x.shape[1:]) for x in out], [0] * len(out)


batching.primitive_batchers[_independent_p] = _batch


def merged_axes(
    args: Sequence[jax.Array], dims: Sequence[int | None], shared: Sequence[bool]
) -> tuple[list[jax.Array], tuple[bool, ...], int, int]:
    """Leaves with a mapped axis made part of the lanes, what is then still shared, the axis' size and the lanes before.

    Args:
        args: the leaves, with lanes leading, but for the mapped axis, where not shared.
        dims: for every leaf, where the mapped axis is; None where it has none.
        shared: for every leaf.
    """
    size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    front = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)]
    lanes = next(x.shape[0 if d is None else 1] for x, d, s in zip(front, dims, shared, strict=True) if not s)
    merged = []
    for leaf, dim, is_shared in zip(front, dims, shared, strict=True):
        if is_shared and dim is None:
            merged.append(leaf)
            continue
        if is_shared:
            leaf = jnp.broadcast_to(leaf[:, None], (size, lanes, *leaf.shape[1:]))
        elif dim is None:
            leaf = jnp.broadcast_to(leaf, (size, *leaf.shape))
        merged.append(leaf.reshape(size * lanes, *leaf.shape[2:]))
    return merged, tuple(s and d is None for s, d in zip(shared, dims, strict=True)), size, lanes


@functools.cache
def _needs_devices() -> Any:
    """An operation for whose sake JAX lowers a program with its devices known, as partitioning needs them."""
    some = custom_partitioning(lambda x: x)
    some.def_partition(None, sharding_rule="i -> i")
    with on_one_device():
        return jax.make_jaxpr(some)(jax.ShapeDtypeStruct((1,), bool))
