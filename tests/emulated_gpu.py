"""A GPU's kernels on the host: the same code, thread after thread."""

from __future__ import annotations

import ctypes

import jax
import numpy as np

from jaxgrasp.fence import loops
from jaxgrasp.kernels import fingerprint, gpu, machine
from jaxgrasp.kernels.lowering import Program, lowered

SPECIAL = "@llvm.nvvm.read.ptx.sreg."
GRID = """
@at = internal global [3 x i32] zeroinitializer
@READ@
define void @grid(i32 %blocks, i32 %threads, ptr %parameters) {
entry:
  %threads.p = getelementptr i32, ptr @at, i64 1
  store i32 %threads, ptr %threads.p
  %thread.p = getelementptr i32, ptr @at, i64 2
  br label %block
block:
  %b = phi i32 [ 0, %entry ], [ %b.next, %done ]
  store i32 %b, ptr @at
  br label %thread
thread:
  %t = phi i32 [ 0, %block ], [ %t.next, %thread ]
  store i32 %t, ptr %thread.p
@CALL@
  %t.next = add i32 %t, 1
  %t.more = icmp ult i32 %t.next, %threads
  br i1 %t.more, label %thread, label %done
done:
  %b.next = add i32 %b, 1
  %b.more = icmp ult i32 %b.next, %blocks
  br i1 %b.more, label %block, label %out
out:
  ret void
}
"""


class Emulated:
    """A program's kernel, as code of the host."""

    def __init__(self, program: Program) -> None:
        self.program = program
        text = gpu.module(program, "kernel").replace("ptx_kernel ", "").replace("addrspace(1) ", "")
        lines = [line for line in text.splitlines() if not line.startswith(("target", f"declare i32 {SPECIAL}"))]
        count = len(program.inputs) + len(program.outputs)
        call = []
        for number in range(count + 1):
            kind = "i64" if number == count else "ptr"
            call += [
                f"  %p{number} = getelementptr ptr, ptr %parameters, i64 {number}",
                f"  %at{number} = load ptr, ptr %p{number}",
                f"  %x{number} = load {kind}, ptr %at{number}",
            ]
        given = ", ".join(f"ptr %x{number}" for number in range(count))
        call.append(f"  call void @kernel({given}, i64 %x{count})")
        read = "".join(
            f"define internal i32 @special.{name}.x() {{\n  %p = getelementptr i32, ptr @at, i64 {index}\n"
            "  %v = load i32, ptr %p\n  ret i32 %v\n}\n"
            for index, name in enumerate(("ctaid", "ntid", "tid"))
        )
        text = "\n".join(lines).replace(SPECIAL, "@special.")
        grid = GRID.replace("@READ@", read).replace("@CALL@", "\n".join(call))
        address = machine.loaded(machine.compiled(text + grid), "grid")
        self.launch = ctypes.CFUNCTYPE(None, ctypes.c_uint, ctypes.c_uint, ctypes.c_void_p)(address)

    def __call__(self, *arguments: np.ndarray, threads: int = gpu.THREADS) -> list[np.ndarray]:
        """Results for batch-first arguments; those that are shared have no batch."""
        rows = next(len(x) for x, shared in zip(arguments, self.program.shared, strict=True) if not shared)
        given = [np.ascontiguousarray(x) for x in arguments]
        results = [np.empty((rows, *shape[:-1]), dtype) for shape, dtype in self.program.out_avals]
        parameters = [*[ctypes.c_void_p(x.ctypes.data) for x in (*given, *results)], ctypes.c_int64(rows)]
        places = [ctypes.addressof(x) for x in parameters]
        self.launch(-(-rows // threads), threads, (ctypes.c_void_p * len(places))(*places))
        return results


_kernels: dict[str, Emulated] = {}


def fused(function, leaves, shared, otherwise, known_as=None):
    """In place of `kernels.fused`: every kernel is emulated."""
    problems = next(x.shape[0] for x, s in zip(leaves, shared, strict=True) if not s)
    events = [x.shape if s else x.shape[1:] for x, s in zip(leaves, shared, strict=True)]
    given = [jax.ShapeDtypeStruct((*e, 1), x.dtype) for e, x in zip(events, leaves, strict=True)]
    with loops():
        jaxpr, out = jax.make_jaxpr(function, return_shape=True)(given)
    key = fingerprint.of_program(jaxpr, shared, "emulated")
    if key not in _kernels:
        _kernels[key] = Emulated(lowered(jaxpr, list(shared)))
    wanted, structure = jax.tree.flatten(out)
    shapes = [jax.ShapeDtypeStruct((problems, *x.shape[:-1]), x.dtype) for x in wanted]
    found = jax.pure_callback(lambda *parts: _kernels[key](*map(np.asarray, parts)), shapes, *leaves)
    return jax.tree.unflatten(structure, found)
