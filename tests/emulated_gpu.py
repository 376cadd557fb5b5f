"""A GPU on the host: the same kernels, thread after thread, launched by the same handler that XLA calls.

Where there is a GPU, it takes its place.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import jax
import pytest

from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.gpu import driver, handler
from jaxgrasp.kernels.gpu import module as gpu
from jaxgrasp.lanes import tiles as lanes

SPECIAL = "@llvm.nvvm.read.ptx.sreg."
# The numbers of a thread: its block, the threads of a block, its number in it.
REGISTERS = ("ctaid", "ntid", "tid")
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
# `cuLaunchKernel`, to which a kernel's handle is the address of its grid.
LAUNCH = """
define i32 @launch(ptr %f, i32 %x, i32 %y, i32 %z, i32 %t, i32 %ty, i32 %tz, i32 %b, ptr %s, ptr %parameters, ptr %e) {
  call void %f(i32 %x, i32 %t, ptr %parameters)
  ret i32 0
}
"""

# LLVM's texts of all kernels that were made in `in_place`.
codes: list[str] = []


def kernel(code: bytes, name: str, devices: list[int]) -> int:
    """In place of the driver's: the address of a function that runs a kernel for all threads of a grid.

    Args:
        code: LLVM's text of the kernel for a GPU.
        name: of the kernel.
        devices: of no meaning here.
    """
    text = code.decode().replace("ptx_kernel ", "").replace("addrspace(1) ", "")
    lines = [line for line in text.splitlines() if not line.startswith(("target", f"declare i32 {SPECIAL}"))]
    (head,) = [line for line in lines if line.startswith("define")]
    kinds = [part.split()[0] for part in head[head.index("(") + 1 : head.rindex(")")].split(",")]
    call = []
    for number, kind in enumerate(kinds):
        call += [
            f"  %p{number} = getelementptr ptr, ptr %parameters, i64 {number}",
            f"  %at{number} = load ptr, ptr %p{number}",
            f"  %x{number} = load {kind}, ptr %at{number}",
        ]
    call.append(f"  call void @{name}({', '.join(f'{kind} %x{number}' for number, kind in enumerate(kinds))})")
    read = "".join(
        f"define internal i32 @special.{special}.x() {{\n  %p = getelementptr i32, ptr @at, i64 {index}\n"
        "  %v = load i32, ptr %p\n  ret i32 %v\n}\n"
        for index, special in enumerate(REGISTERS)
    )
    grid = GRID.replace("@READ@", read).replace("@CALL@", "\n".join(call))
    return llvm.load(llvm.compile_module("\n".join(lines).replace(SPECIAL, "@special.") + grid), "grid")


@cache
def launch_address() -> int:
    """In place of the driver's."""
    return llvm.load(llvm.compile_module(LAUNCH), "launch")


def no_kernel(leaves):
    raise AssertionError("no fused kernel")


@contextlib.contextmanager
def in_place(folder: Path) -> Iterator[None]:
    """Inside, kernels run on the GPU where there is one, else as on one, and what cannot become a kernel is an error.

    Without a GPU all but the driver, the assembler and the stream are what they are with one.

    Args:
        folder: where kernels are kept.
    """
    there = jax.default_backend() == "gpu"

    def fused(function, leaves, shared, otherwise, known_as=None, platform="cpu" if there else "cuda"):
        wanted = platform == "cuda" and primitive._allowed.value
        return primitive.fused(function, leaves, shared, no_kernel if wanted else otherwise, known_as, platform)

    def module(program, name, write=gpu.write_module):
        codes.append(write(program, name))
        return codes[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.setenv(primitive.SETTING, "fused")
        patch.setattr(gpu, "write_module", module)
        patch.setattr(lanes, "fused", fused)
        if not there:
            emulate(patch)
        jax.clear_caches()
        assert primitive.usable("cuda")
        yield
    if not there:
        primitive._works.cache_clear()
    jax.clear_caches()


def emulate(patch: pytest.MonkeyPatch) -> None:
    """What is for GPUs runs on CPUs."""
    asks = "call ptr %stream.f(ptr %question)"
    patch.setattr(gpu, "PLATFORM", "cpu")
    patch.setattr(gpu, "devices", lambda: gpu.Devices([0], 80, "emulated"))
    patch.setattr(gpu, "write_ptx", lambda code, capability: code)
    patch.setattr(driver, "load_kernel", kernel)
    patch.setattr(driver, "launch_address", launch_address)
    assert asks in handler._HANDLER
    patch.setattr(handler, "_HANDLER", handler._HANDLER.replace(asks, "getelementptr i8, ptr null, i64 0"))
    patch.setattr(primitive, "usable", lambda platform: primitive._allowed.value and primitive._works(platform))


# What XLA hands to a handler, see xla/ffi/api/c_api.h.


class Buffer(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    ]


class Buffers(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(Buffer))),
    ]


class Version(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    ]


class Api(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", Version),
        ("internal", ctypes.c_void_p),
        ("error_create", ctypes.c_void_p),
        ("error_get_message", ctypes.c_void_p),
        ("error_destroy", ctypes.c_void_p),
        ("handler_register", ctypes.c_void_p),
        ("stream_get", ctypes.c_void_p),
    ]


class Frame(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("api", ctypes.POINTER(Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", Buffers),
        ("results", Buffers),
    ]


class Question(ctypes.Structure):
    """Of XLA_FFI_Stream_Get and, by other names, XLA_FFI_Error_Create."""

    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("context", ctypes.c_void_p),
        ("stream", ctypes.c_void_p),
    ]


def buffers(*shapes: tuple[int, ...]) -> Buffers:
    """Of arrays with these shapes, the first at address 1000, the second at 2000, and so on."""
    made = [
        Buffer(ctypes.sizeof(Buffer), None, 12, 1000 * number, len(shape), (ctypes.c_int64 * len(shape))(*shape))
        for number, shape in enumerate(shapes, 1)
    ]
    pointers = (ctypes.POINTER(Buffer) * len(made))(*map(ctypes.pointer, made))
    return Buffers(ctypes.sizeof(Buffers), None, len(made), None, pointers)
