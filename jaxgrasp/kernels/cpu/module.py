"""The CPU target: a program as a native function behind XLA's foreign function interface.

XLA calls the handler with batch-first arrays. Blocks of as many lanes as a vector has are packed, solved and unpacked
by XLA's own threads, which take them from a common counter. All of it is LLVM code: no other compiler is needed.
"""

import math

from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.code.ffi import fill
from jaxgrasp.kernels.cpu.compaction import compacts, write_block
from jaxgrasp.kernels.cpu.handler import API_BYTES, HANDLER, POINTERS, SPOIL, frames
from jaxgrasp.kernels.cpu.packing import Result, pack_arguments, write_unpack, write_unpack_rows
from jaxgrasp.kernels.cpu.vectors import Body, VectorCode
from jaxgrasp.kernels.program.expressions import Unsupported, Value, kind_of
from jaxgrasp.kernels.program.lowering import ScalarProgram
from jaxgrasp.kernels.program.schedule import schedule

# JAX's name of the devices.
PLATFORM: str = "cpu"
# Bytes of a block's arguments and results in a thread's frame.
_MOST_BYTES = 1 << 25
# The most blocks that a thread takes at a time.
_CHUNK = 16
# Vector registers for values, by the bytes of a vector: AVX-512 has 32 registers, others have 16.
_REGISTERS = {64: 26}
_FEWER_REGISTERS = 11


def description() -> str:
    """Describe everything about the processor that compiled code depends on.

    Raises:
        Unavailable: kernels cannot be compiled for it here.
    """
    return llvm.processor().description


def compile_program(program: ScalarProgram, name: str) -> bytes:
    """Compile a program to object code for the processor at hand, whose handler is `name`.

    Raises:
        Unsupported: see `write_module`.
        RuntimeError: LLVM does not accept it.
    """
    at = llvm.processor()
    width = at.vector_bytes // program.builder.dtype.itemsize
    return llvm.compile_module(write_module(program, name, width, estimates=at.estimates, spoilt=at.spoilt))


def load_handler(code: bytes, name: str) -> int:
    """Load object code; return the address of the handler."""
    return llvm.load(code, name)


def write_module(program: ScalarProgram, name: str, width: int, *, estimates: bool, spoilt: bool = False) -> str:
    """Write LLVM code of the handler `name` and all that it calls.

    Args:
        program: what to compute.
        name: of the handler.
        width: lanes of a vector.
        estimates: whether the processor has AVX-512's estimates of reciprocals.
        spoilt: whether all bits of a thread's memory are set before each use.

    Raises:
        Unsupported: a block's data are too large, or of a type that is not known.
    """
    _check_size(program, width)
    code = VectorCode(program, width, estimates=estimates)
    results, body = _write_body(code)
    write_unpack(code, results)
    if compacts(body):
        write_unpack_rows(code, results)
    frame_bytes = max(body.frame_bytes, 64)
    spill_bytes = frame_bytes if compacts(body) else 64
    values = {
        **frames(frame_bytes, spill_bytes),
        "NAME": f"@{name}",
        "API_BYTES": API_BYTES,
        "FUNCTIONS": code.text(),
        "BLOCK": write_block(body),
        "SPOIL": SPOIL if spoilt else "",
        "FRAME_BYTES": frame_bytes,
        "SPILL_BYTES": spill_bytes,
        "QUEUE_WORDS": 1 + 3 * width,
        "DECLARATIONS": "\n".join(sorted(code.declarations)),
        "STATE_BYTES": 8 * (POINTERS + len(program.inputs) + len(program.outputs)),
        "POINTERS": POINTERS,
        "ARGUMENTS": len(program.inputs),
        "RESULTS": len(program.outputs),
        "FIRST_RESULT": POINTERS + len(program.inputs),
        "WIDTH": width,
        "CHUNK": _CHUNK,
    }
    return fill(HANDLER, values)


def _check_size(program: ScalarProgram, width: int) -> None:
    for _, dtype in program.inputs + program.out_avals:
        if dtype.kind in "iu" and dtype.itemsize != 4:
            raise Unsupported(f"arguments or results of type {dtype}")
    own = sum(math.prod(s) for (s, _), shared in zip(program.inputs, program.shared, strict=True) if not shared)
    if (own + sum(x.size for x in program.outputs)) * width * program.builder.dtype.itemsize > _MOST_BYTES:
        raise Unsupported("data too large for a thread's frame")


def _write_body(code: VectorCode) -> tuple[list[Result], Body]:
    """Write the functions that take a block of lanes from arguments to results in its frame.

    They are three where a program has a main loop: `before` it, its `rounds`, and `after` it; else `before` is all.
    """
    program, width = code.program, code.width
    code.begin("void @before(ptr noalias %state, i64 %block, ptr noalias %frame)")
    own = pack_arguments(code)
    results = []
    for out, (_, dtype) in zip(program.outputs, program.out_avals, strict=True):
        kind = "byte" if dtype.kind == "b" else kind_of(dtype)
        results.append(Result(code.allocate(kind, max(1, out.size)), out.size, kind))
    scalars = [(r, e, x) for r, out in enumerate(program.outputs) for e, x in enumerate(out.flat)]

    def store(number: int, name: str) -> None:
        result, entry, value = scalars[number]
        place, _, kind = results[result]
        if type(value) is not Value:
            name = code.constant(value, "b" if kind == "byte" else kind)
        if kind == "byte":
            name = code.emit(f"zext {code.types['b']} {name} to {code.types['byte']}")
        code.do(f"store {code.types[kind]} {name}, ptr {code.entry(place, code.types[kind], entry)}, align {width}")

    registers = _REGISTERS.get(width * program.builder.dtype.itemsize, _FEWER_REGISTERS)
    body = code.write(schedule(program), own, store, registers)
    code.do("ret void")
    return results, body
