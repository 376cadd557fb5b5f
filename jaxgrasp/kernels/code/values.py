"""Write instructions for values: what targets with vectors of lanes and targets with single ones have in common."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from jaxgrasp.kernels.code.instructions import Instructions
from jaxgrasp.kernels.program.expressions import Address, Value
from jaxgrasp.kernels.program.lowering import Guard, Loop

_INTEGERS = {"add": "add", "sub": "sub", "mul": "mul"}
_FLOATS = {"add": "fadd", "sub": "fsub", "mul": "fmul"}
_FLOAT_CONDITIONS = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_INTEGER_CONDITIONS = {"eq": "eq", "ne": "ne", "lt": "slt", "le": "sle", "gt": "sgt", "ge": "sge"}
_INTRINSICS = {"sqrt": "sqrt", "exp": "exp", "log": "log", "floor": "floor", "abs": "fabs"}


class ValueCode(Instructions, ABC):
    """Writes instructions for values, whose operands have names.

    own: names of the pointers to the arguments, see `write` of the subclass.
    fused: products that are part of a fused multiply-add.
    slots: for every loop and guard, the places or names of its carried values or results.
    labels: for every loop and guard, the names of its blocks: the head, inside and after.
    """

    def __init__(self, dtype: np.dtype, width: int, *, estimates: bool) -> None:
        """Begin code for vectors of so many lanes, see `Instructions`."""
        super().__init__(dtype, width, estimates=estimates)
        self.own: list[str] = []
        self.fused: set[Value] = set()
        self.slots: dict[Loop | Guard, list[str]] = {}
        self.labels: dict[Loop | Guard, tuple[str, str, str]] = {}

    @abstractmethod
    def operand(self, x: Any, kind: str) -> str:
        """Return the name or literal of a scalar as an operand of this type."""

    def choice(self, value: Value, mask: str) -> str:
        """Write a select, by a mask that is written already."""
        picked = [f"{self.types[value.kind]} {self.operand(x, value.kind)}" for x in value.args[1:]]
        return self.emit(f"select {self.types['b']} {mask}, {', '.join(picked)}")

    def instruction(self, value: Value) -> str:
        """Write the code of a value that is computed; return its name."""
        op, args, kind = value.op, value.args, value.kind
        vector = self.types[kind]
        if op in _FLOAT_CONDITIONS:
            return self.comparison(op, args)
        if op == "is_finite":
            size = self.intrinsic("fabs", self.operand(args[0], "f"))
            return self.emit(f"fcmp olt {self.types['f']} {size}, {self.constant(np.inf, 'f')}")
        if op == "select":
            return self.choice(value, self.operand(args[0], "b"))
        if op == "convert":
            (x,) = args
            source = "i" if x.kind == "u" else x.kind
            how = "sitofp" if kind == "f" else "fptosi"
            return self.emit(f"{how} {self.types[source]} {self.operand(x, source)} to {vector}")
        fused = [x for x in args if x in self.fused]
        if fused:
            return self.sum_of_product(op, fused[0], args)
        operands = [self.operand(x, kind) for x in args]
        if kind == "b":
            if op == "not":
                return self.emit(f"xor {vector} {operands[0]}, {self.constant(True, 'b')}")
            return self.emit(f"{op} {vector} {', '.join(operands)}")
        if kind in "iu":
            return self.integer(op, vector, operands, kind)
        return self.number(op, args, operands)

    def comparison(self, op: str, args: tuple) -> str:
        """Write a comparison."""
        kinds = {x.kind if type(x) is Value else None for x in args} - {None}
        kind = "f" if "f" in kinds else "b" if "b" in kinds else "i"
        left, right = (self.operand(x, kind) for x in args)
        how = f"fcmp {_FLOAT_CONDITIONS[op]}" if kind == "f" else f"icmp {_INTEGER_CONDITIONS[op]}"
        return self.emit(f"{how} {self.types[kind]} {left}, {right}")

    def integer(self, op: str, vector: str, operands: list[str], kind: str) -> str:
        """Write an operation on integers."""
        if op in ("max", "min"):
            truth = "i1" if kind == "u" else self.types["b"]
            first = self.emit(f"icmp {'sgt' if op == 'max' else 'slt'} {vector} {operands[0]}, {operands[1]}")
            return self.emit(f"select {truth} {first}, {vector} {operands[0]}, {vector} {operands[1]}")
        if op == "neg":
            return self.emit(f"sub {vector} {'0' if kind == 'u' else 'zeroinitializer'}, {operands[0]}")
        return self.emit(f"{_INTEGERS[op]} {vector} {', '.join(operands)}")

    def number(self, op: str, args: tuple, operands: list[str]) -> str:
        """Write an operation on numbers."""
        vector = self.types["f"]
        if op in _FLOATS:
            return self.emit(f"{_FLOATS[op]} {vector} {', '.join(operands)}")
        if op == "neg":
            return self.emit(f"fneg {vector} {operands[0]}")
        if op in ("max", "min"):
            # This order becomes one instruction, and gives NaN for NaN and a constant.
            if type(args[1]) is not Value:
                operands.reverse()
            first = self.emit(f"fcmp {'ogt' if op == 'max' else 'olt'} {vector} {operands[0]}, {operands[1]}")
            return self.emit(f"select {self.types['b']} {first}, {vector} {operands[0]}, {vector} {operands[1]}")
        if op == "div":
            return self.reciprocal(operands[1])
        if op == "rsqrt":
            return self.inverse_root(*operands)
        if op == "sqrt" and self.estimates:
            return self.root(*operands)
        return self.intrinsic(_INTRINSICS[op], operands[0])

    def sum_of_product(self, op: str, product: Value, args: tuple) -> str:
        """Write a sum or difference with a product, rounded once."""
        a, b = (self.operand(x, "f") for x in product.args)
        first = args[0] is product
        other = self.operand(args[1] if first else args[0], "f")
        if op == "sub":
            other, a = (self.negate(other), a) if first else (other, self.negate(a))
        return self.multiply_add(a, b, other)

    def offset(self, address: Address) -> str:
        """Write the number of the entry at an address: known, or so many strides further as a counter says."""
        if address.counter is None:
            return str(address.offset)
        moved = self.emit(f"mul i64 {self.operand(address.counter, 'u')}, {address.stride}")
        return self.emit(f"add i64 {moved}, {address.offset}")
