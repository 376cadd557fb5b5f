"""Derivatives of lane kernels: linear maps over lanes that JAX can differentiate, transpose and batch in any nesting.

`map_lanes` hides its tiles from JAX's differentiation. A derivative goes through `linear_lanes`: a function
`f(data, tangents)`, linear in `tangents`, that again runs in tiles. Its own derivatives are maps of the same kind, made
from the function inside the tile:

    along tangents     f(data, tangents_dot)
    along data         d/d data f(data, tangents) . data_dot
    transposed         f(data, .)' cotangents

so reverse mode, and any order, cost one pass over the tiles each, and mapped axes become lanes. It is a primitive since
`custom_vjp` has no forward mode and `custom_jvp` would have JAX transpose the loop over tiles itself.

A map may come with a transpose of its own, written for tiles that are one function. The transpose that JAX makes has
operations that XLA's CPU backend does not allow in these (transposed broadcasts are reductions), so its tiles are not
compact.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir, xla

from jaxgrasp.compiling import own_settings
from jaxgrasp.lanes.independent import independent, merge_axes, result_types, unify_types
from jaxgrasp.lanes.tiles import LOOSE_TILE, run_in_tiles

Tree = Any
LinearFunction = Callable[[list[jax.Array], list[jax.Array]], list[jax.Array]]


class _Map(NamedTuple):
    """A linear map over lanes.

    kernel: takes data and tangents with the lanes last; linear in the tangents.
    shared: for every leaf of the data, whether all lanes share it.
    outputs: shape without lanes and dtype of everything that the kernel returns.
    adjoint: the hand-written transpose, which takes data and the cotangents of all outputs, None where zero; None where
        JAX is to transpose the kernel.
    rows: how many rows a lane has, which sets the size of a tile; 0 where tiles cannot be compact.
    """

    kernel: LinearFunction
    shared: tuple[bool, ...]
    outputs: tuple[tuple[tuple[int, ...], Any], ...]
    adjoint: Callable[[list[jax.Array], list[jax.Array | None]], list[jax.Array]] | None
    rows: int


def linear_lanes(function: Callable[[Tree, Tree], Tree], data: Tree, tangents: Tree, shared: Tree, like: Tree) -> Tree:
    """Run a function that is linear in its second argument over the leading axis of its arguments.

    Args:
        function: takes data and tangents with the lane axis last (size 1 where shared) and returns a tree like `like`,
            lanes last; differentiable as often as the result is to be.
        data: leaves (lanes, ...), or without the leading axis where shared.
        tangents: leaves (lanes, ...).
        shared: a tree like data of bools, whether all lanes share the leaf.
        like: arrays with the shapes and dtypes of the result, leaves (lanes, ...).

    Returns:
        A tree like `like`.
    """
    data_leaves, data_structure = jax.tree.flatten(data)
    tangent_leaves, tangent_structure = jax.tree.flatten(tangents)
    outputs, structure = jax.tree.flatten(like)

    def flat(data: list[jax.Array], tangents: list[jax.Array]) -> list[jax.Array]:
        return jax.tree.leaves(
            function(jax.tree.unflatten(data_structure, data), jax.tree.unflatten(tangent_structure, tangents))
        )

    spec = _Map(flat, tuple(jax.tree.leaves(shared)), _events(outputs), None, 0)
    return jax.tree.unflatten(structure, _bind(spec, data_leaves, tangent_leaves))


def transposed_lanes(
    adjoint: Callable[[Tree, Tree], Tree], data: Tree, tangents: Tree, shared: Tree, like: Tree, rows: int
) -> Tree:
    """Run the linear map whose transpose is `adjoint` over the leading axis of its arguments.

    Args:
        adjoint: takes data and cotangents (a tree like `like`, None where zero) with the lane axis last and returns a
            tree like `tangents`, linear in the cotangents.
        data: leaves (lanes, ...), or without the leading axis where shared.
        tangents: leaves (lanes, ...).
        shared: a tree like data of bools, whether all lanes share the leaf.
        like: arrays with the shapes and dtypes of the result, leaves (lanes, ...).
        rows: how many rows a lane has, which sets the size of a tile; 0 where the adjoint calls libraries.

    Returns:
        A tree like `like`.
    """
    data_leaves, data_structure = jax.tree.flatten(data)
    tangent_leaves, tangent_structure = jax.tree.flatten(tangents)
    outputs, structure = jax.tree.flatten(like)

    def flat(data: list[jax.Array], cotangents: list[jax.Array | None]) -> list[jax.Array]:
        back = adjoint(jax.tree.unflatten(data_structure, data), jax.tree.unflatten(structure, cotangents))
        leaves, back_structure = jax.tree.flatten(back)
        assert back_structure == tangent_structure
        return leaves

    def kernel(data: list[jax.Array], tangents: list[jax.Array]) -> list[jax.Array]:
        lanes = tangents[0].shape[-1]
        shapes = [jax.ShapeDtypeStruct((*x.shape[1:], lanes), x.dtype) for x in outputs]
        return jax.linear_transpose(partial(flat, data), shapes)(tangents)[0]

    spec = _Map(kernel, tuple(jax.tree.leaves(shared)), _events(outputs), flat, rows)
    return jax.tree.unflatten(structure, _bind(spec, data_leaves, tangent_leaves))


def _events(leaves: list[jax.Array]) -> tuple[tuple[tuple[int, ...], Any], ...]:
    """List the shapes without lanes and the dtypes of leaves."""
    return tuple((x.shape[1:], x.dtype) for x in leaves)


_linear_lanes_p = Primitive("linear_lanes")
_linear_lanes_p.multiple_results = True


def _bind(spec: _Map, data: list, tangents: list) -> list:
    """Apply the map, as one operation of the program."""
    args = [*data, *tangents]
    return _linear_lanes_p.bind(*unify_types(args, _shared(spec, len(args))), spec=spec)


def _split(spec: _Map, args: Any) -> tuple[list, list]:
    """Split the operands into data and tangents."""
    return list(args[: len(spec.shared)]), list(args[len(spec.shared) :])


def _run(*args: jax.Array, spec: _Map) -> list[jax.Array]:
    """Compute the map in tiles: the primitive's value."""
    tangents = _split(spec, args)[1]
    if tangents[0].shape[0] == 0:
        return [jnp.zeros((0, *shape), dtype) for shape, dtype in spec.outputs]
    stage = lambda leaves: spec.kernel(*_split(spec, leaves))
    rows = spec.rows if spec.adjoint is None else 0
    work = partial(run_in_tiles, (stage,), jax.tree.structure(list(args)), rows, LOOSE_TILE, None)
    return independent(work, args, _shared(spec, len(args)), spec.outputs)


_linear_lanes_p.def_impl(partial(xla.apply_primitive, _linear_lanes_p))
mlir.register_lowering(_linear_lanes_p, mlir.lower_fun(_run, multiple_results=True))
_linear_lanes_p.def_abstract_eval(lambda *avals, spec: result_types(avals, _shared(spec, len(avals)), spec.outputs))


def _shared(spec: _Map, count: int) -> tuple[bool, ...]:
    """Tell for every operand whether all lanes share it; tangents never are."""
    return spec.shared + (False,) * (count - len(spec.shared))


@own_settings()
def _jvp(primals: Any, dots: Any, *, spec: _Map) -> tuple[list, list]:
    """Differentiate f(data, tangents): f(data, tangents_dot) + d/d data f(data, tangents) . data_dot."""
    data, tangents = _split(spec, primals)
    data_dots, tangent_dots = _split(spec, dots)
    out = _bind(spec, data, tangents)
    parts = []
    # Along the tangents, in which the map is linear.
    if any(type(t) is not ad.Zero for t in tangent_dots):
        parts.append(_bind(spec, data, [ad.instantiate_zeros(t) for t in tangent_dots]))
    # Along the data that change: a map that is linear in their dots, and whose data are the old operands.
    moved = [i for i, t in enumerate(data_dots) if type(t) is not ad.Zero]
    if moved:
        lanes = tangents[0].shape[0]
        along = [_spread(ad.instantiate_zeros(data_dots[i]), lanes) if spec.shared[i] else data_dots[i] for i in moved]

        def kernel(operands: list[jax.Array], data_dots: list[jax.Array]) -> list[jax.Array]:
            data, tangents = _split(spec, operands)

            def at(values: list[jax.Array]) -> list[jax.Array]:
                new = list(data)
                for i, value in zip(moved, values, strict=True):
                    new[i] = value
                return spec.kernel(new, tangents)

            start = [jnp.broadcast_to(data[i], d.shape) for i, d in zip(moved, data_dots, strict=True)]
            return jax.jvp(at, (start,), (data_dots,))[1]

        shared = spec.shared + (False,) * len(tangents)
        change = spec._replace(kernel=kernel, shared=shared, adjoint=None, rows=0)
        parts.append(_bind(change, data + tangents, along))
    return out, [sum(each[1:], each[0]) for each in zip(*parts, strict=True)]


def _spread(leaf: jax.Array, lanes: int) -> jax.Array:
    """Give every lane its copy of a shared leaf."""
    return jnp.broadcast_to(leaf, (lanes, *leaf.shape))


def _transpose(cotangents: Any, *args: Any, spec: _Map) -> list:
    """Transpose the map with respect to its tangents: by its adjoint where it has one, else by JAX inside the tile."""
    data, tangents = _split(spec, args)
    nonzero = [i for i, ct in enumerate(cotangents) if type(ct) is not ad.Zero]
    # The map is linear in all of its tangents together, so JAX asks for all of them at once.
    avals = [t.aval for t in tangents]
    if not nonzero:
        return [None] * len(data) + [ad.Zero(a) for a in avals]

    def kernel(data: list[jax.Array], cotangents: list[jax.Array]) -> list[jax.Array]:
        if spec.adjoint is not None:
            padded: list[jax.Array | None] = [None] * len(spec.outputs)
            for i, cotangent in zip(nonzero, cotangents, strict=True):
                padded[i] = cotangent
            return spec.adjoint(data, padded)
        lanes = cotangents[0].shape[-1]
        like = [jax.ShapeDtypeStruct((*a.shape[1:], lanes), a.dtype) for a in avals]

        def part(tangents: list[jax.Array]) -> list[jax.Array]:
            out = spec.kernel(data, tangents)
            return [out[i] for i in nonzero]

        return jax.linear_transpose(part, like)(cotangents)[0]

    rows = 0 if spec.adjoint is None else spec.rows
    back = spec._replace(kernel=kernel, outputs=_events(avals), adjoint=None, rows=rows)
    back = _bind(back, data, [cotangents[i] for i in nonzero])
    return [None] * len(data) + back


def _batch(args: Any, dims: Any, *, spec: _Map) -> tuple[list, list]:
    """Make a mapped axis part of the lanes."""
    merged, still_shared, size, lanes = merge_axes(args, dims, _shared(spec, len(args)))
    count = len(spec.shared)
    out = _bind(spec._replace(shared=still_shared[:count]), merged[:count], merged[count:])
    return [x.reshape(size, lanes, *x.shape[1:]) for x in out], [0] * len(out)


ad.primitive_jvps[_linear_lanes_p] = _jvp
ad.primitive_transposes[_linear_lanes_p] = _transpose
batching.primitive_batchers[_linear_lanes_p] = _batch
