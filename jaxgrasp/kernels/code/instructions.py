"""Write instructions on vectors, as text of LLVM's language.

The text is written here rather than with a library's objects, which would take longer than LLVM takes to compile it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

# Bytes of a frame that AVX-512's instructions reach from a pointer with an offset of one byte in place of four, and how
# many such pointers are kept. Short offsets matter, since a kernel's loop is more code than the first cache holds.
_NEAR, _POINTERS = 1 << 14, 7


class Instructions:
    """Writes functions, one after the other, and lays out their frame, the memory that they share.

    `begin` starts a function; instructions go to the one that began last. `text` comes last: only then is it known how
    large the frame is, and every function begins with pointers into it.

    Args:
        dtype: of numbers.
        width: lanes of a vector.
        estimates: whether the processor has AVX-512's estimates of reciprocals.

    types: LLVM's types of vectors of numbers "f", integers "i", truth values "b" and bytes, and of the integer "u".
    memory_types: the types that these have in memory.
    units: LLVM's types of single entries in memory.
    functions: signature and lines of every function.
    lines: of the function that is being written.
    block: the block that is being written.
    offsets: where each array of the frame begins, in bytes.
    frame_bytes: how large the frame is so far.
    declarations: of LLVM's functions that are called.
    """

    def __init__(self, dtype: np.dtype, width: int, *, estimates: bool) -> None:
        """Begin a module without functions."""
        self.dtype, self.width, self.estimates = dtype, width, estimates
        self.scalar = "double" if dtype.itemsize == 8 else "float"
        self.types = {"f": f"<{width} x {self.scalar}>", "i": f"<{width} x i32>", "b": f"<{width} x i1>", "u": "i64"}
        self.types["byte"] = f"<{width} x i8>"
        # In memory a truth value is a byte: of a vector of bits that fill no byte, LLVM takes the others for zero.
        self.memory_types = {**self.types, "b": self.types["byte"]}
        self.units = {"f": self.scalar, "i": "i32", "byte": "i8"}
        self.functions: list[tuple[str, list[str]]] = []
        self.lines: list[str] = []
        self.offsets: dict[str, int] = {}
        self.frame_bytes = 0
        self.declarations: set[str] = set()
        self.block = "entry"
        self.count = 0

    def emit(self, text: str) -> str:
        """Write an instruction with a result; return the result's name."""
        self.count += 1
        name = f"%v{self.count}"
        self.lines.append(f"{name} = {text}")
        return name

    def do(self, text: str) -> None:
        """Write an instruction without a result."""
        self.lines.append(text)

    def label(self, purpose: str) -> str:
        """Return a new name for a block."""
        self.count += 1
        return f"{purpose}{self.count}"

    def enter(self, block: str) -> None:
        """Begin a block of the function."""
        self.lines.append(f"{block}:")
        self.block = block

    def allocate(self, kind: str, count: int = 1) -> str:
        """Reserve memory for vectors in the frame; return its name, which is for `pointer`."""
        self.count += 1
        name = f"%m{self.count}"
        self.offsets[name] = self.frame_bytes
        self.frame_bytes += -(-count * self.stride(kind) // 64) * 64
        return name

    def stride(self, kind: str) -> int:
        """Return how many bytes apart the vectors of an array are."""
        return self.width * (self.dtype.itemsize if kind == "f" else 4 if kind == "i" else 1)

    def begin(self, signature: str) -> None:
        """Begin a function, which must have a pointer `%frame` among its parameters."""
        self.functions.append((signature, []))
        self.lines, self.block = self.functions[-1][1], "entry"

    def text(self) -> str:
        """Return the code of all functions."""
        pointers = "\n".join(self._pointers())
        return "\n".join(
            f"define internal {signature} #0 {{\nentry:\n{pointers}\n" + "\n".join(lines) + "\n}\n"
            for signature, lines in self.functions
        )

    def _pointers(self) -> list[str]:
        """Return the lines with which a function begins: pointers into the frame."""
        lines = []
        for number in range(min(_POINTERS, -(-max(self.frame_bytes, 1) // _NEAR))):
            place = f"getelementptr i8, ptr %frame, i64 {number * _NEAR + _NEAR // 2}"
            # LLVM would count all of them from the same one if it knew.
            lines += [f"%near{number}.known = {place}"]
            lines += [f'%near{number} = call ptr asm "", "=r,0"(ptr %near{number}.known)']
        return lines

    def pointer(self, place: str) -> str:
        """Write a pointer to an array of the frame; other pointers are returned as they are."""
        offset = self.offsets.get(place)
        if offset is None:
            return place
        number = min(offset // _NEAR, _POINTERS - 1)
        return self.emit(f"getelementptr i8, ptr %near{number}, i64 {offset - number * _NEAR - _NEAR // 2}")

    def declare(self, text: str) -> None:
        """Declare a function of LLVM's that is called."""
        self.declarations.add(text)

    def entry(self, base: str, unit: str, index: str | int) -> str:
        """Write a pointer to an entry of an array."""
        return self.emit(f"getelementptr {unit}, ptr {self.pointer(base)}, i64 {index}")

    def repeat(self, count: int | str, body: Callable[[str], None]) -> None:
        """Write a loop of at least one round; `body` writes a round, and is called with the name of its number."""
        before, inside, after = self.block, self.label("repeat"), self.label("after")
        self.do(f"br label %{inside}")
        self.enter(inside)
        self.count += 1
        number, place = f"%n{self.count}", len(self.lines)
        self.do("")
        body(number)
        following = self.emit(f"add i64 {number}, 1")
        self.lines[place] = f"{number} = phi i64 [ 0, %{before} ], [ {following}, %{self.block} ]"
        again = self.emit(f"icmp ult i64 {following}, {count}")
        self.do(f"br i1 {again}, label %{inside}, label %{after}")
        self.enter(after)

    def constant(self, value: Any, kind: str) -> str:
        """Return the literal of a constant of this type, the same in all lanes."""
        if kind == "f":
            return f"splat ({self.scalar} {self.float_literal(value)})" if self.width > 1 else self.float_literal(value)
        if kind == "b":
            return f"splat (i1 {'true' if value else 'false'})"
        return str(int(value)) if kind == "u" else f"splat (i32 {int(value)})"

    def float_literal(self, value: Any) -> str:
        """Return a number as LLVM reads it without rounding."""
        return f"0x{np.float64(self.dtype.type(value)).view(np.uint64):016X}"

    def intrinsic(self, name: str, *operands: str) -> str:
        """Write a call of one of LLVM's own functions of vectors."""
        vector = self.types["f"]
        full = f"@llvm.{name}.v{self.width}f{8 * self.dtype.itemsize}"
        self.declare(f"declare {vector} {full}({', '.join([vector] * len(operands))})")
        return self.emit(f"call {vector} {full}({', '.join(f'{vector} {x}' for x in operands)})")

    def multiply_add(self, a: str, b: str, c: str) -> str:
        """Write a b + c, rounded once."""
        return self.intrinsic("fma", a, b, c)

    def negate(self, x: str) -> str:
        """Write -x."""
        return self.emit(f"fneg {self.types['f']} {x}")

    def multiply(self, a: str, b: str) -> str:
        """Write a b."""
        return self.emit(f"fmul {self.types['f']} {a}, {b}")

    def estimate(self, name: str, x: str) -> str:
        """Write AVX-512's estimate of 1 / x ("rcp") or 1 / sqrt(x) ("rsqrt"), good to 14 bits."""
        vector, mask = self.types["f"], f"i{max(8, self.width)}"
        full = f"@llvm.x86.avx512.{name}14.{'pd' if self.dtype.itemsize == 8 else 'ps'}.512"
        self.declare(f"declare {vector} {full}({vector}, {vector}, {mask})")
        return self.emit(f"call {vector} {full}({vector} {x}, {vector} zeroinitializer, {mask} -1)")

    def improve(self, inverse: str, lacking: str, step: str, where: str | None) -> tuple[str, str]:
        """Write a step of Newton's method, inverse + step * lacking, except where the estimate is exact.

        It is exact where x is zero, infinite or NaN, or too small or large: `lacking` is then NaN or minus infinity.

        Args:
            inverse: the estimate of 1 / x or 1 / sqrt(x).
            lacking: its residual, 1 - x inverse or 1 - x inverse^2.
            step: the derivative of the correction with respect to the residual.
            where: the mask of lanes to improve; None to find it.

        Returns:
            The better estimate, and the mask.
        """
        vector = self.types["f"]
        mask = where or self.emit(f"fcmp ogt {vector} {lacking}, {self.constant(-1, 'f')}")
        better = self.multiply_add(step, lacking, inverse)
        return self.emit(f"select {self.types['b']} {mask}, {vector} {better}, {vector} {inverse}"), mask

    def reciprocal(self, x: str) -> str:
        """Write 1 / x."""
        one = self.constant(1, "f")
        if not self.estimates:
            return self.emit(f"fdiv {self.types['f']} {one}, {x}")
        inverse, minus, mask = self.estimate("rcp", x), self.negate(x), None
        for _ in range(2 if self.dtype.itemsize == 8 else 1):
            inverse, mask = self.improve(inverse, self.multiply_add(minus, inverse, one), inverse, mask)
        return inverse

    def inverse_root(self, x: str) -> str:
        """Write 1 / sqrt(x)."""
        if not self.estimates:
            return self.reciprocal(self.intrinsic("sqrt", x))
        inverse, mask = self.estimate("rsqrt", x), None
        for _ in range(2 if self.dtype.itemsize == 8 else 1):
            # 1 - (x y) y rather than 1 - x (y y): y y would be denormal for large x.
            minus = self.negate(self.multiply(x, inverse))
            lacking = self.multiply_add(minus, inverse, self.constant(1, "f"))
            inverse, mask = self.improve(inverse, lacking, self.multiply(inverse, self.constant(0.5, "f")), mask)
        return inverse

    def root(self, x: str) -> str:
        """Write sqrt(x), as x / sqrt(x) and a step of Newton's method; sqrt(0) = 0 and sqrt(inf) = inf."""
        inverse = self.inverse_root(x)
        root = self.multiply(x, inverse)
        lacking = self.multiply_add(self.negate(root), root, x)
        root = self.multiply_add(lacking, self.multiply(inverse, self.constant(0.5, "f")), root)
        vector, mask = self.types["f"], self.types["b"]
        empty = self.emit(f"fcmp oeq {vector} {x}, zeroinitializer")
        endless = self.emit(f"fcmp oeq {vector} {x}, {self.constant(np.inf, 'f')}")
        itself = self.emit(f"or {mask} {empty}, {endless}")
        return self.emit(f"select {mask} {itself}, {vector} {x}, {vector} {root}")
