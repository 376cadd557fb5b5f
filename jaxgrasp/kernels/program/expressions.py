"""The intermediate representation: scalar expressions, which a kernel computes for one lane of the batch.

A `Value` is one operation on other values or constants. Equal operations are the same value, operations on constants
are done at once, and a value belongs to the outermost region (a loop's body, say) that knows its operands: what does
not change in a loop is computed before it.

Operations and their `args`; an operand is a `Value` or a NumPy scalar, and the type is that of the result:

- "own", "shared" (Address): a scalar of an argument that every lane has for itself, or that all lanes share.
- "entry" (Address): a scalar of a table.
- "carry" (Loop, index): a scalar that a loop carries, at the beginning of a round.
- "result" (Loop or Guard, index): a scalar that a loop or a guard leaves.
- "counter" (): the number of the round of the loop in whose body it is, type "u".
- "add", "sub", "mul", "max", "min" (a, b) and "neg" (a): types "f", "i" and "u".
- "div" (a, b), "abs", "sqrt", "rsqrt" (1 / sqrt), "exp", "log", "floor" (a): type "f". `make` leaves 1 as the only
  dividend.
- "eq", "ne", "lt", "le", "gt", "ge" (a, b) and "is_finite" (a): type "b".
- "and", "or", "xor" (a, b) and "not" (a): type "b".
- "select" (condition, a, b): a where the condition holds, else b; the type of a and b.
- "convert" (a): a number as an integer or an integer as a number, "f" or "i".

The first six are read where they lie, the others are computed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, final

import numpy as np


class Region:
    """Code that runs as a whole: a kernel, the body of a loop, or of a guard.

    parent: the region around it; None for the kernel's own.
    depth: how many regions are around it.
    steps: the loops and guards in it, in order.
    guarded: whether values stay inside even where they could be computed outside.
    known: its values by operation and operands.
    """

    def __init__(self, parent: "Region | None", guarded: bool = False) -> None:
        """Make an empty region inside another one."""
        self.parent, self.guarded = parent, guarded
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.steps: list[Any] = []
        self.known: dict[tuple, Value] = {}

    @property
    def outer(self) -> "Region":
        """The region around it; the kernel's own has none."""
        assert self.parent is not None
        return self.parent


class Table(NamedTuple):
    """Scalars in memory that loops reach by their counters: what is written before a loop, or by its rounds.

    number: tells it from all others of the program.
    kind: the type of its entries.
    size: how many entries there are.
    region: the region in which it is written as a whole.
    """

    number: int
    kind: str
    size: int
    region: Region


class Address(NamedTuple):
    """The place of a scalar: entry `offset + counter * stride` of a row of an argument, or of a table.

    buffer: number of the argument, or the table.
    offset: number of the entry in the flattened row, where there is no counter or it is zero.
    counter: a loop's counter, or a value of type "u" computed from one; None where the entry is always the same.
    stride: how many entries further one more of the counter is.
    """

    buffer: int | Table
    offset: int
    counter: "Value | None" = None
    stride: int = 0

    @property
    def argument(self) -> int:
        """The number of the argument."""
        assert isinstance(self.buffer, int)
        return self.buffer

    @property
    def table(self) -> Table:
        """The table."""
        assert isinstance(self.buffer, Table)
        return self.buffer


@final
class Value:
    """A scalar that is computed, compared by identity.

    op: its operation, see the module.
    args: the operands; what they are depends on the operation.
    kind: its type: "f" a number, "i" an integer, "b" a truth value, all of them different in every lane; "u" an integer
        that all lanes share.
    region: the region that computes it.
    serial: how many values were made before it, in this process.
    """

    __slots__ = ("args", "kind", "op", "region", "serial")
    count = 0

    def __init__(self, op: str, args: tuple, kind: str, region: Region) -> None:
        """Make a value; `Builder.value` does so only where there is none like it."""
        self.op, self.args, self.kind, self.region = op, args, kind, region
        self.serial = Value.count = Value.count + 1

    @property
    def address(self) -> Address:
        """The place of the scalar; only "own", "shared" and "entry" have an address."""
        return self.args[0]


_COMMUTE = {"add", "mul", "max", "min", "and", "or", "eq", "ne"}
_COMPARE = {"eq", "ne", "lt", "le", "gt", "ge"}
_FOLD: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "max": np.maximum,
    "min": np.minimum,
    "neg": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "floor": np.floor,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "is_finite": np.isfinite,
}


class Unsupported(Exception):
    """A kernel cannot be made of the program; the message names the part of it that stands in the way."""


def kind_of(dtype: Any) -> str:
    """Return the type of a scalar of this dtype."""
    kinds = {"f": "f", "i": "i", "b": "b", "u": "i"}
    if np.dtype(dtype).kind not in kinds:
        raise Unsupported(f"values of type {dtype}")
    return kinds[np.dtype(dtype).kind]


class Builder:
    """Makes values.

    dtype: of numbers.
    region: the region that is being written.
    """

    def __init__(self, dtype: Any) -> None:
        """Begin a kernel with numbers of this dtype."""
        self.dtype = np.dtype(dtype)
        self.region = Region(None)

    def make(self, op: str, *args: Any) -> Any:
        """Return the value of an operation, in its cheapest form, or the constant where that is known."""
        if not any(type(x) is Value for x in args):
            with np.errstate(all="ignore"):
                return self._constant(op, args)
        simple = _SIMPLIFY[op](self, *args) if op in _SIMPLIFY else None
        if simple is not None:
            return simple
        if op in _COMMUTE and _order(args[0]) > _order(args[1]):
            args = args[::-1]
        if op in _COMPARE or op == "is_finite":
            # Counters count up from zero.
            if op == "lt" and _kind(args[0]) == "u" and type(args[1]) is not Value and args[1] == 0:
                return np.bool_(False)
            kind = "b"
        elif op == "select":
            # The condition differs between lanes, and so does what it picks of integers that do not.
            kind = _kind(args[1]).replace("u", "i")
        else:
            kinds = [x.kind for x in args if type(x) is Value]
            kind = "i" if "i" in kinds else kinds[0]
        return self.value(op, args, kind)

    def value(self, op: str, args: tuple, kind: str) -> Value:
        """Return the value of an operation as it is, new or known."""
        key = (op, kind, *[id(x) if type(x) is Value else _bits(x) for x in args])
        home = self._home(args)
        region: Region | None = self.region
        while region is not None:
            found = region.known.get(key)
            if found is not None:
                return found
            region = region.parent
        found = home.known[key] = Value(op, args, kind, home)
        return found

    def _home(self, args: tuple) -> Region:
        """Find the outermost region that knows all operands."""
        home, region = None, self.region
        for x in args:
            # An address may depend on a counter, and then belongs to its loop; else it does to the table's region.
            inside = x.region if type(x) is Value else _region_of(x) if isinstance(x, Address) else None
            if inside is not None and (home is None or inside.depth > home.depth):
                home = inside
        # The outermost region is the kernel's; guarded ones keep what is made in them.
        while region is not None:
            if region is home or region.guarded or region.parent is None:
                return region
            region = region.parent
        raise AssertionError

    def _constant(self, op: str, args: tuple) -> Any:
        if op == "select":
            return args[1] if args[0] else args[2]
        if op == "rsqrt":
            return (1 / np.sqrt(args[0])).astype(args[0].dtype)
        return _FOLD[op](*args)


def _region_of(address: Address) -> Region | None:
    """Find the region in which an address means something; None where it does anywhere."""
    if address.counter is not None:
        return address.counter.region
    return address.buffer.region if isinstance(address.buffer, Table) else None


def _simplify_product(builder: Builder, a: Any, b: Any) -> Any:
    for x, y in ((a, b), (b, a)):
        if type(x) is Value:
            continue
        constant: np.generic = x
        if constant == 0:
            # Zero times anything is zero, infinity and NaN included.
            return x * constant.dtype.type(0)
        if constant == 1:
            return y
        if constant == -1:
            return builder.make("neg", y)
    for x, y in ((a, b), (b, a)):
        # Signs go outwards, where a sum takes them up.
        if type(x) is Value and x.op == "neg":
            return builder.make("neg", builder.make("mul", x.args[0], y))
        if type(x) is not Value and x < 0:
            return builder.make("neg", builder.make("mul", -x, y))
        if type(x) is not Value and y.kind == "f" and y.op == "mul" and type(y.args[0]) is not Value:
            both = x * y.args[0]
            if np.isfinite(both) and abs(both) >= np.finfo(both.dtype).tiny:
                return builder.make("mul", both, y.args[1])
    return None


def _simplify_sum(builder: Builder, a: Any, b: Any) -> Any:
    if _is(a, 0):
        return b
    if _is(b, 0):
        return a
    if _does(b, "neg"):
        return builder.make("sub", a, b.args[0])
    if _does(a, "neg"):
        return builder.make("sub", b, a.args[0])
    return None


def _simplify_difference(builder: Builder, a: Any, b: Any) -> Any:
    if _is(b, 0):
        return a
    if _is(a, 0):
        return builder.make("neg", b)
    if _does(b, "neg"):
        return builder.make("add", a, b.args[0])
    if _does(a, "neg"):
        return builder.make("neg", builder.make("add", a.args[0], b))
    return None


def _simplify_quotient(builder: Builder, a: Any, b: Any) -> Any:
    if type(b) is not Value and b != 0 and np.isfinite(b):
        return builder.make("mul", a, (1 / b).astype(b.dtype))
    if not _is(a, 1):
        # The reciprocal may exist already, or be computed before a loop.
        return builder.make("mul", a, builder.make("div", builder.dtype.type(1), b))
    return None


def _simplify_negation(builder: Builder, x: Value) -> Any:
    if x.op == "neg":
        return x.args[0]
    if x.op == "sub":
        return builder.make("sub", x.args[1], x.args[0])
    return None


def _simplify_logic(op: str) -> Callable[..., Any]:
    def simplify(builder: Builder, a: Any, b: Any) -> Any:
        for x, y in ((a, b), (b, a)):
            if type(x) is not Value:
                return (y if x else x) if op == "and" else (x if x else y)
        return a if a is b else None

    return simplify


def _simplify_select(builder: Builder, condition: Any, a: Any, b: Any) -> Any:
    if type(condition) is not Value:
        return a if condition else b
    if a is b:
        return a
    if _does(a, "select") and a.args[2] is b:
        return builder.make("select", builder.make("and", condition, a.args[0]), a.args[1], b)
    return None


def _simplify_extremum(opposite: str) -> Callable[..., Any]:
    def simplify(builder: Builder, a: Any, b: Any) -> Any:
        if a is b:
            return a
        if _does(a, "neg") and _does(b, "neg"):
            return builder.make("neg", builder.make(opposite, a.args[0], b.args[0]))
        return None

    return simplify


# Cheaper forms of operations of which at least one operand is not a constant; each returns None where it knows none.
_SIMPLIFY: dict[str, Callable[..., Any]] = {
    "mul": _simplify_product,
    "add": _simplify_sum,
    "sub": _simplify_difference,
    "div": _simplify_quotient,
    "neg": _simplify_negation,
    "not": lambda builder, x: x.args[0] if x.op == "not" else None,
    "and": _simplify_logic("and"),
    "or": _simplify_logic("or"),
    "select": _simplify_select,
    "max": _simplify_extremum("min"),
    "min": _simplify_extremum("max"),
}


def _is(x: Any, number: int) -> bool:
    """Tell whether a scalar is this constant."""
    return type(x) is not Value and bool(x == number)


def _does(x: Any, op: str) -> bool:
    """Tell whether a scalar is computed by this operation."""
    return type(x) is Value and x.op == op


def _kind(x: Any) -> str:
    return x.kind if type(x) is Value else kind_of(x.dtype)


def _order(x: Any) -> int:
    return x.serial if type(x) is Value else 0


def _bits(x: Any) -> Any:
    return (x.dtype.char, x.tobytes()) if isinstance(x, np.generic) else x
