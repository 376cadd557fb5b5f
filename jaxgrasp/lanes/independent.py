"""Functions of independent lanes as a primitive of JAX, so that any program may contain them.

A plain element-wise function of JAX works wherever it is put: in a sharded program every device computes its part, in
`jax.shard_map` a result varies over the axes over which its arguments do, a program for another platform gets that
platform's code. The parts of a function of lanes (loops over tiles, compiled kernels) offer none of that by themselves.
`independent` binds such a function to a primitive with these rules:

    types        a result has the lanes' sharding and varies like the arguments, which are made alike first
    mapped axes  become lanes
    devices      each computes its own lanes, and nothing is sent; the function sees arrays of one device
    platforms    the function is called with the platform for which it is traced
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
# Takes the leaves, for each whether all lanes share it, and the platform.
Function = Callable[[list[jax.Array], tuple[bool, ...], str], list[jax.Array]]


def independent(function: Function, leaves: Sequence[jax.Array], shared: tuple[bool, ...], out: Events) -> list:
    """Run a function of lanes that have nothing to do with each other.

    Args:
        function: takes a list like `leaves`, `shared`, which `jax.vmap` may have changed, and the platform ("cpu",
            "cuda" or "other"); returns leaves (lanes, ...).
        leaves: (lanes, ...), or without the leading axis where shared.
        shared: for every leaf, whether it is the same for all lanes.
        out: shape without lanes and dtype of everything that the function returns.

    Returns:
        Leaves (lanes, ...).
    """
    operands = unify_types(leaves, shared)
    devices = _needs_devices() if allowed() else None
    return _independent_p.bind(*operands, function=function, shared=shared, out=out, devices=devices)


def one_lane(function: Callable[..., Tree], active: jax.Array, *arguments: Tree) -> Tree:
    """Run a function of one lane as `independent`; `jax.vmap` makes it one of many lanes.

    Args:
        function: takes `active` and the other arguments; it has no derivative.
        active: a scalar, of which every lane has its own.
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
    outputs, structure_out = jax.tree.flatten(like)
    shared = (False,) + (True,) * (len(leaves) - 1)
    out = independent(run, [leaves[0][None], *leaves[1:]], shared, tuple((x.shape, x.dtype) for x in outputs))
    return jax.tree.unflatten(structure_out, [x[0] for x in out])


@contextlib.contextmanager
def on_one_device() -> Iterator[None]:
    """Trace what is inside as a program of one device, without a mesh."""
    with jax.sharding.use_abstract_mesh(AbstractMesh((), ())), own_settings():
        yield


def unify_types(leaves: Sequence[jax.Array], shared: Sequence[bool]) -> list[jax.Array]:
    """Give all leaves the same varying axes and the same sharding of the lanes, as JAX's own operations do."""
    leaves = [jnp.asarray(x) for x in leaves]
    # Inside `jax.shard_map`: let every leaf vary over the axes over which any of them does.
    varying = [jax.typeof(x).manual_axis_type.varying for x in leaves]
    union = frozenset().union(*varying)
    for i, axes in enumerate(varying):
        if union - axes:
            leaves[i] = jax.lax.pcast(leaves[i], tuple(sorted(union - axes)), to="varying")
    # On a mesh with explicit axes: divide all leaves as the first one that is divided.
    mesh = next((jax.typeof(x).sharding.mesh for x in leaves if _has_explicit_axes(x)), None)
    if mesh is None:
        return leaves
    lead = next((s for s in (_lead(x) for x, s in zip(leaves, shared, strict=True) if not s) if s is not None), None)
    specs = [_lane_spec(None if s else lead, x.ndim) for x, s in zip(leaves, shared, strict=True)]
    return [
        x if not _has_explicit_axes(x) and not tuple(filter(None, spec)) or jax.typeof(x).sharding.spec == spec
        else jax.sharding.reshard(x, NamedSharding(mesh, spec))
        for x, spec in zip(leaves, specs, strict=True)
    ]  # fmt: skip


def with_automatic_axes(function: Callable[..., Tree], leaves: Sequence[jax.Array], shared: Sequence[bool]) -> Tree:
    """Call a function of lanes and let XLA choose how each operation inside is divided over devices.

    Args:
        function: takes the leaves; returns leaves (lanes, ...).
        leaves: (lanes, ...), or without the leading axis where shared.
        shared: for every leaf, whether it is the same for all lanes.
    """
    operands = unify_types(leaves, shared)
    batched = next((x for x, s in zip(operands, shared, strict=True) if not s), None)
    if batched is None or not _has_explicit_axes(batched):
        return function(*operands)
    with jax.sharding.use_abstract_mesh(jax.typeof(batched).sharding.mesh):
        return jax.sharding.auto_axes(function, out_sharding=PartitionSpec(_lead(batched)))(*operands)


def _has_explicit_axes(x: jax.Array) -> bool:
    """True if the array lies on a mesh whose sharding JAX tracks in types."""
    return AxisType.Explicit in jax.typeof(x).sharding.mesh.axis_types


def _lead(x: jax.Array) -> Any:
    """Read the axes of the mesh over which the lanes are divided."""
    return jax.typeof(x).sharding.spec[0]


def _lane_spec(lead: Any, ndim: int) -> PartitionSpec:
    """Divide the leading axis over `lead`, and no other axis."""
    return PartitionSpec(*([lead, *[None] * (ndim - 1)] if ndim else []))


def result_types(avals: Sequence[Any], shared: Sequence[bool], out: Events) -> list:
    """Make the types of results with the lanes of arguments whose types `unify_types` made the same."""
    batched = next(a for a, s in zip(avals, shared, strict=True) if not s)
    lead = batched.sharding.spec[0]
    return [
        ShapedArray(
            (batched.shape[0], *shape),
            dtype,
            sharding=batched.sharding.update(spec=_lane_spec(lead, len(shape) + 1)),
            manual_axis_type=batched.manual_axis_type,
        )
        for shape, dtype in out
    ]


_independent_p = Primitive("independent")
_independent_p.multiple_results = True
_independent_p.def_impl(partial(xla.apply_primitive, _independent_p))
_independent_p.def_abstract_eval(lambda *avals, shared, out, **_: result_types(avals, shared, out))


def _lower(ctx: Any, *leaves: Any, function: Function, shared: Any, out: Events, devices: Any, platform: str) -> Any:
    """Lower the function for one platform, with a rule for XLA's partitioner where XLA divides the program."""

    def run(*leaves: jax.Array) -> list[jax.Array]:
        with on_one_device():
            return function(list(leaves), shared, platform)

    plain = lambda avals: [ShapedArray(a.shape, a.dtype) for a in avals]
    inside = ctx.replace(avals_in=plain(ctx.avals_in), avals_out=plain(ctx.avals_out))
    divided = devices is not None and _is_divided(ctx.module_context.axis_context)
    with on_one_device():
        lowered = mlir.lower_fun(_partitionable(run, shared, inside) if divided else run, multiple_results=True)
        return lowered(inside, *leaves)


def _is_divided(context: Any) -> bool:
    """True if XLA divides this program over devices: it has several, and this is not inside `jax.shard_map`."""
    return getattr(context, "num_devices", 1) > 1 and getattr(context, "abstract_mesh", None) is not None


def _partitionable(run: Callable, shared: tuple[bool, ...], ctx: Any) -> Callable:
    """Give the function its rule for XLA's partitioner: lanes may be divided, no other axis."""
    names = iter(range(10_000))
    others: list[str] = []

    def mapping(ndim: int, has_lanes: bool) -> ArrayMapping:
        axes = [f"d{next(names)}" for _ in range(ndim - has_lanes)]
        others.extend(axes)
        return ArrayMapping(*["lanes"] * has_lanes, *axes)

    operands = tuple(mapping(len(a.shape), not s) for a, s in zip(ctx.avals_in, shared, strict=True))
    results = tuple(mapping(len(a.shape), True) for a in ctx.avals_out)
    rule = SdyShardingRule(operands, results, need_replication_factors=tuple(others))

    def partition(mesh: Any, operands: tuple, results: list) -> tuple:
        lead = next(x.sharding.spec[0] for x, s in zip(operands, shared, strict=True) if not s)
        place = lambda x, s: NamedSharding(mesh, _lane_spec(None if s else lead, len(x.shape)))
        return mesh, run, [place(x, False) for x in results], tuple(map(place, operands, shared))

    divided = custom_partitioning(run)
    divided.def_partition(partition, sharding_rule=rule)
    return divided


mlir.register_lowering(_independent_p, partial(_lower, platform="other"))
for _name in ("cpu", "cuda"):
    mlir.register_lowering(_independent_p, partial(_lower, platform=_name), platform=_name)


def _batch(args: Any, dims: Any, *, shared: Any, **params: Any) -> tuple[list, list]:
    """Make a mapped axis part of the lanes."""
    merged, still_shared, size, lanes = merge_axes(args, dims, shared)
    out = _independent_p.bind(*unify_types(merged, still_shared), shared=still_shared, **params)
    return [x.reshape(size, lanes, *x.shape[1:]) for x in out], [0] * len(out)


batching.primitive_batchers[_independent_p] = _batch


def merge_axes(
    args: Sequence[jax.Array], dims: Sequence[int | None], shared: Sequence[bool]
) -> tuple[list[jax.Array], tuple[bool, ...], int, int]:
    """Make a mapped axis part of the lanes.

    Args:
        args: the leaves; where not shared, the lanes lead, but for the mapped axis.
        dims: for every leaf, where the mapped axis is; None where it has none.
        shared: for every leaf, whether it is the same for all lanes.

    Returns:
        The leaves (size * lanes, ...), for every leaf whether it is still shared, the size of the mapped axis and the
        number of lanes before.
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
    """Make a parameter that has JAX lower a program with its devices known, as partitioning needs them.

    JAX looks for partitioned operations in the parameters of a program's operations; this is a jaxpr with one.
    """
    identity = custom_partitioning(lambda x: x)
    identity.def_partition(None, sharding_rule="i -> i")
    with on_one_device():
        return jax.make_jaxpr(identity)(jax.ShapeDtypeStruct((1,), bool))
