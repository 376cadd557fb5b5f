"""A program as a native function behind XLA's foreign function interface, for CPUs.

XLA calls the handler with batch-first arrays. Blocks of as many problems as a vector has lanes are packed, solved and
unpacked by XLA's own threads, which take them from a common counter. All of it is LLVM code: no compiler is needed.
"""

import math
from collections.abc import Callable

from jaxgrasp.kernels.code import llvm as machine
from jaxgrasp.kernels.code.ffi import fill
from jaxgrasp.kernels.cpu.handler import API_BYTES, HANDLER, POINTERS, SPOIL
from jaxgrasp.kernels.cpu.vectors import VectorCode
from jaxgrasp.kernels.cpu.waiting import blocks, waits
from jaxgrasp.kernels.program.expressions import Unsupported, Value, kind_of
from jaxgrasp.kernels.program.lowering import Program
from jaxgrasp.kernels.program.schedule import scheduled

# As XLA calls the devices.
PLATFORM = "cpu"
# Bytes of a block's arguments and results on the stack of a thread.
_MOST_STACK = 1 << 19
# Blocks that a thread takes at a time, at most.
_CHUNK = 16


def description() -> str:
    """Everything about the processor that compiled code depends on.

    Raises:
        Unavailable: there are no fused kernels here.
    """
    return machine.machine().description


def compiled(program: Program, name: str) -> bytes:
    """Object code of a program for the processor at hand, whose handler is `name`.

    Raises:
        Unsupported: see `module`.
        RuntimeError: LLVM does not accept it.
    """
    at = machine.machine()
    width = at.vector_bytes // program.builder.dtype.itemsize
    return machine.compiled(module(program, name, width, estimates=at.estimates, spoilt=at.spoilt))


def handler(code: bytes, name: str) -> int:
    """Address of the function that XLA calls."""
    return machine.loaded(code, name)


def module(program: Program, name: str, width: int, *, estimates: bool, spoilt: bool = False) -> str:
    """LLVM code of the handler `name` and all that it calls.

    Args:
        program: what to compute.
        name: of the handler.
        width: lanes of a vector.
        estimates: whether the processor has AVX-512's estimates of reciprocals.
        spoilt: whether all bits of a thread's memory are set before each use.

    Raises:
        Unsupported: a block's data are too large, or of a type that is not known.
    """
    code = VectorCode(program.builder.dtype, width, estimates=estimates)
    code.begun = lambda: _shared(program, code)
    results = _block(program, code)
    _unpacking(program, code, results)
    count = len(program.inputs) + len(program.outputs)
    values = {
        "NAME": f"@{name}",
        "API_BYTES": API_BYTES,
        "FUNCTIONS": code.written(),
        "BLOCK": blocks(code),
        "SPOIL": SPOIL if spoilt else "",
        "FRAME_BYTES": max(code.used, 64),
        "REST_BYTES": code.used if waits(code) else 64,
        "BOOK": 1 + 3 * width,
        "DECLARATIONS": "\n".join(sorted(code.declarations)),
        "STATE_BYTES": 8 * (POINTERS + count),
        "POINTERS": POINTERS,
        "ARGUMENTS": len(program.inputs),
        "RESULTS": len(program.outputs),
        "FIRST_RESULT": POINTERS + len(program.inputs),
        "WIDTH": width,
        "CHUNK": _CHUNK,
    }
    return fill(HANDLER, values)


def _shared(program: Program, code: VectorCode) -> None:
    """Every function reads where the arguments lie that all problems share."""
    code.shared = [_pointer(code, number) if shared else "" for number, shared in enumerate(program.shared)]


def _block(program: Program, code: VectorCode) -> list[tuple[str, int, str]]:
    """One block of problems, from arguments to results in its frame; where these lie, how many and of which kind.

    Three functions where a program has one loop of unknown length: `before`, its `rounds` and `after`; else `before`
    is all.
    """
    width = code.width
    size = width * program.builder.dtype.itemsize
    for _, dtype in program.inputs + program.out_avals:
        if dtype.kind in "iu" and dtype.itemsize != 4:
            raise Unsupported(f"arguments or results of type {dtype}")
    own = sum(math.prod(s) for (s, _), shared in zip(program.inputs, program.shared, strict=True) if not shared)
    if (own + sum(x.size for x in program.outputs)) * size > _MOST_STACK:
        raise Unsupported("data too large for a thread's stack")
    code.begin("void @before(ptr noalias %state, i64 %block, ptr noalias %frame)")
    rows = code.emit("load i64, ptr %state")
    first = code.emit(f"mul i64 %block, {width}")
    last = code.emit(f"sub i64 {rows}, 1")
    lanes = []
    for lane in range(width):
        row = code.emit(f"add i64 {first}, {lane}")
        inside = code.emit(f"icmp ult i64 {row}, {rows}")
        lanes.append(code.emit(f"select i1 {inside}, i64 {row}, i64 {last}"))
    for number, ((shape, dtype), shared) in enumerate(zip(program.inputs, program.shared, strict=True)):
        code.sizes.append(math.prod(shape))
        code.own.append("" if shared else _pack(code, _pointer(code, number), lanes, code.sizes[-1], kind_of(dtype)))
    results = []
    for out, (_, dtype) in zip(program.outputs, program.out_avals, strict=True):
        kind = "byte" if dtype.kind == "b" else kind_of(dtype)
        results.append((code.allocate(kind, max(1, out.size)), out.size, kind))
    scalars = [(r, e, x) for r, out in enumerate(program.outputs) for e, x in enumerate(out.flat)]

    def store(number: int, name: str) -> None:
        result, entry, value = scalars[number]
        place, _, kind = results[result]
        if type(value) is not Value:
            name = code.constant(value, "b" if kind == "byte" else kind)
        if kind == "byte":
            name = code.emit(f"zext {code.types['b']} {name} to {code.types['byte']}")
        code.do(f"store {code.types[kind]} {name}, ptr {code.entry(place, code.types[kind], entry)}, align {width}")

    code.follow(scheduled(program), store, 26 if width * program.builder.dtype.itemsize == 64 else 11)
    code.do("ret void")
    return results


def _unpacking(program: Program, code: VectorCode, results: list[tuple[str, int, str]]) -> None:
    """From frames to results: of a block, whose last lanes may be empty, and of lanes from anywhere."""
    pointers = range(len(program.inputs), len(program.inputs) + len(results))
    code.begin("void @unpack(ptr noalias %state, i64 %block, ptr noalias %frame)")
    rows = code.emit("load i64, ptr %state")
    first = code.emit(f"mul i64 %block, {code.width}")
    beyond = code.emit(f"add i64 {first}, {code.width}")
    full = code.emit(f"icmp ule i64 {beyond}, {rows}")
    whole, part, done = code.label("whole"), code.label("part"), code.label("done")
    code.do(f"br i1 {full}, label %{whole}, label %{part}")
    code.enter(whole)
    for number, (place, count, kind) in zip(pointers, results, strict=True):
        _unpack(code, place, _pointer(code, number), first, count, kind)
    code.do(f"br label %{done}")
    code.enter(part)
    valid = code.emit(f"sub i64 {rows}, {first}")
    for number, (place, count, kind) in zip(pointers, results, strict=True):
        row_of = lambda lane: code.emit(f"add i64 {first}, {lane}")
        _unpack_some(code, place, _pointer(code, number), row_of, valid, count, kind)
    code.do(f"br label %{done}")
    code.enter(done)
    code.do("ret void")
    if not waits(code):
        return
    code.begin("void @unpack_rows(ptr noalias %state, ptr noalias %rows, i64 %valid, ptr noalias %frame)")
    for number, (place, count, kind) in zip(pointers, results, strict=True):
        row_of = lambda lane: code.emit(f"load i64, ptr {code.entry('%rows', 'i64', lane)}")
        _unpack_some(code, place, _pointer(code, number), row_of, "%valid", count, kind)
    code.do("ret void")


def _pointer(code: VectorCode, number: int) -> str:
    place = code.emit(f"getelementptr i64, ptr %state, i64 {POINTERS + number}")
    return code.emit(f"load ptr, ptr {place}")


def _pack(code: VectorCode, source: str, lanes: list[str], count: int, kind: str) -> str:
    """Rows of an argument as vectors, one an entry."""
    width, place = code.width, code.allocate(kind, count)
    unit = {"f": code.scalar, "i": "i32", "b": "i8"}[kind]
    vector = code.types[kind]
    starts = []
    for row in lanes:
        offset = code.emit(f"mul i64 {row}, {count}")
        starts.append(code.emit(f"getelementptr {unit}, ptr {source}, i64 {offset}"))
    if count >= width and kind != "b":

        def some(entry: str) -> None:
            rows = [code.emit(f"load {vector}, ptr {code.entry(start, unit, entry)}, align 4") for start in starts]
            for j, column in enumerate(_transposed(code, rows, vector)):
                target = code.entry(code.entry(place, vector, entry), vector, j)
                code.do(f"store {vector} {column}, ptr {target}, align 4")

        _in_strides(code, count, some)
        return place
    if 1 < count and kind != "b":
        rows = [_first_entries(code, start, vector, count) for start in starts]
        for j, column in enumerate(_transposed(code, rows, vector)[:count]):
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
        code.store(kind, gathered, code.entry(place, code.kept[kind], entry))

    code.repeat(count, one)
    return place


def _unpack(code: VectorCode, place: str, target: str, row: str, count: int, kind: str) -> None:
    """Vectors of a full block as rows of a result."""
    width, vector, unit = code.width, code.types[kind], code.units[kind]
    first = code.emit(f"mul i64 {row}, {count}")
    start = code.emit(f"getelementptr {unit}, ptr {target}, i64 {first}")
    if count >= width:

        def some(entry: str) -> None:
            columns = []
            for j in range(width):
                source = code.entry(code.entry(place, vector, entry), vector, j)
                columns.append(code.emit(f"load {vector}, ptr {source}, align 4"))
            for lane, row in enumerate(_transposed(code, columns, vector)):
                target_row = code.entry(code.entry(start, unit, entry), unit, lane * count)
                code.do(f"store {vector} {row}, ptr {target_row}, align 1")

        _in_strides(code, count, some)
        return
    columns = [code.emit(f"load {vector}, ptr {code.entry(place, vector, j)}, align 1") for j in range(count)]
    if count == 1:
        code.do(f"store {vector} {columns[0]}, ptr {start}, align 1")
        return
    for lane, row in enumerate(_transposed(code, columns + ["poison"] * (width - count), vector)):
        # Each row covers what is too much of the one before; the last ones must not reach beyond the block.
        if lane * count + width <= width * count:
            code.do(f"store {vector} {row}, ptr {code.entry(start, unit, lane * count)}, align 1")
        else:
            _store_first_entries(code, row, code.entry(start, unit, lane * count), vector, count)


def _first_entries(code: VectorCode, source: str, vector: str, count: int) -> str:
    """The first entries of a vector in memory, and nothing of what is behind them."""
    name, mask = _masked(code, "load", vector, f"ptr, i32, {code.types['b']}, {vector}", vector, count)
    return code.emit(f"call {vector} {name}(ptr {source}, i32 1, {mask}, {vector} poison)")


def _store_first_entries(code: VectorCode, row: str, target: str, vector: str, count: int) -> None:
    """The first entries of a vector, to memory."""
    name, mask = _masked(code, "store", vector, f"{vector}, ptr, i32, {code.types['b']}", "void", count)
    code.do(f"call void {name}({vector} {row}, ptr {target}, i32 1, {mask})")


def _masked(code: VectorCode, what: str, vector: str, arguments: str, result: str, count: int) -> tuple[str, str]:
    """One of LLVM's functions for parts of vectors, and a mask for the first entries."""
    unit = {"double": "f64", "float": "f32", "i32": "i32", "i8": "i8"}[vector.split(" x ")[1].rstrip(">")]
    name = f"@llvm.masked.{what}.v{code.width}{unit}.p0"
    code.declare(f"declare {result} {name}({arguments})")
    flags = ", ".join(f"i1 {'true' if j < count else 'false'}" for j in range(code.width))
    return name, f"{code.types['b']} <{flags}>"


def _unpack_some(
    code: VectorCode, place: str, target: str, row_of: Callable[[str], str], valid: str, count: int, kind: str
) -> None:
    """The first lanes as rows of a result, one by one."""
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


def _in_strides(code: VectorCode, count: int, some: Callable[[str], None]) -> None:
    """Vector after vector of `count` entries; the last one ends at the end."""
    width = code.width

    def at(number: str) -> None:
        entry = code.emit(f"mul i64 {number}, {width}")
        late = code.emit(f"icmp ugt i64 {entry}, {count - width}")
        some(code.emit(f"select i1 {late}, i64 {count - width}, i64 {entry}"))

    code.repeat(-(-count // width), at)


def _transposed(code: VectorCode, rows: list[str], vector: str) -> list[str]:
    """Eklundh's transpose of a square: blocks of doubling size change places."""
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
