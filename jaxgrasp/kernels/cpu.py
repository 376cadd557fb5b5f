"""A program as a native function behind XLA's foreign function interface, for CPUs.

XLA calls the handler with batch-first arrays. Blocks of as many problems as a vector has lanes are packed, solved and
unpacked by XLA's own threads, which take them from a common counter. All of it is LLVM code: no compiler is needed.
"""

import math
from collections.abc import Callable

import numpy as np

from jaxgrasp.kernels.expressions import Value, kind_of
from jaxgrasp.kernels.lowering import Program, Unsupported
from jaxgrasp.kernels.schedule import scheduled
from jaxgrasp.kernels.vector_code import VectorCode

# Bytes of a block's arguments and results on the stack of a thread.
_MOST_STACK = 1 << 19
# Blocks that a thread takes at a time, at most.
_CHUNK = 16
# A call's data that its threads share, in words: rows, blocks, next block, blocks done, users, blocks at a time; then
# pointers to arguments and results.
_POINTERS = 6


def module(program: Program, name: str, width: int, *, estimates: bool) -> str:
    """LLVM code of the handler `name` and all that it calls.

    Args:
        program: what to compute.
        name: of the handler.
        width: lanes of a vector.
        estimates: whether the processor has AVX-512's estimates of reciprocals.

    Raises:
        Unsupported: a block's data are too large, or of a type that is not known.
    """
    code = VectorCode(program.builder.dtype, width, estimates=estimates)
    _block(program, code)
    body = "\n".join(["entry:", *code.allocations, *code.lines])
    count = len(program.inputs) + len(program.outputs)
    values = {
        "@NAME@": f"@{name}",
        "@BODY@": body,
        "@DECLARATIONS@": "\n".join(sorted(code.declarations)),
        "@STATE_BYTES@": str(8 * (_POINTERS + count)),
        "@ARGUMENTS@": str(len(program.inputs)),
        "@RESULTS@": str(len(program.outputs)),
        "@FIRST_RESULT@": str(_POINTERS + len(program.inputs)),
        "@WIDTH@": str(width),
        "@CHUNK@": str(_CHUNK),
    }
    text = _RUNTIME
    for mark, value in values.items():
        text = text.replace(mark, value)
    return text


def _block(program: Program, code: VectorCode) -> None:
    """One block of problems: %state is the call's data, %block its number."""
    width = code.width
    size = width * program.builder.dtype.itemsize
    for shape, dtype in program.inputs + program.out_avals:
        if dtype.kind in "iu" and dtype.itemsize != 4:
            raise Unsupported(f"arguments or results of type {dtype}")
    own = sum(math.prod(s) for (s, _), shared in zip(program.inputs, program.shared, strict=True) if not shared)
    if (own + sum(x.size for x in program.outputs)) * size > _MOST_STACK:
        raise Unsupported("data too large for a thread's stack")
    rows = code.emit("load i64, ptr %state")
    first = code.emit(f"mul i64 %block, {width}")
    last = code.emit(f"sub i64 {rows}, 1")
    lanes = []
    for lane in range(width):
        row = code.emit(f"add i64 {first}, {lane}")
        inside = code.emit(f"icmp ult i64 {row}, {rows}")
        lanes.append(code.emit(f"select i1 {inside}, i64 {row}, i64 {last}"))
    for number, ((shape, dtype), shared) in enumerate(zip(program.inputs, program.shared, strict=True)):
        pointer = _pointer(code, number)
        if shared:
            code.shared.append(pointer)
            code.own.append("")
        else:
            code.shared.append("")
            code.own.append(_pack(code, pointer, lanes, math.prod(shape), kind_of(dtype)))
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
    beyond = code.emit(f"add i64 {first}, {width}")
    full = code.emit(f"icmp ule i64 {beyond}, {rows}")
    whole, part, done = code.label("whole"), code.label("part"), code.label("done")
    code.do(f"br i1 {full}, label %{whole}, label %{part}")
    code.enter(whole)
    for number, (place, count, kind) in enumerate(results):
        _unpack(code, place, _pointer(code, len(program.inputs) + number), lanes, count, kind)
    code.do(f"br label %{done}")
    code.enter(part)
    valid = code.emit(f"sub i64 {rows}, {first}")
    for number, (place, count, kind) in enumerate(results):
        _unpack_some(code, place, _pointer(code, len(program.inputs) + number), first, valid, count, kind)
    code.do(f"br label %{done}")
    code.enter(done)
    code.do("ret void")


def _pointer(code: VectorCode, number: int) -> str:
    place = code.emit(f"getelementptr i64, ptr %state, i64 {_POINTERS + number}")
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

    def one(entry: str | int) -> None:
        byte = "byte" if kind == "b" else kind
        gathered = "poison"
        for lane, start in enumerate(starts):
            scalar = code.emit(f"load {unit}, ptr {code.entry(start, unit, entry)}")
            gathered = code.emit(f"insertelement {code.types[byte]} {gathered}, {unit} {scalar}, i64 {lane}")
        if kind == "b":
            gathered = code.emit(f"icmp ne {code.types['byte']} {gathered}, zeroinitializer")
        code.do(f"store {vector} {gathered}, ptr {code.entry(place, vector, entry)}")

    code.repeat(count, one)
    return place


def _unpack(code: VectorCode, place: str, target: str, lanes: list[str], count: int, kind: str) -> None:
    """Vectors of a full block as rows of a result."""
    width, vector, unit = code.width, code.types[kind], code.units[kind]
    first = code.emit(f"mul i64 {lanes[0]}, {count}")
    start = code.emit(f"getelementptr {unit}, ptr {target}, i64 {first}")
    if count >= width:

        def some(entry: str) -> None:
            columns = []
            for j in range(width):
                source = code.entry(code.entry(place, vector, entry), vector, j)
                columns.append(code.emit(f"load {vector}, ptr {source}, align 4"))
            for lane, row in enumerate(_transposed(code, columns, vector)):
                code.do(f"store {vector} {row}, ptr {code.entry(code.entry(start, unit, entry), unit, lane * count)}, align 1")

        _in_strides(code, count, some)
        return
    for entry in range(count):
        column = code.emit(f"load {vector}, ptr {code.entry(place, vector, entry)}, align 1")
        if count == 1:
            code.do(f"store {vector} {column}, ptr {start}, align 1")
            return
        for lane in range(width):
            scalar = code.emit(f"extractelement {vector} {column}, i64 {lane}")
            code.do(f"store {unit} {scalar}, ptr {code.entry(start, unit, lane * count + entry)}")


def _unpack_some(code: VectorCode, place: str, target: str, first: str, valid: str, count: int, kind: str) -> None:
    """The same of the last block, whose last lanes are empty."""
    unit = code.units[kind]

    def row(lane: str) -> None:
        number = code.emit(f"add i64 {first}, {lane}")
        begin = code.emit(f"mul i64 {number}, {count}")

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


# The offsets are those of xla/ffi/api/c_api.h, version 0.3. Where a structure is smaller than what is read from it, the
# handler does nothing at all: the caller finds its results untouched. A thread that comes late finds no block left;
# the last one to leave frees the call's data.
_RUNTIME = """
declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()
@DECLARATIONS@

define internal void @block(ptr noalias %state, i64 %block) #0 {
@BODY@
}

define internal void @take(ptr %state) {
entry:
  %blocks.p = getelementptr i64, ptr %state, i64 1
  %next.p = getelementptr i64, ptr %state, i64 2
  %done.p = getelementptr i64, ptr %state, i64 3
  %chunk.p = getelementptr i64, ptr %state, i64 5
  %blocks = load i64, ptr %blocks.p
  %chunk = load i64, ptr %chunk.p
  br label %more
more:
  %from = atomicrmw add ptr %next.p, i64 %chunk monotonic
  %some = icmp ult i64 %from, %blocks
  br i1 %some, label %work, label %out
work:
  %beyond = add i64 %from, %chunk
  %short = icmp ult i64 %blocks, %beyond
  %to = select i1 %short, i64 %blocks, i64 %beyond
  br label %one
one:
  %number = phi i64 [ %from, %work ], [ %following, %one ]
  call void @block(ptr %state, i64 %number)
  %following = add i64 %number, 1
  %again = icmp ult i64 %following, %to
  br i1 %again, label %one, label %counted
counted:
  %share = sub i64 %to, %from
  %before = atomicrmw add ptr %done.p, i64 %share release
  br label %more
out:
  ret void
}

define internal void @leave(ptr %state) {
entry:
  %users.p = getelementptr i64, ptr %state, i64 4
  %users = atomicrmw sub ptr %users.p, i64 1 acq_rel
  %last = icmp eq i64 %users, 1
  br i1 %last, label %gone, label %out
gone:
  call void @free(ptr %state)
  br label %out
out:
  ret void
}

define internal void @help(ptr %state) {
  call void @take(ptr %state)
  call void @leave(ptr %state)
  ret void
}

define internal ptr @field(ptr %base, i64 %offset) alwaysinline {
  %p = getelementptr i8, ptr %base, i64 %offset
  %v = load ptr, ptr %p
  ret ptr %v
}

define ptr @NAME@(ptr %frame) {
entry:
  %extension = call ptr @field(ptr %frame, i64 8)
  %asked = icmp ne ptr %extension, null
  br i1 %asked, label %describe, label %check
describe:
  %metadata = call ptr @field(ptr %extension, i64 24)
  %major.p = getelementptr i8, ptr %metadata, i64 24
  %minor.p = getelementptr i8, ptr %metadata, i64 28
  store i32 0, ptr %major.p
  store i32 3, ptr %minor.p
  ret ptr null
check:
  %frame.size = load i64, ptr %frame
  %api = call ptr @field(ptr %frame, i64 16)
  %api.size = load i64, ptr %api
  %api.major.p = getelementptr i8, ptr %api, i64 32
  %api.major = load i32, ptr %api.major.p
  %frame.fits = icmp uge i64 %frame.size, 120
  %api.fits = icmp uge i64 %api.size, 152
  %major.fits = icmp eq i32 %api.major, 0
  %both = and i1 %frame.fits, %api.fits
  %fits = and i1 %both, %major.fits
  br i1 %fits, label %begin, label %nothing
nothing:
  ret ptr null
begin:
  %state = call ptr @malloc(i64 @STATE_BYTES@)
  %arguments = call ptr @field(ptr %frame, i64 72)
  %results = call ptr @field(ptr %frame, i64 112)
  %context = call ptr @field(ptr %frame, i64 24)
  br label %argument
argument:
  %a = phi i64 [ 0, %begin ], [ %a.next, %argument ]
  %a.p = getelementptr ptr, ptr %arguments, i64 %a
  %a.buffer = load ptr, ptr %a.p
  %a.data = call ptr @field(ptr %a.buffer, i64 24)
  %a.place = add i64 %a, 6
  %a.slot = getelementptr i64, ptr %state, i64 %a.place
  store ptr %a.data, ptr %a.slot
  %a.next = add i64 %a, 1
  %a.more = icmp ult i64 %a.next, @ARGUMENTS@
  br i1 %a.more, label %argument, label %result
result:
  %r = phi i64 [ 0, %argument ], [ %r.next, %result ]
  %r.p = getelementptr ptr, ptr %results, i64 %r
  %r.buffer = load ptr, ptr %r.p
  %r.data = call ptr @field(ptr %r.buffer, i64 24)
  %r.place = add i64 %r, @FIRST_RESULT@
  %r.slot = getelementptr i64, ptr %state, i64 %r.place
  store ptr %r.data, ptr %r.slot
  %r.next = add i64 %r, 1
  %r.more = icmp ult i64 %r.next, @RESULTS@
  br i1 %r.more, label %result, label %share
share:
  %first.buffer = load ptr, ptr %results
  %dimensions = call ptr @field(ptr %first.buffer, i64 40)
  %rows = load i64, ptr %dimensions
  %padded = add i64 %rows, @WIDTH@
  %almost = sub i64 %padded, 1
  %blocks = udiv i64 %almost, @WIDTH@
  %count.p = alloca i64
  %question = alloca [4 x i64]
  store i64 1, ptr %count.p
  store i64 32, ptr %question
  %question.1 = getelementptr i64, ptr %question, i64 1
  %question.2 = getelementptr i64, ptr %question, i64 2
  %question.3 = getelementptr i64, ptr %question, i64 3
  store i64 0, ptr %question.1
  store ptr %context, ptr %question.2
  store ptr %count.p, ptr %question.3
  %threads.f = call ptr @field(ptr %api, i64 144)
  %error = call ptr %threads.f(ptr %question)
  %threads = load i64, ptr %count.p
  %alone = icmp slt i64 %threads, 1
  %workers = select i1 %alone, i64 1, i64 %threads
  %parts = mul i64 %workers, 4
  %even = udiv i64 %blocks, %parts
  %large = icmp ugt i64 %even, @CHUNK@
  %capped = select i1 %large, i64 @CHUNK@, i64 %even
  %none = icmp eq i64 %capped, 0
  %chunk = select i1 %none, i64 1, i64 %capped
  %few = icmp ult i64 %blocks, %workers
  %used = select i1 %few, i64 %blocks, i64 %workers
  store i64 %rows, ptr %state
  %s1 = getelementptr i64, ptr %state, i64 1
  %s2 = getelementptr i64, ptr %state, i64 2
  %s3 = getelementptr i64, ptr %state, i64 3
  %s4 = getelementptr i64, ptr %state, i64 4
  %s5 = getelementptr i64, ptr %state, i64 5
  store i64 %blocks, ptr %s1
  store i64 0, ptr %s2
  store i64 0, ptr %s3
  store i64 %used, ptr %s4
  store i64 %chunk, ptr %s5
  %task = alloca [5 x i64]
  %task.1 = getelementptr i64, ptr %task, i64 1
  %task.2 = getelementptr i64, ptr %task, i64 2
  %task.3 = getelementptr i64, ptr %task, i64 3
  %task.4 = getelementptr i64, ptr %task, i64 4
  store i64 40, ptr %task
  store i64 0, ptr %task.1
  store ptr %context, ptr %task.2
  store ptr @help, ptr %task.3
  store ptr %state, ptr %task.4
  %schedule.f = call ptr @field(ptr %api, i64 136)
  br label %call
call:
  %t = phi i64 [ 1, %share ], [ %t.next, %called ], [ %t.next, %refused ]
  %t.more = icmp ult i64 %t, %used
  %t.next = add i64 %t, 1
  br i1 %t.more, label %ask, label %own
ask:
  %refusal = call ptr %schedule.f(ptr %task)
  %ok = icmp eq ptr %refusal, null
  br i1 %ok, label %called, label %refused
called:
  br label %call
refused:
  %u = atomicrmw sub ptr %s4, i64 1 monotonic
  br label %call
own:
  call void @take(ptr %state)
  br label %wait
wait:
  %finished = load atomic i64, ptr %s3 acquire, align 8
  %all = icmp uge i64 %finished, %blocks
  br i1 %all, label %end, label %yield
yield:
  %y = call i32 @sched_yield()
  br label %wait
end:
  call void @leave(ptr %state)
  ret ptr null
}

attributes #0 = { nounwind }
"""
