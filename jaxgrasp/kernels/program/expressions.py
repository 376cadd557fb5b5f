"""Scalar expressions: what a fused kernel computes, one problem at a time.

A `Value` is one operation on other values or constants. Equal operations are the same value, operations on constants
are done at once, and a value belongs to the outermost region (a loop's body, say) that knows its operands: what does
not change in a loop is computed before it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, final

import numpy as np


class Region:
    """Code that runs as a whole: a kernel, the body of a loop, or what only some problems need.

    steps: what it does beside computing values (loops, stores), in order.
    guarded: values stay inside even where they could be computed outside.
    """

    def __init__(self, parent: "Region | None", guarded: bool = False) -> None:
        """A region inside another one."""
        self.parent, self.guarded = parent, guarded
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.steps: list[Any] = []
        self.known: dict[tuple, Value] = {}

    @property
    def outer(self) -> "Region":
        """The region around it, which all have but the kernel's own."""
        assert self.parent is not None
        return self.parent


class Address(NamedTuple):
    """Where a scalar of an argument lies: entry `offset + counter * stride` of a row of the argument.

    buffer: number of the argument.
    offset: number of the entry in the flattened row, where there is no counter or it is zero.
    counter: the counter of a loop that the entry depends on; None where the entry is always the same.
    stride: entries from one round of the loop to the next.
    """

    buffer: int
    offset: int
    counter: "Value | None" = None
    stride: int = 0


@final
class Value:
    """A scalar that is computed: an operation, its operands, its type and its region.

    Types: "f" a number, "i" an integer and "b" a truth value of every problem; "u" an integer that all problems share.
    """

    __slots__ = ("args", "kind", "op", "region", "serial")
    count = 0

    def __init__(self, op: str, args: tuple, kind: str, region: Region) -> None:
        """A new value."""
        self.op, self.args, self.kind, self.region = op, args, kind, region
        self.serial = Value.count = Value.count + 1

    @property
    def address(self) -> Address:
        """Where the scalar lies; only "own" and "shared" have an address."""
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
    """Something that fused kernels cannot do."""


def kind_of(dtype: Any) -> str:
    """The type of a scalar of this dtype."""
    kinds = {"f": "f", "i": "i", "b": "b", "u": "i"}
    if np.dtype(dtype).kind not in kinds:
        raise Unsupported(f"values of type {dtype}")
    return kinds[np.dtype(dtype).kind]


class Builder:
    """Makes values, in the region that is current."""

    def __init__(self, dtype: Any) -> None:
        """For numbers of this type."""
        self.dtype = np.dtype(dtype)
        self.region = Region(None)

    def make(self, op: str, *args: Any) -> Any:
        """The value of an operation, or the constant where that is known."""
        if not any(type(x) is Value for x in args):
            with np.errstate(all="ignore"):
                return self._constant(op, args)
        simple = self._simplified(op, args)
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
            kind = next(_kind(x) for x in args[1:])
        else:
            kind = next(_kind(x) for x in args if type(x) is Value)
        return self.value(op, args, kind)

    def value(self, op: str, args: tuple, kind: str) -> Value:
        """A value that is not simplified."""
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
        home, region = None, self.region
        for x in args:
            # An address may depend on a counter, and then belongs to its loop.
            x = x.counter if isinstance(x, Address) else x
            if type(x) is Value and (home is None or x.region.depth > home.depth):
                home = x.region
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

    def _simplified(self, op: str, args: tuple[Any, ...]) -> Any:
        """Cheaper forms; a product with zero is zero, whatever the other factor."""
        if op in ("add", "sub", "mul", "div"):
            a, b = args
            left, right = type(a) is not Value, type(b) is not Value
            if op == "mul":
                for x, y, known in ((a, b, left), (b, a, right)):
                    if not known:
                        continue
                    number: np.generic = x
                    if number in (0, 1, -1):
                        zero = number.dtype.type(0)
                        return x * zero if number == 0 else y if number == 1 else self.make("neg", y)
                # Signs go outwards, where a sum takes them up.
                for x, y in ((a, b), (b, a)):
                    if type(x) is Value and x.op == "neg":
                        return self.make("neg", self.make("mul", x.args[0], y))
                    if type(x) is not Value and x < 0:
                        return self.make("neg", self.make("mul", -x, y))
                    if type(x) is not Value and y.kind == "f" and y.op == "mul" and type(y.args[0]) is not Value:
                        both = x * y.args[0]
                        if np.isfinite(both) and abs(both) >= np.finfo(both.dtype).tiny:
                            return self.make("mul", both, y.args[1])
            elif op == "add":
                if left and a == 0:
                    return b
                if right and b == 0:
                    return a
                if not right and b.op == "neg":
                    return self.make("sub", a, b.args[0])
                if not left and a.op == "neg":
                    return self.make("sub", b, a.args[0])
            elif op == "sub":
                if right and b == 0:
                    return a
                if left and a == 0:
                    return self.make("neg", b)
                if not right and b.op == "neg":
                    return self.make("add", a, b.args[0])
                if not left and a.op == "neg":
                    return self.make("neg", self.make("add", a.args[0], b))
            elif right and b != 0 and np.isfinite(b):
                return self.make("mul", a, (1 / b).astype(b.dtype))
            elif not (left and a == 1):
                # The reciprocal may be had already, or before a loop.
                return self.make("mul", a, self.make("div", self.dtype.type(1), b))
        elif op == "neg" and args[0].op == "neg":
            return args[0].args[0]
        elif op == "neg" and args[0].op == "sub":
            return self.make("sub", args[0].args[1], args[0].args[0])
        elif op == "not" and args[0].op == "not":
            return args[0].args[0]
        elif op in ("and", "or"):
            for x, y in (args, args[::-1]):
                if type(x) is not Value:
                    return (y if x else x) if op == "and" else (x if x else y)
            if args[0] is args[1]:
                return args[0]
        elif op == "select":
            if type(args[0]) is not Value:
                return args[1] if args[0] else args[2]
            if args[1] is args[2]:
                return args[1]
            inner = args[1]
            if type(inner) is Value and inner.op == "select" and inner.args[2] is args[2]:
                return self.make("select", self.make("and", args[0], inner.args[0]), inner.args[1], args[2])
        elif op in ("max", "min"):
            if args[0] is args[1]:
                return args[0]
            if all(type(x) is Value and x.op == "neg" for x in args):
                other = "min" if op == "max" else "max"
                return self.make("neg", self.make(other, args[0].args[0], args[1].args[0]))
        return None


def _kind(x: Any) -> str:
    return x.kind if type(x) is Value else kind_of(x.dtype)


def _order(x: Any) -> int:
    return x.serial if type(x) is Value else 0


def _bits(x: Any) -> Any:
    return (x.dtype.char, x.tobytes()) if isinstance(x, np.generic) else x
