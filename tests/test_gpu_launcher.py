"""What launches kernels on GPUs: the driver and XLA are stood in for, and see what they are told."""

from __future__ import annotations

import ctypes

import emulated_gpu
import jax
import jax.numpy as jnp
import pytest

from jaxgrasp.kernels import launcher, machine


class Driver:
    """A driver that writes down what it is told, and an XLA that gives a stream."""

    def __init__(self, code: int = 0, refusal: int | None = None) -> None:
        self.launched: list[tuple] = []
        self.errors: list[tuple[str, int]] = []

        def launch(kernel, x, y, z, tx, ty, tz, memory, stream, parameters, extra):
            places = ctypes.cast(parameters, ctypes.POINTER(ctypes.POINTER(ctypes.c_int64)))
            self.launched.append(
                (kernel, (x, y, z, tx, ty, tz), memory, stream, [places[i][0] for i in range(4)], extra)
            )
            return code

        def stream_get(question):
            question = ctypes.cast(question, ctypes.POINTER(emulated_gpu.Question))[0]
            assert question.struct_size == ctypes.sizeof(emulated_gpu.Question) and question.context == 77
            question.stream = 55
            return refusal

        def error_create(question):
            question = ctypes.cast(question, ctypes.POINTER(emulated_gpu.Question))[0]
            code = (question.stream or 0) & 0xFFFFFFFF
            self.errors.append((ctypes.string_at(question.context).decode(), code))
            return 99

        u, p = ctypes.c_uint, ctypes.c_void_p
        self.functions = [
            ctypes.CFUNCTYPE(ctypes.c_int, p, u, u, u, u, u, u, u, p, p, p)(launch),
            ctypes.CFUNCTYPE(p, p)(stream_get),
            ctypes.CFUNCTYPE(p, p)(error_create),
        ]
        launch_at, stream_at, error_at = (ctypes.cast(f, p).value for f in self.functions)
        text = launcher.module("launcher", kernel=4321, launch=launch_at, threads=64)
        self.handler = ctypes.CFUNCTYPE(p, p)(machine.loaded(machine.compiled(text), "launcher"))
        version = emulated_gpu.Version(ctypes.sizeof(emulated_gpu.Version), None, 0, 3)
        size = ctypes.sizeof(emulated_gpu.Api)
        self.api = emulated_gpu.Api(size, None, version, None, error_at, None, None, None, stream_at)

    def call(self, rows: int, **changes: int) -> int | None:
        size = ctypes.sizeof(emulated_gpu.Frame)
        arguments, results = emulated_gpu.buffers((rows, 2), (7,)), emulated_gpu.buffers((rows, 3))
        frame = emulated_gpu.Frame(size, None, ctypes.pointer(self.api), 77, 3, arguments, results)
        for name, value in changes.items():
            setattr(frame, name, value)
        return self.handler(ctypes.addressof(frame))


@pytest.mark.parametrize(("rows", "blocks"), [(1, 1), (64, 1), (65, 2), (1_000_000, 15_625)])
def test_a_call_launches_one_kernel_on_the_stream(rows, blocks):
    """With addresses of arguments and results, then the number of rows."""
    driver = Driver()
    assert driver.call(rows) is None
    assert driver.launched == [(4321, (blocks, 1, 1, 64, 1, 1), 0, 55, [1000, 2000, 1000, rows], None)]


def test_a_call_of_no_rows_launches_nothing():
    driver = Driver()
    assert driver.call(0) is None
    assert driver.launched == [] == driver.errors


def test_what_the_driver_refuses_is_an_error():
    driver = Driver(code=701)
    assert driver.call(5) == 99
    assert driver.errors == [("jaxgrasp: the GPU's driver does not launch a kernel, CUDA error 701", 13)]


def test_a_stream_that_is_not_given_is_an_error():
    driver = Driver(refusal=88)
    assert driver.call(5) == 88
    assert driver.launched == []


def test_structures_that_do_not_fit_launch_nothing():
    driver = Driver()
    assert driver.call(5, struct_size=112) is None
    driver.api.struct_size -= 8
    assert driver.call(5) is None
    driver.api.struct_size += 8
    driver.api.version.major = 1
    assert driver.call(5) is None
    assert driver.launched == []


def test_xla_hears_of_errors():
    """XLA's own structures: on a CPU it has no stream to give."""
    text = launcher.module("without_stream", kernel=1, launch=1, threads=64)
    address = machine.loaded(machine.compiled(text), "without_stream")
    jax.ffi.register_ffi_target("without_stream", machine.capsule(address), platform="cpu")
    with pytest.raises(jax.errors.JaxRuntimeError, match="GPU context is not available"):
        jax.block_until_ready(jax.ffi.ffi_call("without_stream", jax.ShapeDtypeStruct((3,), "float32"))(jnp.zeros(3)))
