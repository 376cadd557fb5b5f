"""From a jaxpr to scalar expressions: every small axis is spelt out, loops stay loops.

A jaxpr over arrays of small static shapes is evaluated with arrays whose entries are `Value`s. What only moves entries
about (slices, transposes, gathers with known indices) costs nothing in the kernel.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxprs_in_params

from jaxgrasp.kernels.program.entries import array, aval_of, kinds_of, known, objects
from jaxgrasp.kernels.program.expressions import Address, Builder, Region, Unsupported, Value, kind_of
from jaxgrasp.kernels.program.rules import ELEMENTWISE, RULES

# Loops of at most so many rounds are spelt out: always, as the first round often starts from zeros and the last one
# leaves what nobody asks for; where a round depends on its number; and where each leaves a result.
_SHORT, _SPELT_OUT, _STACKED = 2, 16, 64
# Entries of all arrays in a kernel, of which a third to a half are operations; more would compile for minutes.
_MOST_ENTRIES = 400_000


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
    floats = {np.dtype(aval_of(v).dtype) for v in jaxpr.jaxpr.outvars if kind_of(aval_of(v).dtype) == "f"}
    floats |= {np.dtype(aval_of(v).dtype) for v in jaxpr.jaxpr.invars if kind_of(aval_of(v).dtype) == "f"}
    if len(floats) != 1 or not floats <= {np.dtype("float32"), np.dtype("float64")}:
        raise Unsupported(f"floating types {floats}")
    if _entries(jaxpr.jaxpr) > _MOST_ENTRIES:
        raise Unsupported("too many operations")
    lowering = _Lowering(Builder(floats.pop()))
    inputs = []
    for number, (var, is_shared) in enumerate(zip(jaxpr.jaxpr.invars, shared, strict=True)):
        aval = aval_of(var)
        kind = kind_of(aval.dtype)
        loads = [
            lowering.builder.value("shared" if is_shared else "own", (Address(number, i),), kind)
            for i in range(math.prod(aval.shape))
        ]
        inputs.append(array(loads, aval.shape))
    consts = [np.asarray(c) for c in jaxpr.consts]
    outputs = lowering.run(jaxpr.jaxpr, consts, inputs)
    avals = lambda vs: [(tuple(aval_of(v).shape), np.dtype(aval_of(v).dtype)) for v in vs]
    return Program(lowering.builder, avals(jaxpr.jaxpr.invars), shared, outputs, avals(jaxpr.jaxpr.outvars))


def _entries(jaxpr: Jaxpr) -> int:
    """Of all arrays that are computed, in loops once for each round that may be spelt out."""
    total = 0
    for eqn in jaxpr.eqns:
        total += sum(math.prod(aval_of(v).shape) for v in eqn.outvars)
        length = eqn.params.get("length", 1) if eqn.primitive.name == "scan" else 1
        inner = sum(_entries(j) for j in jaxprs_in_params(eqn.params))
        total += inner * (length if length <= _STACKED else 1)
    return total


class _Lowering:
    def __init__(self, builder: Builder) -> None:
        self.builder = builder

    def run(self, jaxpr: Jaxpr, consts: list[np.ndarray], args: list[np.ndarray]) -> list[np.ndarray]:
        """Evaluate."""
        bound = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, args, strict=True))

        def read(v: Any) -> np.ndarray:
            return np.asarray(v.val, aval_of(v).dtype) if isinstance(v, Literal) else bound[v]

        for eqn in jaxpr.eqns:
            outs = self.equation(eqn, [read(v) for v in eqn.invars])
            for var, out in zip(eqn.outvars, outs, strict=True):
                assert out.shape == tuple(aval_of(var).shape), (eqn, out.shape)
                bound[var] = out
        return [read(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, args: list[np.ndarray]) -> list[np.ndarray]:
        """The results of one equation."""
        name, params = eqn.primitive.name, eqn.params
        if name in _CALLS:
            inner = params[_CALLS[name]]
            inner = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
            return self.run(inner.jaxpr, [np.asarray(c) for c in inner.consts], args)
        if name in _CONTROL:
            return getattr(self, _CONTROL[name])(params, args)
        if not eqn.outvars:
            raise Unsupported(f"the operation {name}, which has no result")
        aval = eqn.outvars[0].aval
        if name in ELEMENTWISE:
            return [self.elementwise(ELEMENTWISE[name], args, aval)]
        rule = RULES.get(name)
        if rule is None:
            raise Unsupported(f"the operation {name}")
        out = rule(self, params, aval, *args)
        return out if isinstance(out, list) else [np.asarray(out)]

    def elementwise(self, op: str, args: list[np.ndarray], aval: Any) -> np.ndarray:
        """An operation entry by entry."""
        if op == "div" and kind_of(aval.dtype) != "f":
            raise Unsupported("division of integers")
        make, shape = self.builder.make, tuple(aval.shape)
        flat = [objects(np.broadcast_to(x, shape) if x.shape != shape else x).ravel() for x in args]
        out = array([make(op, *entries) for entries in zip(*flat, strict=True)], shape)
        return known(out, aval.dtype)

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
        numbered = xs or any(used for _, used in counters.values())
        if length <= _SHORT or (numbered and length <= _SPELT_OUT) or (n_ys and length <= _STACKED):
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
            array([self.builder.make("add", counter, v) for v in base[i].ravel()], base[i].shape)
            if i in counters
            else next(given)
            for i in range(n_carry)
        ]
        rows_now = [self.entry(x, counter) for x in xs]
        out = self.run(body.jaxpr, inner, [*consts, *start, *rows_now])
        results = iter(self.close_loop(loop, [x for i, x in enumerate(out) if i not in counters], inits))
        last = lambda i: np.asarray(base[i] + length, base[i].dtype)
        return [last(i) if i in counters else next(results) for i in range(n_carry)]

    def stack(self, rows: list[np.ndarray]) -> np.ndarray:
        if all(r.dtype != object for r in rows):
            return np.stack(rows)
        return np.stack([objects(r) for r in rows])

    def open_loop(self, region: Region, inits: list[np.ndarray], rounds: int | None) -> tuple[Loop, list[np.ndarray]]:
        """A loop whose carried arrays start at `inits`; the arrays inside."""
        loop = Loop(region, [], [], [], rounds)
        values = []
        for x in inits:
            kind = kind_of(x.dtype) if x.dtype != object else kinds_of(x)
            inside = []
            for entry in objects(x).ravel():
                inside.append(Value("carry", (loop, len(loop.carries)), kind, region))
                loop.initial.append(entry)
                loop.carries.append(inside[-1])
                loop.kinds.append(kind)
            values.append(array(inside, x.shape))
        self.builder.region = region
        return loop, values

    def close_loop(self, loop: Loop, outputs: list[np.ndarray], like: list[np.ndarray]) -> list[np.ndarray]:
        """The loop is written; what it leaves."""
        loop.outputs = [v for x in outputs for v in objects(x).ravel()]
        region = self.builder.region = loop.body.outer
        region.steps.append(loop)
        loop.results = [Value("result", (loop, i), kind, region) for i, kind in enumerate(loop.kinds)]
        results = iter(loop.results)
        return [array([next(results) for _ in range(x.size)], x.shape) for x in like]

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
        results: list[np.ndarray] | None = None
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
            outer = self.builder.region = guard.body.outer
            flat = [v for x in out for v in objects(x).ravel()]
            local = [v for v in flat if type(v) is Value and v.region.depth > outer.depth]
            fresh = {v: Value("result", (guard, i), v.kind, outer) for i, v in enumerate(dict.fromkeys(local))}
            guard.outputs, guard.results = list(fresh), list(fresh.values())
            if fresh:
                outer.steps.append(guard)
            out = [
                array([fresh.get(v, v) if type(v) is Value else v for v in objects(x).ravel()], x.shape) for x in out
            ]
            results = out if results is None else self.choose(taken, out, results)
        assert results is not None
        return results

    def linear_solve(self, params: dict, args: list[np.ndarray]) -> list[np.ndarray]:
        """What solves the system, among what JAX is told about it."""
        lengths, solve = params["const_lengths"], params["jaxprs"].solve
        before = lengths.matvec + lengths.vecmat
        consts, right = args[before : before + lengths.solve], args[sum(lengths) :]
        return self.run(solve.jaxpr, [np.asarray(c) for c in solve.consts], [*consts, *right])

    def choose(self, taken: Any, new: list[np.ndarray], old: list[np.ndarray]) -> list[np.ndarray]:
        """The new arrays where taken, else the old ones."""
        make = self.builder.make
        out = []
        for these, those in zip(new, old, strict=True):
            pairs = zip(objects(these).ravel(), objects(those).ravel(), strict=True)
            out.append(array([make("select", taken, a, b) for a, b in pairs], these.shape))
        return out

    def dynamic(self, x: np.ndarray, starts: tuple, sizes: tuple[int, ...]) -> np.ndarray:
        """A slice that starts where a counter says; XLA moves it inside, and so do we where that is known."""
        if all(type(s) is not Value for s in starts):
            corner = [min(max(int(s), 0), n - k) for s, n, k in zip(starts, x.shape, sizes, strict=True)]
            return x[tuple(slice(c, c + k) for c, k in zip(corner, sizes, strict=True))]
        moving = [axis for axis, s in enumerate(starts) if type(s) is Value]
        (axis,) = moving if len(moving) == 1 else (None,)
        if axis is None or starts[axis].kind != "u":
            raise Unsupported("an index that differs between problems")
        fixed = [
            0 if a == axis else min(max(int(s), 0), n - k)
            for a, (s, n, k) in enumerate(zip(starts, x.shape, sizes, strict=True))
        ]
        first = x[tuple(slice(c, c + k) for c, k in zip(fixed, sizes, strict=True))]
        stride = self.stride(x, axis)
        out = []
        for v in first.ravel():
            moving = v.address._replace(counter=starts[axis], stride=stride)
            out.append(self.builder.value(v.op, (moving,), v.kind))
        return array(out, first.shape)

    def stride(self, x: np.ndarray, axis: int) -> int:
        """How far apart the entries of an array lie along an axis.

        Raises:
            Unsupported: the entries do not lie at equal distances in one argument, at addresses without a counter.
        """
        flat = np.moveaxis(objects(x), axis, 0).reshape(x.shape[axis], -1)
        if all(type(v) is Value and v.op in ("own", "shared") and v.address.counter is None for v in flat.flat):
            offsets = np.array([v.address.offset for v in flat.flat]).reshape(flat.shape)
            steps = np.diff(offsets, axis=0)
            buffers = {(v.op, v.address.buffer) for v in flat.flat}
            if len(buffers) == 1 and (not steps.size or (steps == steps.flat[0]).all()):
                return int(steps.flat[0]) if steps.size else 0
        raise Unsupported("a long loop over computed arrays")


def _counters(body: Jaxpr, n_consts: int, n_carry: int, carry: list[np.ndarray]) -> dict[int, tuple[int, bool]]:
    """Carried integers that every round raises by one, and whether a round uses them for anything else."""
    found = {}
    for i in range(n_carry):
        var, out = body.invars[n_consts + i], body.outvars[i]
        aval = aval_of(var)
        if aval.shape != () or kind_of(aval.dtype) != "i" or carry[i].dtype == object:
            continue
        users = [e for e in body.eqns if any(v is var for v in e.invars)]
        raising = [e for e in users if e.primitive.name == "add" and e.outvars[0] is out and _is_one(e.invars)]
        if len(raising) == 1:
            found[i] = (i, len(users) > 1)
    return found


def _is_one(operands: list[Any]) -> bool:
    return any(isinstance(v, Literal) and v.val == 1 for v in operands)


_CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "remat": "jaxpr",
}
_CALLS |= {"custom_vjp_call": "call_jaxpr", "checkpoint": "jaxpr", "core_call": "call_jaxpr"}
_CONTROL = {"scan": "scan", "while": "while_loop", "cond": "cond", "custom_linear_solve": "linear_solve"}
