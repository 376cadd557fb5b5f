"""Load kernels from PTX with NVIDIA's driver, for whichever devices they are launched on."""

import ctypes
import functools
from typing import Any

from jaxgrasp.kernels.code.llvm import Unavailable

# The version with which kernels came that belong to no context.
_OLDEST = 12000
_LOG_BYTES = 4096
# Numbers of cuda.h: options of the assembler, and the attribute that a kernel is asked for.
_ERROR_LOG, _ERROR_LOG_BYTES = 5, 6
_NUM_REGS = 4


@functools.cache
def load_driver() -> Any:
    """Load the driver's library.

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
    """Return the address of `cuLaunchKernel`.

    Raises:
        Unavailable: no driver.
    """
    return ctypes.cast(load_driver().cuLaunchKernel, ctypes.c_void_p).value or 0


# Buffers that the driver writes to, which may be whenever it assembles; they must stay alive.
_written: list[Any] = []


def load_kernel(ptx: bytes, name: str, devices: list[int]) -> int:
    """Load a kernel for as long as the process lasts; return the driver's handle of it.

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
    code = load_driver().cuLibraryLoadData(
        ctypes.byref(library), ctypes.c_char_p(ptx), options, values, ctypes.c_uint(2), None, None, ctypes.c_uint(0)
    )
    _check(code, "load", log.value.decode(errors="replace"))
    handle = ctypes.c_void_p()
    _check(load_driver().cuLibraryGetKernel(ctypes.byref(handle), library, name.encode()), "find", "")
    for number in devices:
        device, registers = ctypes.c_int(), ctypes.c_int()
        _check(load_driver().cuDeviceGet(ctypes.byref(device), ctypes.c_int(number)), "find the device of", "")
        code = load_driver().cuKernelGetAttribute(ctypes.byref(registers), _NUM_REGS, handle, device)
        _check(code, "assemble", log.value.decode(errors="replace"))
    return handle.value or 0


def _check(code: int, what: str, more: str) -> None:
    if code:
        raise RuntimeError(f"the GPU's driver does not {what} it, CUDA error {code}{more and ': '}{more.strip()}")
