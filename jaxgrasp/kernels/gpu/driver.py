"""NVIDIA's driver: kernels from PTX, on whichever devices they are launched."""

import ctypes
import functools
from typing import Any

from jaxgrasp.kernels.code.llvm import Unavailable

# Kernels that belong to no context came with this version.
_OLDEST = 12000
_LOG_BYTES = 4096
# Numbers of cuda.h: options of the assembler, and what a kernel is asked for.
_ERROR_LOG, _ERROR_LOG_BYTES = 5, 6
_NUM_REGS = 4


@functools.cache
def driver() -> Any:
    """The driver's library.

    Raises:
        Unavailable: there is none, or it is too old.
    """
    try:
        library = ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise Unavailable(f"no driver for NVIDIA's GPUs: {error}") from None
    version = ctypes.c_int(0)
    if library.cuInit(0) or library.cuDriverGetVersion(ctypes.byref(version)):
        raise Unavailable("the driver for NVIDIA's GPUs does not start")
    if version.value < _OLDEST:
        raise Unavailable(f"the driver for NVIDIA's GPUs is of CUDA {version.value // 1000}, 12 or later is needed")
    return library


def launch_address() -> int:
    """Of `cuLaunchKernel`.

    Raises:
        Unavailable: no driver.
    """
    return ctypes.cast(driver().cuLaunchKernel, ctypes.c_void_p).value or 0


# Where the driver writes, which may be whenever it assembles.
_written: list[Any] = []


def kernel(ptx: bytes, name: str, devices: list[int]) -> int:
    """The driver's handle of a kernel, which stays loaded.

    Args:
        ptx: the code.
        name: of the kernel.
        devices: numbers of the devices that it is made ready for; what is wrong with it is then known before it runs.

    Raises:
        Unavailable: no driver.
        RuntimeError: the driver does not accept it.
    """
    library = ctypes.c_void_p()
    log = ctypes.create_string_buffer(_LOG_BYTES)
    options = (ctypes.c_int * 2)(_ERROR_LOG, _ERROR_LOG_BYTES)
    values = (ctypes.c_void_p * 2)(ctypes.addressof(log), _LOG_BYTES)
    _written.append((log, options, values))
    code = driver().cuLibraryLoadData(
        ctypes.byref(library), ctypes.c_char_p(ptx), options, values, ctypes.c_uint(2), None, None, ctypes.c_uint(0)
    )
    _check(code, "load", log.value.decode(errors="replace"))
    handle = ctypes.c_void_p()
    _check(driver().cuLibraryGetKernel(ctypes.byref(handle), library, name.encode()), "find", "")
    for number in devices:
        device, registers = ctypes.c_int(), ctypes.c_int()
        _check(driver().cuDeviceGet(ctypes.byref(device), ctypes.c_int(number)), "find the device of", "")
        code = driver().cuKernelGetAttribute(ctypes.byref(registers), _NUM_REGS, handle, device)
        _check(code, "assemble", log.value.decode(errors="replace"))
    return handle.value or 0


def _check(code: int, what: str, more: str) -> None:
    if code:
        raise RuntimeError(f"the GPU's driver does not {what} it, CUDA error {code}{more and ': '}{more.strip()}")
