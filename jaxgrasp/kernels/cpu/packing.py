"""Write the code that packs rows of arguments to vectors, one an entry, and unpacks vectors to rows of results.

Arrays are batch-first in XLA's memory: the entries of a lane are beside each other, a row. In a frame the lanes of an
entry are beside each other, a vector. Squares of as many entries as lanes are transposed in registers.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from jaxgrasp.kernels.cpu.vectors import VectorCode
from jaxgrasp.kernels.program.expressions import kind_of


class Result(NamedTuple):
    """A result of a block of lanes in a frame.

    place: its array in the frame.
    size: entries of a row.
    kind: type of the entries; "byte" where they are truth values.
    """

    place: str
    size: int
    kind: str


def pack_arguments(code: VectorCode) -> list[str]:
    """Pack the rows of block `%block`; where lanes are left over, they get the last row.

    Returns:
        For every argument the name of its array in the frame, "" where all lanes share it.
    """
    program, width = code.program, code.width
    rows = code.emit("load i64, ptr %state")
    first = code.emit(f"mul i64 %block, {width}")
    last = code.emit(f"sub i64 {rows}, 1")
    lanes = []
    for lane in range(width):
        row = code.emit(f"add i64 {first}, {lane}")
        inside = code.emit(f"icmp ult i64 {row}, {rows}")
        lanes.append(code.emit(f"select i1 {inside}, i64 {row}, i64 {last}"))
    own = []
    for number, ((shape, dtype), shared) in enumerate(zip(program.inputs, program.shared, strict=True)):
        own.append("" if shared else _pack(code, code.argument(number), lanes, math.prod(shape), kind_of(dtype)))
    return own


def write_unpack(code: VectorCode, results: list[Result]) -> None:
    """Write the function `unpack`, from a frame to the results of a block, whose last lanes may be left over."""
    pointers = range(len(code.program.inputs), len(code.program.inputs) + len(results))
    code.begin("void @unpack(ptr noalias %state, i64 %block, ptr noalias %frame)")
    rows = code.emit("load i64, ptr %state")
    first = code.emit(f"mul i64 %block, {code.width}")
    beyond = code.emit(f"add i64 {first}, {code.width}")
    full = code.emit(f"icmp ule i64 {beyond}, {rows}")
    whole, part, done = code.label("whole"), code.label("part"), code.label("done")
    code.do(f"br i1 {full}, label %{whole}, label %{part}")
    code.enter(whole)
    for number, result in zip(pointers, results, strict=True):
        _unpack(code, result, code.argument(number), first)
    code.do(f"br label %{done}")
    code.enter(part)
    valid = code.emit(f"sub i64 {rows}, {first}")
    for number, result in zip(pointers, results, strict=True):
        row_of = lambda lane: code.emit(f"add i64 {first}, {lane}")
        _unpack_lanes(code, result, code.argument(number), row_of, valid)
    code.do(f"br label %{done}")
    code.enter(done)
    code.do("ret void")


def write_unpack_rows(code: VectorCode, results: list[Result]) -> None:
    """Write the function `unpack_rows`, from a frame whose lanes are of any rows to the results."""
    pointers = range(len(code.program.inputs), len(code.program.inputs) + len(results))
    code.begin("void @unpack_rows(ptr noalias %state, ptr noalias %rows, i64 %valid, ptr noalias %frame)")
    for number, result in zip(pointers, results, strict=True):
        row_of = lambda lane: code.emit(f"load i64, ptr {code.entry('%rows', 'i64', lane)}")
        _unpack_lanes(code, result, code.argument(number), row_of, "%valid")
    code.do("ret void")


def _pack(code: VectorCode, source: str, lanes: list[str], count: int, kind: str) -> str:
    """Pack rows of an argument to vectors; return the name of their array in the frame."""
    width, place = code.width, code.allocate(kind, count)
    unit = {"f": code.scalar, "i": "i32", "b": "i8"}[kind]
    vector = code.types[kind]
    starts = []
    for row in lanes:
        offset = code.emit(f"mul i64 {row}, {count}")
        starts.append(code.emit(f"getelementptr {unit}, ptr {source}, i64 {offset}"))
    if count >= width and kind != "b":

        def square(entry: str) -> None:
            rows = [code.emit(f"load {vector}, ptr {code.entry(start, unit, entry)}, align 4") for start in starts]
            for j, column in enumerate(_transpose(code, rows, vector)):
                target = code.entry(code.entry(place, vector, entry), vector, j)
                code.do(f"store {vector} {column}, ptr {target}, align 4")

        _repeat_squares(code, count, square)
        return place
    if 1 < count and kind != "b":
        rows = [_load_first_entries(code, start, vector, count) for start in starts]
        for j, column in enumerate(_transpose(code, rows, vector)[:count]):
            code.do(f"store {vector} {column}, ptr {code.entry(place, vector, j)}, align 4")
        return place

    def one(entry: str | int) -> None:
        byte = "byte" if kind == "b" else kind
        gathered = "poison"
        for lane, start in enumerate(starts):
            scalar = code.emit(f"load {unit}, ptr {code.entry(start, unit, entry)}")
            gathered = code.emit(f"insertelement {code.types[byte]} {gathered}, {unit} {scalar}, i64 {lane}")
        if kind == "b":
            gathered = code.emit(f"icmp ne {code.types['byte']} {gathered}, zeroinitializer")
        code.store(kind, gathered, code.entry(place, code.memory_types[kind], entry))

    code.repeat(count, one)
    return place


def _unpack(code: VectorCode, result: Result, target: str, row: str) -> None:
    """Unpack the vectors of a full block, whose first row is `row`, to rows of a result."""
    place, count, kind = result
    width, vector, unit = code.width, code.types[kind], code.units[kind]
    first = code.emit(f"mul i64 {row}, {count}")
    start = code.emit(f"getelementptr {unit}, ptr {target}, i64 {first}")
    if count >= width:

        def square(entry: str) -> None:
            columns = []
            for j in range(width):
                source = code.entry(code.entry(place, vector, entry), vector, j)
                columns.append(code.emit(f"load {vector}, ptr {source}, align 4"))
            for lane, row in enumerate(_transpose(code, columns, vector)):
                target_row = code.entry(code.entry(start, unit, entry), unit, lane * count)
                code.do(f"store {vector} {row}, ptr {target_row}, align 1")

        _repeat_squares(code, count, square)
        return
    columns = [code.emit(f"load {vector}, ptr {code.entry(place, vector, j)}, align 1") for j in range(count)]
    if count == 1:
        code.do(f"store {vector} {columns[0]}, ptr {start}, align 1")
        return
    for lane, row in enumerate(_transpose(code, columns + ["poison"] * (width - count), vector)):
        # Each row covers what is too much of the one before; the last ones must not reach beyond the block.
        if lane * count + width <= width * count:
            code.do(f"store {vector} {row}, ptr {code.entry(start, unit, lane * count)}, align 1")
        else:
            _store_first_entries(code, row, code.entry(start, unit, lane * count), vector, count)


def _load_first_entries(code: VectorCode, source: str, vector: str, count: int) -> str:
    """Load the first entries of a vector, and nothing of what is behind them in memory."""
    name, mask = _declare_masked(code, "load", vector, f"ptr, i32, {code.types['b']}, {vector}", vector, count)
    return code.emit(f"call {vector} {name}(ptr {source}, i32 1, {mask}, {vector} poison)")


def _store_first_entries(code: VectorCode, row: str, target: str, vector: str, count: int) -> None:
    """Store the first entries of a vector."""
    name, mask = _declare_masked(code, "store", vector, f"{vector}, ptr, i32, {code.types['b']}", "void", count)
    code.do(f"call void {name}({vector} {row}, ptr {target}, i32 1, {mask})")


def _declare_masked(
    code: VectorCode, what: str, vector: str, arguments: str, result: str, count: int
) -> tuple[str, str]:
    """Declare one of LLVM's functions for parts of vectors; return its name and the mask of the first entries."""
    unit = {"double": "f64", "float": "f32", "i32": "i32", "i8": "i8"}[vector.split(" x ")[1].rstrip(">")]
    name = f"@llvm.masked.{what}.v{code.width}{unit}.p0"
    code.declare(f"declare {result} {name}({arguments})")
    flags = ", ".join(f"i1 {'true' if j < count else 'false'}" for j in range(code.width))
    return name, f"{code.types['b']} <{flags}>"


def _unpack_lanes(code: VectorCode, result: Result, target: str, row_of: Callable[[str], str], valid: str) -> None:
    """Unpack the first `valid` lanes to rows of a result, one by one."""
    place, count, kind = result
    unit = code.units[kind]

    def row(lane: str) -> None:
        begin = code.emit(f"mul i64 {row_of(lane)}, {count}")

        def one(entry: str) -> None:
            at = code.emit(f"mul i64 {entry}, {code.width}")
            source = code.emit(f"add i64 {at}, {lane}")
            scalar = code.emit(f"load {unit}, ptr {code.entry(place, unit, source)}")
            there = code.emit(f"add i64 {begin}, {entry}")
            code.do(f"store {unit} {scalar}, ptr {code.entry(target, unit, there)}")

        code.repeat(count, one)

    code.repeat(valid, row)


def _repeat_squares(code: VectorCode, count: int, square: Callable[[str], None]) -> None:
    """Write a loop over `count` entries, a square of them in each round; the last square ends at the last entry."""
    width = code.width

    def at(number: str) -> None:
        entry = code.emit(f"mul i64 {number}, {width}")
        late = code.emit(f"icmp ugt i64 {entry}, {count - width}")
        square(code.emit(f"select i1 {late}, i64 {count - width}, i64 {entry}"))

    code.repeat(-(-count // width), at)


def _transpose(code: VectorCode, rows: list[str], vector: str) -> list[str]:
    """Transpose a square of vectors by Eklundh's method: blocks of doubling size change places."""
    width, step = len(rows), 1
    while step < width:
        out = list(rows)
        for i in range(width):
            if i & step:
                continue
            pair = f"{vector} {rows[i]}, {vector} {rows[i | step]}"
            for target, mask in (
                (i, [j if not j & step else width + (j ^ step) for j in range(width)]),
                (i | step, [j | step if not j & step else width + j for j in range(width)]),
            ):
                picked = ", ".join(f"i32 {m}" for m in mask)
                out[target] = code.emit(f"shufflevector {pair}, <{width} x i32> <{picked}>")
        rows, step = out, 2 * step
    return rows
