"""From a jaxpr to scalar expressions: every small axis is spelt out, loops stay loops.

A jaxpr over arrays of small static shapes is evaluated with arrays whose entries are `Value`s. What only moves entries
about (slices, transposes, gathers with known indices) costs nothing in the kernel.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxgrasp.kernels.expressions import Builder, Region, Value, kind_of

# Loops of at most so many rounds are spelt out where a round depends on its number.
_SPELT_OUT = 16
# Kernels of more operations would compile for too long.
_MOST_VALUES = 150_000


class Unsupported(Exception):
    """The jaxpr has something that fused kernels cannot do."""


@dataclass(eq=False)
class Loop:
    """A loop in a kernel's code.

    body: its region; `outputs` are the next values of `carries`, which start at `initial`.
    rounds: how many; None for as long as any problem's `condition` holds. Others' values then stay.
    """

    body: Region
    initial: list[Any]
    carries: list[Value]
    kinds: list[str]
    rounds: int | None
    condition: Any = None
    counter: Value | None = None
    outputs: list[Any] = field(default_factory=list)
    results: list[Value] = field(default_factory=list)


@dataclass(eq=False)
class Guard:
    """Code that runs where any problem's `condition` holds; its `outputs` are else zero."""

    body: Region
    condition: Any
    outputs: list[Any] = field(default_factory=list)
    results: list[Value] = field(default_factory=list)


@dataclass
class Program:
    """A kernel: what it reads, what it computes, what it leaves.

    shapes: of the inputs, dtypes with them; `shared` tells which all problems share.
    outputs: arrays of scalars.
    """

    builder: Builder
    inputs: list[tuple[tuple[int, ...], np.dtype]]
    shared: list[bool]
    outputs: list[np.ndarray]
    out_avals: list[tuple[tuple[int, ...], np.dtype]]


def lowered(jaxpr: ClosedJaxpr, shared: list[bool]) -> Program:
    """The program of one problem.

    Args:
        jaxpr: of a function of arrays with one trailing axis of size 1 in place of the problems.
        shared: for every argument, whether all problems share it.

    Raises:
        Unsupported: what fused kernels cannot do.
    """
    floats = {np.dtype(v.aval.dtype) for v in jaxpr.jaxpr.outvars if kind_of(v.aval.dtype) == "f"}
    floats |= {np.dtype(v.aval.dtype) for v in jaxpr.jaxpr.invars if kind_of(v.aval.dtype) == "f"}
    if len(floats) != 1 or not floats <= {np.dtype("float32"), np.dtype("float64")}:
        raise Unsupported(f"floating types {floats}")
    lowering = _Lowering(Builder(floats.pop()))
    inputs = []
    for number, (var, is_shared) in enumerate(zip(jaxpr.jaxpr.invars, shared, strict=True)):
        aval = var.aval
        kind = kind_of(aval.dtype)
        loads = [
            lowering.builder.value("shared" if is_shared else "own", (number, (i, None, 0)), kind)
            for i in range(math.prod(aval.shape))
        ]
        inputs.append(_array(loads, aval.shape))
    consts = [np.asarray(c) for c in jaxpr.consts]
    outputs = lowering.run(jaxpr.jaxpr, consts, inputs)
    avals = lambda vs: [(tuple(v.aval.shape), np.dtype(v.aval.dtype)) for v in vs]  # noqa: E731
    return Program(lowering.builder, avals(jaxpr.jaxpr.invars), shared, outputs, avals(jaxpr.jaxpr.outvars))


def _array(entries: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    out = np.empty(len(entries), object)
    out[:] = entries
    return out.reshape(shape)


def _objects(x: np.ndarray) -> np.ndarray:
    """As an array of scalars; constants are NumPy's."""
    return x if x.dtype == object else _array(list(x.ravel()), x.shape)


def _known(x: np.ndarray, dtype: Any) -> np.ndarray:
    """A typed array where all entries are constants."""
    if x.dtype != object or any(type(v) is Value for v in x.flat):
        return x
    return np.array(list(x.flat), dtype).reshape(x.shape)


class _Lowering:
    def __init__(self, builder: Builder) -> None:
        self.builder = builder

    def run(self, jaxpr: Jaxpr, consts: list[np.ndarray], args: list[np.ndarray]) -> list[np.ndarray]:
        """Evaluate."""
        known = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, args, strict=True))

        def read(v: Any) -> np.ndarray:
            return np.asarray(v.val, v.aval.dtype) if isinstance(v, Literal) else known[v]

        for eqn in jaxpr.eqns:
            outs = self.equation(eqn, [read(v) for v in eqn.invars])
            for var, out in zip(eqn.outvars, outs, strict=True):
                assert out.shape == tuple(var.aval.shape), (eqn, out.shape)
                known[var] = out
            if Value.count > self.limit:
                raise Unsupported("too many operations")
        return [read(v) for v in jaxpr.outvars]

    limit = math.inf

    def equation(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        """The results of one equation."""
        name, params = eqn.primitive.name, eqn.params
        if name in _CALLS:
            inner = params[_CALLS[name]]
            inner = inner if isinstance(inner, ClosedJaxpr) else jax.extend.core.ClosedJaxpr(inner, ())
            return self.run(inner.jaxpr, [np.asarray(c) for c in inner.consts], args)
        if name in _CONTROL:
            return getattr(self, _CONTROL[name])(params, args)
        aval = eqn.outvars[0].aval
        if name in _ELEMENTWISE:
            return [self.elementwise(_ELEMENTWISE[name], args, aval)]
        rule = _RULES.get(name)
        if rule is None:
            raise Unsupported(f"the operation {name}")
        return [np.asarray(rule(self, params, aval, *args))]

    def elementwise(self, op: str, args: list[np.ndarray], aval: Any) -> np.ndarray:
        """An operation entry by entry."""
        make, shape = self.builder.make, tuple(aval.shape)
        flat = [_objects(np.broadcast_to(x, shape) if x.shape != shape else x).ravel() for x in args]
        out = _array([make(op, *entries) for entries in zip(*flat, strict=True)], shape)
        return _known(out, aval.dtype)

    def fold(self, op: str, entries: list[Any]) -> Any:
        """Combine scalars in pairs."""
        while len(entries) > 1:
            pairs = [entries[i : i + 2] for i in range(0, len(entries), 2)]
            entries = [self.builder.make(op, *pair) if len(pair) == 2 else pair[0] for pair in pairs]
        return entries[0]

    def scan(self, params: dict, args: list[np.ndarray]) -> list[np.ndarray]:
        """A loop of known length: spelt out where it is short and a round depends on its number."""
        body, length, reverse = params["jaxpr"], params["length"], params["reverse"]
        n_consts, n_carry = params["num_consts"], params["num_carry"]
        consts, carry, xs = args[:n_consts], args[n_consts : n_consts + n_carry], args[n_consts + n_carry :]
        inner = [np.asarray(c) for c in body.consts]
        n_ys = len(body.jaxpr.outvars) - n_carry
        counters = _counters(body.jaxpr, n_consts, n_carry, carry)
        if length <= _SPELT_OUT and (xs or n_ys or any(used for _, used in counters.values())) or length == 1:
            rows: list[list[np.ndarray]] = [[] for _ in range(n_ys)]
            for i in range(length):
                at = length - 1 - i if reverse else i
                out = self.run(body.jaxpr, inner, [*consts, *carry, *[x[at] for x in xs]])
                carry = out[:n_carry]
                for row, y in zip(rows, out[n_carry:], strict=True):
                    row.append(y)
            ys = [self.stack(row[::-1] if reverse else row) for row in rows]
            return [*carry, *ys]
        if n_ys or reverse:
            raise Unsupported("a long loop with stacked results")
        region = Region(self.builder.region)
        counter = Value("counter", (), "u", region)
        base = {i: carry[i] for i in counters}
        inits = [x for i, x in enumerate(carry) if i not in counters]
        loop, values = self.open_loop(region, inits, length)
        loop.counter = counter
        given = iter(values)
        start = [
            _array([self.builder.make("add", counter, v) for v in base[i].ravel()], base[i].shape)
            if i in counters
            else next(given)
            for i in range(n_carry)
        ]
        rows_now = [self.entry(x, counter) for x in xs]
        out = self.run(body.jaxpr, inner, [*consts, *start, *rows_now])
        results = iter(self.close_loop(loop, [x for i, x in enumerate(out) if i not in counters], inits))
        last = lambda i: np.asarray(base[i] + length, base[i].dtype)  # noqa: E731
        return [last(i) if i in counters else next(results) for i in range(n_carry)]

    def stack(self, rows: list[np.ndarray]) -> np.ndarray:
        if all(r.dtype != object for r in rows):
            return np.stack(rows)
        return np.stack([_objects(r) for r in rows])

    def open_loop(self, region: Region, inits: list[np.ndarray], rounds: int | None) -> tuple[Loop, list[np.ndarray]]:
        """A loop whose carried arrays start at `inits`; the arrays inside."""
        loop = Loop(region, [], [], [], rounds)
        values = []
        for x in inits:
            kind = kind_of(x.dtype) if x.dtype != object else _kinds(x)
            inside = []
            for entry in _objects(x).ravel():
                inside.append(Value("carry", (loop, len(loop.carries)), kind, region))
                loop.initial.append(entry)
                loop.carries.append(inside[-1])
                loop.kinds.append(kind)
            values.append(_array(inside, x.shape))
        self.builder.region = region
        return loop, values

    def close_loop(self, loop: Loop, outputs: list[np.ndarray], like: list[np.ndarray]) -> list[np.ndarray]:
        """The loop is written; what it leaves."""
        loop.outputs = [v for x in outputs for v in _objects(x).ravel()]
        region = self.builder.region = loop.body.parent
        region.steps.append(loop)
        loop.results = [Value("result", (loop, i), kind, region) for i, kind in enumerate(loop.kinds)]
        results = iter(loop.results)
        return [_array([next(results) for _ in range(x.size)], x.shape) for x in like]

    def entry(self, x: np.ndarray, at: Value) -> np.ndarray:
        """x[at] for a counter."""
        return self.dynamic(x, (at, *[0] * (x.ndim - 1)), (1, *x.shape[1:]))[0]

    def while_loop(self, params: dict, args: list[np.ndarray]) -> list[np.ndarray]:
        """As long as any problem asks for it; the others' values stay."""
        n_cond, n_body = params["cond_nconsts"], params["body_nconsts"]
        cond_consts, body_consts, inits = args[:n_cond], args[n_cond : n_cond + n_body], args[n_cond + n_body :]
        region = Region(self.builder.region)
        loop, values = self.open_loop(region, inits, None)
        cond, body = params["cond_jaxpr"], params["body_jaxpr"]
        (asked,) = self.run(cond.jaxpr, [np.asarray(c) for c in cond.consts], [*cond_consts, *values])
        loop.condition = asked.item()
        out = self.run(body.jaxpr, [np.asarray(c) for c in body.consts], [*body_consts, *values])
        return self.close_loop(loop, out, inits)

    def cond(self, params: dict, args: list[np.ndarray]) -> list[np.ndarray]:
        """Each branch runs where any problem takes it."""
        index, *operands = args
        branches = params["branches"]
        index = index.item()
        results = None
        for number, branch in enumerate(branches):
            consts = [np.asarray(c) for c in branch.consts]
            if type(index) is not Value:
                if number != min(max(int(index), 0), len(branches) - 1):
                    continue
                return self.run(branch.jaxpr, consts, operands)
            taken = index if index.kind == "b" else self.builder.make("eq", index, np.int32(number))
            if index.kind == "b" and number == 0:
                taken = self.builder.make("not", index)
            guard = Guard(Region(self.builder.region, guarded=True), taken)
            self.builder.region = guard.body
            out = self.run(branch.jaxpr, consts, operands)
            outer = self.builder.region = guard.body.parent
            flat = [v for x in out for v in _objects(x).ravel()]
            local = [v for v in flat if type(v) is Value and v.region.depth > outer.depth]
            fresh = {v: Value("result", (guard, i), v.kind, outer) for i, v in enumerate(dict.fromkeys(local))}
            guard.outputs, guard.results = list(fresh), list(fresh.values())
            if fresh:
                outer.steps.append(guard)
            out = [_array([fresh.get(v, v) if type(v) is Value else v for v in _objects(x).ravel()], x.shape) for x in out]
            if results is None:
                results = out
            else:
                pick = lambda new, old: self.builder.make("select", taken, new, old)  # noqa: E731
                results = [
                    _array([pick(n, o) for n, o in zip(_objects(new).ravel(), _objects(old).ravel(), strict=True)], new.shape)
                    for new, old in zip(out, results, strict=True)
                ]
        return results

    def dynamic(self, x: np.ndarray, starts: tuple, sizes: tuple[int, ...]) -> np.ndarray:
        """A slice that starts where a counter says; XLA moves it inside, and so do we where that is known."""
        if all(type(s) is not Value for s in starts):
            corner = [min(max(int(s), 0), n - k) for s, n, k in zip(starts, x.shape, sizes, strict=True)]
            return x[tuple(slice(c, c + k) for c, k in zip(corner, sizes, strict=True))]
        moving = [axis for axis, s in enumerate(starts) if type(s) is Value]
        (axis,) = moving if len(moving) == 1 else (None,)
        if axis is None or starts[axis].kind != "u":
            raise Unsupported("an index that differs between problems")
        fixed = [0 if a == axis else min(max(int(s), 0), n - k) for a, (s, n, k) in enumerate(zip(starts, x.shape, sizes, strict=True))]
        first = x[tuple(slice(c, c + k) for c, k in zip(fixed, sizes, strict=True))]
        source, stride = self.memory(x, axis)
        out = []
        for v in first.ravel():
            op, (buffer, (offset, _, _)) = source(v)
            out.append(self.builder.value(op, (buffer, (offset, starts[axis], stride)), v.kind))
        return _array(out, first.shape)

    def memory(self, x: np.ndarray, axis: int) -> tuple[Callable, int]:
        """Where the entries of an array lie, and how far apart along an axis; they are put somewhere if need be."""
        flat = np.moveaxis(_objects(x), axis, 0).reshape(x.shape[axis], -1)
        if all(type(v) is Value and v.op in ("own", "shared") and v.args[1][1] is None for v in flat.flat):
            offsets = np.array([v.args[1][0] for v in flat.flat]).reshape(flat.shape)
            steps = np.diff(offsets, axis=0)
            if len({(v.op, v.args[0]) for v in flat.flat}) == 1 and (not steps.size or (steps == steps.flat[0]).all()):
                return (lambda v: (v.op, v.args)), int(steps.flat[0]) if steps.size else 0
        raise Unsupported("a long loop over computed arrays")


def _kind_of(v: Any) -> str:
    return v.kind if type(v) is Value else kind_of(v.dtype)


def _like(aval: Any, dtype: Any) -> Any:
    return jax.ShapeDtypeStruct(aval.shape, dtype)


def _kinds(x: np.ndarray) -> str:
    if x.dtype != object:
        return kind_of(x.dtype)
    kinds = {_kind_of(v) for v in x.flat}
    kinds = {"i" if k == "u" else k for k in kinds}
    (kind,) = kinds
    return kind


def _counters(body: Jaxpr, n_consts: int, n_carry: int, carry: list[np.ndarray]) -> dict[int, tuple[int, bool]]:
    """Carried integers that every round raises by one, and whether a round uses them for anything else."""
    found = {}
    for i in range(n_carry):
        var, out = body.invars[n_consts + i], body.outvars[i]
        if var.aval.shape != () or kind_of(var.aval.dtype) != "i" or carry[i].dtype == object:
            continue
        users = [e for e in body.eqns if any(v is var for v in e.invars)]
        raising = [e for e in users if e.primitive.name == "add" and e.outvars[0] is out and _is_one(e.invars)]
        if len(raising) == 1:
            found[i] = (i, len(users) > 1)
    return found


def _is_one(operands: list[Any]) -> bool:
    return any(isinstance(v, Literal) and v.val == 1 for v in operands)


_CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr", "remat": "jaxpr"}
_CALLS |= {"custom_vjp_call": "call_jaxpr", "checkpoint": "jaxpr", "core_call": "call_jaxpr"}
_CONTROL = {"scan": "scan", "while": "while_loop", "cond": "cond"}
_ELEMENTWISE = {name: name for name in ("add", "sub", "mul", "div", "max", "min", "neg", "abs", "sqrt", "rsqrt", "exp", "log")}
_ELEMENTWISE |= {name: name for name in ("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "xor", "not", "is_finite", "floor")}
_ELEMENTWISE |= {"add_any": "add"}


def _select(lower: _Lowering, params: dict, aval: Any, which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    if len(cases) == 2 and _kinds(which) == "b":
        return lower.elementwise("select", [which, cases[1], cases[0]], aval)
    out = cases[-1]
    for number in range(len(cases) - 2, -1, -1):
        taken = lower.elementwise("le", [which, np.full((), number, np.int32)], _like(aval, bool))
        out = lower.elementwise("select", [taken, cases[number], out], aval)
    return out


def _arg(better: str) -> Callable:
    def rule(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
        """The first of the best, along one axis."""
        (axis,) = params["axes"]
        rows = np.moveaxis(_objects(x), axis, 0).reshape(x.shape[axis], -1)
        make = lower.builder.make
        out = []
        for column in rows.T:
            best, where = column[0], np.int32(0)
            for number, entry in enumerate(column[1:], 1):
                if _kind_of(entry) == "b":
                    wins = make("and", entry, make("not", best)) if better == "gt" else make("and", best, make("not", entry))
                else:
                    wins = make(better, entry, best)
                best, where = make("select", wins, entry, best), make("select", wins, np.int32(number), where)
            out.append(where)
        return _known(_array(out, tuple(aval.shape)), aval.dtype)

    return rule


def _convert(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
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

    return _array([one(v) for v in x.ravel()], x.shape)


def _power(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    y, out = params["y"], None
    for _ in range(abs(y)):
        out = x if out is None else lower.elementwise("mul", [out, x], aval)
    one = np.ones(aval.shape, aval.dtype)
    return one if out is None else out if y > 0 else lower.elementwise("div", [one, out], aval)


def _square(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    return lower.elementwise("mul", [x, x], aval)


def _sign(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    one, zero = np.ones(aval.shape, aval.dtype), np.zeros(aval.shape, aval.dtype)
    negative = lower.elementwise("select", [lower.elementwise("lt", [x, zero], aval), -one, x], aval)
    return lower.elementwise("select", [lower.elementwise("gt", [x, zero], aval), one, negative], aval)


def _clamp(lower: _Lowering, params: dict, aval: Any, low: np.ndarray, x: np.ndarray, high: np.ndarray) -> np.ndarray:
    return lower.elementwise("min", [lower.elementwise("max", [x, low], aval), high], aval)


def _reduce(op: str) -> Callable:
    def rule(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
        axes = tuple(params["axes"])
        kept = tuple(n for a, n in enumerate(x.shape) if a not in axes)
        rows = _objects(np.moveaxis(x, axes, range(len(axes)))).reshape(-1, math.prod(kept))
        if not rows.shape[0]:
            raise Unsupported("a reduction of nothing")
        return _known(_array([lower.fold(op, list(rows[:, i])) for i in range(rows.shape[1])], kept), aval.dtype)

    return rule


def _broadcast(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    shape = [1] * len(aval.shape)
    for source, target in enumerate(params["broadcast_dimensions"]):
        shape[target] = x.shape[source]
    return np.broadcast_to(x.reshape(shape), aval.shape)


def _slice(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    strides = params["strides"] or (1,) * x.ndim
    parts = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(slice(*p) for p in parts)]


def _concatenate(lower: _Lowering, params: dict, aval: Any, *parts: np.ndarray) -> np.ndarray:
    parts = parts if all(p.dtype != object for p in parts) else tuple(map(_objects, parts))
    return np.concatenate(parts, params["dimension"])


def _stack(lower: _Lowering, params: dict, aval: Any, *parts: np.ndarray) -> np.ndarray:
    parts = parts if all(p.dtype != object for p in parts) else tuple(map(_objects, parts))
    return np.stack(parts, params.get("axis", params.get("dimension", 0)))


def _pad(lower: _Lowering, params: dict, aval: Any, x: np.ndarray, value: np.ndarray) -> np.ndarray:
    out = np.empty(aval.shape, object)
    out[...] = value.item() if value.dtype == object else value[()]
    target, source = [], []
    for (low, _, inner), size, whole in zip(params["padding_config"], x.shape, aval.shape, strict=True):
        at = low + np.arange(size) * (inner + 1)
        inside = (at >= 0) & (at < whole)
        target.append(at[inside])
        source.append(np.arange(size)[inside])
    out[np.ix_(*target)] = _objects(x)[np.ix_(*source)]
    return _known(out, aval.dtype)


def _dot(lower: _Lowering, params: dict, aval: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*contract_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*contract_b, *batch_b)]
    size = lambda x, axes: math.prod(x.shape[i] for i in axes)  # noqa: E731
    left = _objects(a).transpose(*batch_a, *free_a, *contract_a)
    left = left.reshape(size(a, batch_a), size(a, free_a), size(a, contract_a))
    right = _objects(b).transpose(*batch_b, *free_b, *contract_b)
    right = right.reshape(size(b, batch_b), size(b, free_b), size(b, contract_b))
    make = lower.builder.make
    out = [
        lower.fold("add", [make("mul", x, y) for x, y in zip(row, column, strict=True)])
        for rows, columns in zip(left, right, strict=True)
        for row in rows
        for column in columns
    ]
    return _known(_array(out, tuple(aval.shape)), aval.dtype)


def _iota(lower: _Lowering, params: dict, aval: Any) -> np.ndarray:
    shape = [1] * len(aval.shape)
    shape[params["dimension"]] = -1
    return np.broadcast_to(np.arange(aval.shape[params["dimension"]], dtype=aval.dtype).reshape(shape), aval.shape)


def _dynamic_slice(lower: _Lowering, params: dict, aval: Any, x: np.ndarray, *starts: np.ndarray) -> np.ndarray:
    return lower.dynamic(x, tuple(s.item() for s in starts), tuple(params["slice_sizes"]))


def _dynamic_update(lower: _Lowering, params: dict, aval: Any, x: np.ndarray, new: np.ndarray, *starts: np.ndarray) -> np.ndarray:
    corner = [s.item() for s in starts]
    if any(type(s) is Value for s in corner):
        raise Unsupported("an update whose place is not known")
    corner = [min(max(int(s), 0), n - k) for s, n, k in zip(corner, x.shape, new.shape, strict=True)]
    out = _objects(x).copy()
    out[tuple(slice(c, c + k) for c, k in zip(corner, new.shape, strict=True))] = _objects(new)
    return _known(out, aval.dtype)


def _places(shape: tuple[int, ...], window: tuple[int, ...], indices: np.ndarray, sizes: Any, out: tuple, dims: tuple) -> np.ndarray:
    """For every entry of a gather's result (or a scatter's updates), which entry of the operand it is, counted flat.

    Args:
        shape: of the operand.
        window: axes of the result that run along a slice.
        indices: starts of slices.
        sizes: of a slice along every axis of the operand.
        out: shape of the result.
        dims: axes of the operand that slices have not; those that the starts are of; operand's and indices' batch axes.
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


def _gather(lower: _Lowering, params: dict, aval: Any, x: np.ndarray, indices: np.ndarray) -> np.ndarray:
    d = params["dimension_numbers"]
    dims = (d.collapsed_slice_dims, d.start_index_map, d.operand_batching_dims, d.start_indices_batching_dims)
    return x.ravel()[_places(x.shape, d.offset_dims, indices, params["slice_sizes"], tuple(aval.shape), dims)]


def _scatter(combine: str | None) -> Callable:
    def rule(lower: _Lowering, params: dict, aval: Any, x: np.ndarray, indices: np.ndarray, new: np.ndarray) -> np.ndarray:
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
        out = _objects(x).ravel().copy()
        for place, value in zip(places.ravel(), _objects(new).ravel(), strict=True):
            out[place] = value if combine is None else lower.builder.make(combine, out[place], value)
        return _known(out.reshape(x.shape), aval.dtype)

    return rule


def _cholesky(lower: _Lowering, params: dict, aval: Any, x: np.ndarray) -> np.ndarray:
    """L with L L' = x; NaN where a pivot is negative."""
    make, size = lower.builder.make, x.shape[-1]
    out = np.empty(x.shape, object)
    out[...] = lower.builder.dtype.type(0)
    for index in np.ndindex(*x.shape[:-2]):
        a, root = _objects(x)[index], out[index]
        for j in range(size):
            for i in range(j, size):
                value = a[i, j]
                for k in range(j):
                    value = make("sub", value, make("mul", root[i, k], root[j, k]))
                root[i, j] = make("sqrt", value) if i == j else make("div", value, root[j, j])
    return _known(out, aval.dtype)


def _triangular(lower: _Lowering, params: dict, aval: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Substitution."""
    if not params["left_side"] or params["conjugate_a"]:
        raise Unsupported("triangular solves from the right")
    make, size = lower.builder.make, a.shape[-1]
    out = _objects(b).copy()
    for index in np.ndindex(*b.shape[:-2]):
        matrix = _objects(a)[index]
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
    return _known(out, aval.dtype)


_RULES: dict[str, Callable] = {
    "select_n": _select,
    "argmax": _arg("gt"),
    "argmin": _arg("lt"),
    "convert_element_type": _convert,
    "integer_pow": _power,
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
    "optimization_barrier": lambda lower, params, aval, x: x,
}
