"""Lower a jaxpr to scalar expressions: arrays are unrolled to their entries, loops stay loops.

A jaxpr over arrays of small static shapes is evaluated with arrays whose entries are `Value`s. Operations that only
move entries (slices, transposes, gathers with known indices) cost nothing in the kernel.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxgrasp.kernels.program.entries import array, aval_of, common_kind, fold_constants, objects
from jaxgrasp.kernels.program.expressions import Address, Builder, Region, Table, Unsupported, Value, kind_of
from jaxgrasp.kernels.program.rules import ELEMENTWISE, RULES
from jaxgrasp.kernels.program.tables import sliced, stacked
from jaxgrasp.kernels.program.unrolling import MOST_ENTRIES, entries_of, may_unroll

# The type of the operands of operations that have instructions for one type alone.
_ONLY = {"div": "f", "abs": "f", "and": "b", "or": "b", "xor": "b", "not": "b"}


@dataclass(eq=False)
class Loop:
    """A loop in a kernel's code; it is a step of the region around it.

    body: the region of one round.
    initial: for every carried scalar, its value before the first round.
    carries: the carried scalars at the beginning of a round, values of `body`.
    kinds: the types of the carried scalars.
    rounds: how many rounds there are; None for as long as the `condition` of any lane holds. The carried scalars of
        lanes whose condition does not hold stay as they are.
    condition: a scalar of `body` that depends on `carries`; None where `rounds` is known.
    counter: the number of the round, a value of type "u" in `body`; None where `rounds` is.
    outputs: the carried scalars at the end of a round.
    results: the carried scalars after the last round, values of the region around the loop.
    filled: tables that are written before the first round, with their entries.
    stacked: tables that rounds write, with the scalars that each round writes behind those of the one before.
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
    filled: list[tuple[Table, list[Any]]] = field(default_factory=list)
    stacked: list[tuple[Table, list[Value]]] = field(default_factory=list)


@dataclass(eq=False)
class Guard:
    """Code that runs if the `condition` of any lane holds; it is a step of the region around it.

    body: the region of the code.
    condition: a scalar of the region around the guard.
    outputs: the scalars of `body` that are used after the guard.
    results: these scalars after the guard, values of the region around it; they are zero where the code did not run.
    """

    body: Region
    condition: Any
    outputs: list[Any] = field(default_factory=list)
    results: list[Value] = field(default_factory=list)


@dataclass
class ScalarProgram:
    """A kernel as scalar operations on one lane.

    builder: made all values; its region is the outermost one, whose steps are the kernel's loops and guards.
    inputs: shape and dtype of every argument.
    shared: for every argument, whether all lanes share it.
    outputs: arrays of scalars, the results.
    out_avals: shape and dtype of every result.
    """

    builder: Builder
    inputs: list[tuple[tuple[int, ...], np.dtype]]
    shared: list[bool]
    outputs: list[np.ndarray]
    out_avals: list[tuple[tuple[int, ...], np.dtype]]


def lower(jaxpr: ClosedJaxpr, shared: list[bool]) -> ScalarProgram:
    """Lower a function of one lane to scalar operations.

    Args:
        jaxpr: of a function of arrays with one trailing axis of size 1 in place of the lanes.
        shared: for every argument, whether all lanes share it.

    Raises:
        Unsupported: the function has no floating types or several, too many operations, or one without a rule.
    """
    floats = {np.dtype(aval_of(v).dtype) for v in jaxpr.jaxpr.outvars if kind_of(aval_of(v).dtype) == "f"}
    floats |= {np.dtype(aval_of(v).dtype) for v in jaxpr.jaxpr.invars if kind_of(aval_of(v).dtype) == "f"}
    if len(floats) != 1 or not floats <= {np.dtype("float32"), np.dtype("float64")}:
        raise Unsupported(f"floating types {floats}")
    if entries_of(jaxpr.jaxpr) > MOST_ENTRIES:
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
    return ScalarProgram(lowering.builder, avals(jaxpr.jaxpr.invars), shared, outputs, avals(jaxpr.jaxpr.outvars))


class _Lowering:
    """Evaluates jaxprs with arrays of scalars; rules use its methods.

    loops: those that are being written, by the regions of their bodies.
    tables: those that were filled, by where they are and what is in them, see `tables`.
    count: how many tables there are.
    """

    def __init__(self, builder: Builder) -> None:
        self.builder = builder
        self.loops: dict[Region, Loop] = {}
        self.tables: dict[Any, Table] = {}
        self.count = 0

    def run(self, jaxpr: Jaxpr, consts: list[np.ndarray], args: list[np.ndarray]) -> list[np.ndarray]:
        """Evaluate a jaxpr; return its results."""
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
        """Evaluate one equation; return its results."""
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
        """Apply an operation entry by entry."""
        if kind_of(aval.dtype) != _ONLY.get(op, kind_of(aval.dtype)):
            raise Unsupported(f"the operation {op} on values of type {aval.dtype}")
        make, shape = self.builder.make, tuple(aval.shape)
        flat = [objects(np.broadcast_to(x, shape) if x.shape != shape else x).ravel() for x in args]
        out = array([make(op, *entries) for entries in zip(*flat, strict=True)], shape)
        return fold_constants(out, aval.dtype)

    def fold(self, op: str, entries: list[Any]) -> Any:
        """Combine scalars by an operation, in pairs."""
        while len(entries) > 1:
            pairs = [entries[i : i + 2] for i in range(0, len(entries), 2)]
            entries = [self.builder.make(op, *pair) if len(pair) == 2 else pair[0] for pair in pairs]
        return entries[0]

    def scan(self, params: dict, args: list[np.ndarray]) -> list[np.ndarray]:
        """Lower a loop of known length; unroll it where it is short."""
        body, length, reverse = params["jaxpr"], params["length"], params["reverse"]
        n_consts, n_carry = params["num_consts"], params["num_carry"]
        consts, carry, xs = args[:n_consts], args[n_consts : n_consts + n_carry], args[n_consts + n_carry :]
        inner = [np.asarray(c) for c in body.consts]
        # Integers that only count rounds are not carried: they are the loop's counter and where they start.
        counters = _counters(body.jaxpr, n_consts, n_carry, carry)
        counted = xs or any(used for _, used in counters.values())
        if may_unroll(params, bool(counted)):
            return self.unroll(params, consts, carry, xs)
        if reverse:
            raise Unsupported("a long loop from the end")
        region = Region(self.builder.region)
        counter = Value("counter", (), "u", region)
        base = {i: carry[i] for i in counters}
        inits = [x for i, x in enumerate(carry) if i not in counters]
        loop, values = self.open_loop(region, inits, length)
        loop.counter = counter
        carried = iter(values)
        start = [
            array([self.builder.make("add", counter, v) for v in base[i].ravel()], base[i].shape)
            if i in counters
            else next(carried)
            for i in range(n_carry)
        ]
        rows_now = [sliced(self, x, (counter, *[0] * (x.ndim - 1)), (1, *x.shape[1:]))[0] for x in xs]
        out = self.run(body.jaxpr, inner, [*consts, *start, *rows_now])
        left = [x for i, x in enumerate(out[:n_carry]) if i not in counters]
        results = iter(self.close_loop(loop, left, inits))
        last = lambda i: np.asarray(base[i] + length, base[i].dtype)
        carried_out = [last(i) if i in counters else next(results) for i in range(n_carry)]
        return [*carried_out, *[stacked(self, loop, length, y) for y in out[n_carry:]]]

    def unroll(
        self, params: dict, consts: list[np.ndarray], carry: list[np.ndarray], xs: list[np.ndarray]
    ) -> list[np.ndarray]:
        """Evaluate a scan's rounds one after the other."""
        body, length, reverse = params["jaxpr"], params["length"], params["reverse"]
        inner = [np.asarray(c) for c in body.consts]
        rows: list[list[np.ndarray]] = [[] for _ in range(len(body.jaxpr.outvars) - len(carry))]
        for i in range(length):
            at = length - 1 - i if reverse else i
            out = self.run(body.jaxpr, inner, [*consts, *carry, *[x[at] for x in xs]])
            carry = out[: len(carry)]
            for row, y in zip(rows, out[len(carry) :], strict=True):
                row.append(y)
        return [*carry, *[self.stack(row[::-1] if reverse else row) for row in rows]]

    def stack(self, rows: list[np.ndarray]) -> np.ndarray:
        """Stack arrays along a new leading axis."""
        if all(r.dtype != object for r in rows):
            return np.stack(rows)
        return np.stack([objects(r) for r in rows])

    def open_loop(self, region: Region, inits: list[np.ndarray], rounds: int | None) -> tuple[Loop, list[np.ndarray]]:
        """Begin a loop whose carried arrays start at `inits`; return it and the carried arrays inside."""
        loop = Loop(region, [], [], [], rounds)
        values = []
        for x in inits:
            kind = kind_of(x.dtype) if x.dtype != object else common_kind(x)
            inside = []
            for entry in objects(x).ravel():
                inside.append(Value("carry", (loop, len(loop.carries)), kind, region))
                loop.initial.append(entry)
                loop.carries.append(inside[-1])
                loop.kinds.append(kind)
            values.append(array(inside, x.shape))
        self.builder.region, self.loops[region] = region, loop
        return loop, values

    def close_loop(self, loop: Loop, outputs: list[np.ndarray], like: list[np.ndarray]) -> list[np.ndarray]:
        """End a loop; return the carried arrays after it."""
        loop.outputs = [v for x in outputs for v in objects(x).ravel()]
        region = self.builder.region = loop.body.outer
        region.steps.append(loop)
        loop.results = [Value("result", (loop, i), kind, region) for i, kind in enumerate(loop.kinds)]
        results = iter(loop.results)
        return [array([next(results) for _ in range(x.size)], x.shape) for x in like]

    def while_loop(self, params: dict, args: list[np.ndarray]) -> list[np.ndarray]:
        """Lower a loop that goes on as long as the condition of any lane holds."""
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
        """Lower branches: each runs if any lane takes it, and a select picks every lane's own results."""
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
        """Lower `custom_linear_solve`: run the function that solves the system."""
        lengths, solve = params["const_lengths"], params["jaxprs"].solve
        before = lengths.matvec + lengths.vecmat
        consts, right = args[before : before + lengths.solve], args[sum(lengths) :]
        return self.run(solve.jaxpr, [np.asarray(c) for c in solve.consts], [*consts, *right])

    def choose(self, taken: Any, new: list[np.ndarray], old: list[np.ndarray]) -> list[np.ndarray]:
        """Select the new arrays where taken, else the old ones."""
        make = self.builder.make
        out = []
        for these, those in zip(new, old, strict=True):
            pairs = zip(objects(these).ravel(), objects(those).ravel(), strict=True)
            out.append(array([make("select", taken, a, b) for a, b in pairs], these.shape))
        return out


def _counters(body: Jaxpr, n_consts: int, n_carry: int, carry: list[np.ndarray]) -> dict[int, tuple[int, bool]]:
    """Find carried integers that every round raises by one, and whether a round uses them for anything else."""
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
