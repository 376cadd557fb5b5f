"""What launches kernels on GPUs: the driver and XLA are stood in for, and see what they are told."""

from __future__ import annotations

import ctypes

import emulated_gpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgrasp import kernels
from jaxgrasp.kernels import primitive
from jaxgrasp.kernels.code import llvm
from jaxgrasp.kernels.gpu import driver, handler
from jaxgrasp.kernels.gpu import module as gpu
from jaxgrasp.lanes import tiles as lanes

no_gpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="is about machines without a GPU")


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
        text = handler.write_module("launcher", kernel=4321, launch=launch_at, threads=64)
        self.handler = ctypes.CFUNCTYPE(p, p)(llvm.load(llvm.compile_module(text), "launcher"))
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


@no_gpu
def test_xla_hears_of_errors():
    """XLA's own structures: on a CPU it has no stream to give."""
    text = handler.write_module("without_stream", kernel=1, launch=1, threads=64)
    address = llvm.load(llvm.compile_module(text), "without_stream")
    jax.ffi.register_ffi_target("without_stream", llvm.capsule(address), platform="cpu")
    with pytest.raises(jax.errors.JaxRuntimeError, match="GPU context is not available"):
        jax.block_until_ready(jax.ffi.ffi_call("without_stream", jax.ShapeDtypeStruct((3,), "float32"))(jnp.zeros(3)))


# The driver


class Library:
    """A driver's library of some version, which answers a call of its choice with an error."""

    def __init__(self, version: int = 12_040, wrong: str = "") -> None:
        self.version, self.wrong, self.calls = version, wrong, []

    def __getattr__(self, name: str):
        def call(*given):
            self.calls.append(name)
            if name == "cuDriverGetVersion":
                given[0]._obj.value = self.version
            if name == "cuLibraryLoadData":
                assert given[1].value == b"ptx" and list(given[2]) == [5, 6] and given[4].value == 2
                ctypes.memmove(given[3][0], b"line 7: what?", 13)
                given[0]._obj.value = 11
            if name == "cuLibraryGetKernel":
                assert given[1].value == 11 and given[2] == b"kernel"
                given[0]._obj.value = 22
            return 218 if name == self.wrong else 0

        return call


@pytest.fixture
def load(monkeypatch):
    """Puts a library in place of the driver's."""

    def put(library: Library | None) -> None:
        def cdll(name: str) -> Library:
            if library is None:
                raise OSError("cannot open shared object file")
            return library

        monkeypatch.setattr(driver.ctypes, "CDLL", cdll)

    driver.load_driver.cache_clear()
    yield put
    driver.load_driver.cache_clear()


def test_a_kernel_is_loaded_and_assembled_for_every_device(load):
    load(library := Library())
    assert driver.load_kernel(b"ptx", "kernel", [0, 1]) == 22
    ready = ["cuDeviceGet", "cuKernelGetAttribute"]
    assert library.calls[2:] == ["cuLibraryLoadData", "cuLibraryGetKernel", *ready, *ready]


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ("cuLibraryLoadData", "does not load it, CUDA error 218: line 7: what?"),
        ("cuLibraryGetKernel", "does not find it, CUDA error 218"),
        ("cuKernelGetAttribute", "does not assemble it, CUDA error 218: line 7: what?"),
    ],
)
def test_a_kernel_that_does_not_load_says_why(load, wrong, why):
    load(Library(wrong=wrong))
    with pytest.raises(RuntimeError) as raised:
        driver.load_kernel(b"ptx", "kernel", [0])
    assert str(raised.value).endswith(why)


@pytest.mark.parametrize(
    ("library", "why"),
    [
        (None, "no driver for NVIDIA's GPUs: cannot open"),
        (Library(11_080), "of CUDA 11, 12 or later is needed"),
        (Library(wrong="cuInit"), "does not start"),
    ],
)
def test_a_driver_that_cannot_be_used_says_why(load, library, why):
    load(library)
    with pytest.raises(llvm.Unavailable, match=why):
        driver.load_driver()


# What is chosen


def doubled(parts):
    return parts[0] * 2


@no_gpu
def test_without_a_gpu_nothing_is_looked_for(monkeypatch):
    def look():
        raise AssertionError("it is looked for a GPU")

    monkeypatch.setattr(driver, "load_driver", look)
    monkeypatch.setattr(gpu, "devices", look)
    for asked in ("auto", "xla", "fused"):
        monkeypatch.setenv(primitive.SETTING, asked)
        assert not kernels.usable("cuda")
        assert kernels.usable() == (asked != "xla")


@no_gpu
def test_where_a_gpu_cannot_be_used_one_warning_says_why(monkeypatch):
    """JAX says that there is one, but not one of NVIDIA's."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not kernels.usable("cuda")
    monkeypatch.setenv(primitive.SETTING, "fused")
    primitive._warn.cache_clear()
    with pytest.warns(RuntimeWarning, match="JAX knows no GPU of NVIDIA's") as told:
        assert not kernels.usable("cuda")
        assert not kernels.usable("cuda")
    assert len(told) == 1
    primitive._works.cache_clear()


@no_gpu
def test_a_kernel_that_does_not_load_is_left_to_xla(monkeypatch, tmp_path):
    def wrong(code, name, devices):
        raise RuntimeError("the GPU's driver does not load it")

    with emulated_gpu.in_place(tmp_path):
        monkeypatch.setattr(driver, "load_kernel", wrong)
        primitive._warn.cache_clear()
        with pytest.warns(RuntimeWarning, match="does not load it"):
            out = primitive.fused(doubled, [jnp.ones((3, 5))], (False,), lambda leaves: leaves[0] - 7, None, "cuda")
        np.testing.assert_array_equal(out, np.full((3, 5), -6))


@no_gpu
@pytest.mark.parametrize(("asked", "calls"), [("auto", 0), ("xla", 0), ("fused", 1)])
def test_what_is_lowered_for_a_gpu(monkeypatch, tmp_path, asked, calls):
    """One call of a kernel where that is asked for; on the same machine's CPU, none."""
    x = jnp.ones((6, 3))
    run = lambda x: lanes.map_lanes(  # noqa: E731
        (lambda t: t["x"] * 3,), {"x": x}, {"x": False}, 3, compact=False
    )
    with emulated_gpu.in_place(tmp_path):
        # As it is with a GPU, and lowering for its platform needs none.
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        monkeypatch.setattr(primitive, "usable", lanes.usable)
        monkeypatch.setattr(lanes, "fused", primitive.fused)
        monkeypatch.setenv(primitive.SETTING, asked)
        traced = jax.jit(run).trace(x)
        found = [traced.lower(lowering_platforms=(p,)).as_text().count("@jaxgrasp_") for p in ("cuda", "cpu")]
        assert found == [calls, 0]
        monkeypatch.undo()
