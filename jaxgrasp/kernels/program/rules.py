"""Rules for the operations of a jaxpr on arrays of scalars.

A rule takes the lowering, the operation's parameters, shape and dtype of its (first) result, and the operands. It
returns the result, or a list of all results.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxgrasp.kernels.program.entries import array, common_kind, fold_constants, kind_of_scalar, like, objects
from jaxgrasp.kernels.program.expressions import Unsupported, Value, kind_of
from jaxgrasp.kernels.program.tables import sliced

# Operations entry by entry, by the name that JAX gives them.
ELEMENTWISE = {
    name: name
    for name in (
        *("add", "sub", "mul", "div", "max", "min", "neg", "abs", "sqrt", "rsqrt", "exp", "log", "floor"),
        *("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "xor", "not", "is_finite"),
    )
}
ELEMENTWISE["add_any"] = "add"


def _select(lower: Any, params: dict, aval: Any, which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    if len(cases) == 2 and common_kind(which) == "b":
        return lower.elementwise("select", [which, cases[1], cases[0]], aval)
    out = cases[-1]
    for number in range(len(cases) - 2, -1, -1):
        taken = lower.elementwise("le", [which, np.full((), number, np.int32)], like(aval, bool))
        out = lower.elementwise("select", [taken, cases[number], out], aval)
    return out


def _arg(better: str) -> Callable:
    def rule(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
        """Return the index of the first of the best entries along one axis."""
        (axis,) = params["axes"]
        rows = np.moveaxis(objects(x), axis, 0).reshape(x.shape[axis], -1)
        make = lower.builder.make
        out = []
        for column in rows.T:
            best, where = column[0], np.int32(0)
            for number, entry in enumerate(column[1:], 1):
                if kind_of_scalar(entry) == "b":
                    wins = (
                        make("and", entry, make("not", best))
                        if better == "gt"
                        else make("and", best, make("not", entry))
                    )
                else:
                    wins = make(better, entry, best)
                best, where = make("select", wins, entry, best), make("select", wins, np.int32(number), where)
            out.append(where)
        return fold_constants(array(out, tuple(aval.shape)), aval.dtype)

    return rule


def _convert(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    if x.dtype != object:
        return x.astype(aval.dtype)
    to, builder = np.dtype(aval.dtype), lower.builder
    kind = kind_of(to)

    def one(v: Any) -> Any:
        if type(v) is not Value:
            return v.astype(to)
        if v.kind == kind or (v.kind == "u" and kind == "i"):
            return v
        if v.kind == "b":
            return builder.make("select", v, to.type(1), to.type(0))
        if kind == "b":
            return builder.make("ne", v, (builder.dtype if v.kind == "f" else np.dtype("int32")).type(0))
        return builder.value("convert", (v,), kind)

    return array([one(v) for v in x.ravel()], x.shape)


def _power(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    y, out = params["y"], None
    for _ in range(abs(y)):
        out = x if out is None else lower.elementwise("mul", [out, x], aval)
    one = np.ones(aval.shape, aval.dtype)
    return one if out is None else out if y > 0 else lower.elementwise("div", [one, out], aval)


def _real_power(lower: Any, params: dict, aval: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Lower powers whose exponent is the same constant for all entries: an integer, 1/2 or -1/2."""
    exponents = {float(v) for v in objects(y).ravel() if type(v) is not Value}
    if y.dtype == object and any(type(v) is Value for v in y.flat) or len(exponents) != 1:
        raise Unsupported("a power that is computed")
    (exponent,) = exponents
    if exponent.is_integer():
        return _power(lower, {"y": int(exponent)}, aval, x)
    if exponent in (0.5, -0.5):
        return lower.elementwise("sqrt" if exponent > 0 else "rsqrt", [x], aval)
    raise Unsupported(f"the power {exponent}")


def _square(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    return lower.elementwise("mul", [x, x], aval)


def _sign(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    one, zero = np.ones(aval.shape, aval.dtype), np.zeros(aval.shape, aval.dtype)
    negative = lower.elementwise("select", [lower.elementwise("lt", [x, zero], aval), -one, x], aval)
    return lower.elementwise("select", [lower.elementwise("gt", [x, zero], aval), one, negative], aval)


def _clamp(lower: Any, params: dict, aval: Any, low: np.ndarray, x: np.ndarray, high: np.ndarray) -> np.ndarray:
    return lower.elementwise("min", [lower.elementwise("max", [x, low], aval), high], aval)


def _reduce(op: str) -> Callable:
    def rule(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
        axes = tuple(params["axes"])
        kept = tuple(n for a, n in enumerate(x.shape) if a not in axes)
        rows = objects(np.moveaxis(x, axes, range(len(axes)))).reshape(-1, math.prod(kept))
        if not rows.shape[0]:
            raise Unsupported("a reduction of nothing")
        if op in ("and", "or") and kind_of(aval.dtype) != "b":
            raise Unsupported("bits of integers")
        return fold_constants(array([lower.fold(op, list(rows[:, i])) for i in range(rows.shape[1])], kept), aval.dtype)

    return rule


def _broadcast(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    shape = [1] * len(aval.shape)
    for source, target in enumerate(params["broadcast_dimensions"]):
        shape[target] = x.shape[source]
    return np.broadcast_to(x.reshape(shape), aval.shape)


def _slice(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    strides = params["strides"] or (1,) * x.ndim
    parts = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(slice(*p) for p in parts)]


def _split(lower: Any, params: dict, aval: Any, x: np.ndarray) -> list[np.ndarray]:
    return np.split(x, np.cumsum(params["sizes"])[:-1], params["axis"])


def _unstack(lower: Any, params: dict, aval: Any, x: np.ndarray) -> list[np.ndarray]:
    return list(np.moveaxis(x, params["axis"], 0))


def _concatenate(lower: Any, params: dict, aval: Any, *parts: np.ndarray) -> np.ndarray:
    parts = parts if all(p.dtype != object for p in parts) else tuple(map(objects, parts))
    return np.concatenate(parts, params["dimension"])


def _stack(lower: Any, params: dict, aval: Any, *parts: np.ndarray) -> np.ndarray:
    parts = parts if all(p.dtype != object for p in parts) else tuple(map(objects, parts))
    return np.stack(parts, params.get("axis", params.get("dimension", 0)))


def _pad(lower: Any, params: dict, aval: Any, x: np.ndarray, value: np.ndarray) -> np.ndarray:
    out = np.empty(aval.shape, object)
    out[...] = value.item() if value.dtype == object else value[()]
    target, source = [], []
    for (low, _, inner), size, whole in zip(params["padding_config"], x.shape, aval.shape, strict=True):
        at = low + np.arange(size) * (inner + 1)
        inside = (at >= 0) & (at < whole)
        target.append(at[inside])
        source.append(np.arange(size)[inside])
    out[np.ix_(*target)] = objects(x)[np.ix_(*source)]
    return fold_constants(out, aval.dtype)


def _dot(lower: Any, params: dict, aval: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*contract_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*contract_b, *batch_b)]
    size = lambda x, axes: math.prod(x.shape[i] for i in axes)
    left = objects(a).transpose(*batch_a, *free_a, *contract_a)
    left = left.reshape(size(a, batch_a), size(a, free_a), size(a, contract_a))
    right = objects(b).transpose(*batch_b, *free_b, *contract_b)
    right = right.reshape(size(b, batch_b), size(b, free_b), size(b, contract_b))
    make = lower.builder.make
    out = [
        lower.fold("add", [make("mul", x, y) for x, y in zip(row, column, strict=True)])
        for rows, columns in zip(left, right, strict=True)
        for row in rows
        for column in columns
    ]
    return fold_constants(array(out, tuple(aval.shape)), aval.dtype)


def _iota(lower: Any, params: dict, aval: Any) -> np.ndarray:
    shape = [1] * len(aval.shape)
    shape[params["dimension"]] = -1
    return np.broadcast_to(np.arange(aval.shape[params["dimension"]], dtype=aval.dtype).reshape(shape), aval.shape)


def _dynamic_slice(lower: Any, params: dict, aval: Any, x: np.ndarray, *starts: np.ndarray) -> np.ndarray:
    return sliced(lower, x, tuple(s.item() for s in starts), tuple(params["slice_sizes"]))


def _dynamic_update(
    lower: Any, params: dict, aval: Any, x: np.ndarray, new: np.ndarray, *starts: np.ndarray
) -> np.ndarray:
    corner = [s.item() for s in starts]
    if any(type(s) is Value for s in corner):
        raise Unsupported("an update whose place is not fold_constants")
    corner = [min(max(int(s), 0), n - k) for s, n, k in zip(corner, x.shape, new.shape, strict=True)]
    out = objects(x).copy()
    out[tuple(slice(c, c + k) for c, k in zip(corner, new.shape, strict=True))] = objects(new)
    return fold_constants(out, aval.dtype)


def _places(
    shape: tuple[int, ...], window: tuple[int, ...], indices: np.ndarray, sizes: Any, out: tuple, dims: tuple
) -> np.ndarray:
    """Return, for every entry of a gather's result or of a scatter's updates, the number of its entry in the operand.

    Args:
        shape: of the operand.
        window: axes of the result that run along a slice.
        indices: starts of slices.
        sizes: of a slice along every axis of the operand.
        out: shape of the result.
        dims: axes of the operand that slices do not have, axes that the starts count along, and the batch axes of
            operand and indices.

    Raises:
        Unsupported: an index is computed, or out of bounds.
    """
    if indices.dtype == object:
        raise Unsupported("indices that are computed")
    collapsed, start_map, operand_batch, indices_batch = dims
    along = [a for a in range(len(shape)) if a not in (*collapsed, *operand_batch)]
    flat = np.arange(math.prod(shape)).reshape(shape)
    places = np.empty(out, int)
    for index in np.ndindex(*out):
        batch = tuple(i for a, i in enumerate(index) if a not in window)
        corner = [0] * len(shape)
        for axis, start in zip(start_map, indices[batch], strict=True):
            corner[axis] = int(start)
        for axis, source in zip(operand_batch, indices_batch, strict=True):
            corner[axis] = batch[source]
        if any(c < 0 or c + k > n for c, k, n in zip(corner, sizes, shape, strict=True)):
            raise Unsupported("an index out of bounds")
        for axis, a in zip(along, window, strict=True):
            corner[axis] += index[a]
        places[index] = flat[tuple(corner)]
    return places


def _gather(lower: Any, params: dict, aval: Any, x: np.ndarray, indices: np.ndarray) -> np.ndarray:
    d = params["dimension_numbers"]
    dims = (d.collapsed_slice_dims, d.start_index_map, d.operand_batching_dims, d.start_indices_batching_dims)
    return x.ravel()[_places(x.shape, d.offset_dims, indices, params["slice_sizes"], tuple(aval.shape), dims)]


def _scatter(combine: str | None) -> Callable:
    def rule(lower: Any, params: dict, aval: Any, x: np.ndarray, indices: np.ndarray, new: np.ndarray) -> np.ndarray:
        d = params["dimension_numbers"]
        dims = (
            d.inserted_window_dims,
            d.scatter_dims_to_operand_dims,
            d.operand_batching_dims,
            d.scatter_indices_batching_dims,
        )
        inside = iter([new.shape[a] for a in d.update_window_dims])
        absent = (*d.inserted_window_dims, *d.operand_batching_dims)
        sizes = [1 if a in absent else next(inside) for a in range(x.ndim)]
        places = _places(x.shape, d.update_window_dims, indices, sizes, new.shape, dims)
        out = objects(x).ravel().copy()
        for place, value in zip(places.ravel(), objects(new).ravel(), strict=True):
            out[place] = value if combine is None else lower.builder.make(combine, out[place], value)
        return fold_constants(out.reshape(x.shape), aval.dtype)

    return rule


def _cholesky(lower: Any, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    """Lower the factorisation x = L L'; L has NaN where a pivot is negative."""
    make, size = lower.builder.make, x.shape[-1]
    out = np.empty(x.shape, object)
    out[...] = lower.builder.dtype.type(0)
    for index in np.ndindex(*x.shape[:-2]):
        a, root = objects(x)[index], out[index]
        for j in range(size):
            for i in range(j, size):
                value = a[i, j]
                for k in range(j):
                    value = make("sub", value, make("mul", root[i, k], root[j, k]))
                root[i, j] = make("sqrt", value) if i == j else make("div", value, root[j, j])
    return fold_constants(out, aval.dtype)


def _triangular(lower: Any, params: dict, aval: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solve by forward or backward substitution."""
    if not params["left_side"] or params["conjugate_a"]:
        raise Unsupported("triangular solves from the right")
    make, size = lower.builder.make, a.shape[-1]
    out = objects(b).copy()
    for index in np.ndindex(*b.shape[:-2]):
        matrix = objects(a)[index]
        matrix = matrix.T if params["transpose_a"] else matrix
        rows = range(size) if params["lower"] != params["transpose_a"] else range(size - 1, -1, -1)
        for column in range(b.shape[-1]):
            done: list[int] = []
            for i in rows:
                value = out[index][i, column]
                for k in done:
                    value = make("sub", value, make("mul", matrix[i, k], out[index][k, column]))
                out[index][i, column] = value if params["unit_diagonal"] else make("div", value, matrix[i, i])
                done.append(i)
    return fold_constants(out, aval.dtype)


RULES: dict[str, Callable] = {
    "select_n": _select,
    "argmax": _arg("gt"),
    "argmin": _arg("lt"),
    "convert_element_type": _convert,
    "integer_pow": _power,
    "pow": _real_power,
    "square": _square,
    "sign": _sign,
    "clamp": _clamp,
    "reduce_sum": _reduce("add"),
    "reduce_max": _reduce("max"),
    "reduce_min": _reduce("min"),
    "reduce_and": _reduce("and"),
    "reduce_or": _reduce("or"),
    "reduce_prod": _reduce("mul"),
    "broadcast_in_dim": _broadcast,
    "reshape": lambda lower, params, aval, x: x.reshape(aval.shape),
    "squeeze": lambda lower, params, aval, x: x.reshape(aval.shape),
    "expand_dims": lambda lower, params, aval, x: x.reshape(aval.shape),
    "transpose": lambda lower, params, aval, x: x.transpose(params["permutation"]),
    "rev": lambda lower, params, aval, x: np.flip(x, params["dimensions"]),
    "slice": _slice,
    "split": _split,
    "unstack": _unstack,
    "concatenate": _concatenate,
    "stack": _stack,
    "pad": _pad,
    "dot_general": _dot,
    "iota": _iota,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update,
    "gather": _gather,
    "scatter": _scatter(None),
    "scatter-add": _scatter("add"),
    "cholesky": _cholesky,
    "triangular_solve": _triangular,
    "copy": lambda lower, params, aval, x: x,
    "stop_gradient": lambda lower, params, aval, x: x,
    "reshard": lambda lower, params, aval, x: x,
    "pvary": lambda lower, params, aval, x: x,
    "optimization_barrier": lambda lower, params, aval, x: x,
}
