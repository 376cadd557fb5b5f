"""XLA's foreign function interface: offsets in its structures, and the code with which every handler begins.

The offsets are those of xla/ffi/api/c_api.h, version 0.3, in bytes on 64-bit machines. A template names them as marks,
as in `@CallFrame.API@`, which `fill` replaces.
"""

from collections.abc import Mapping
from enum import IntEnum

# The version of c_api.h.
MAJOR, MINOR = 0, 3


class CallFrame(IntEnum):
    """Offsets in `XLA_FFI_CallFrame`, which a handler is called with; `SIZE` is how much of it handlers read."""

    EXTENSION = 8
    API = 16
    CONTEXT = 24
    ARGUMENT_COUNT = 56
    ARGUMENTS = 72
    RESULT_COUNT = 96
    RESULTS = 112
    SIZE = 120


class Buffer(IntEnum):
    """Offsets in `XLA_FFI_Buffer`, an argument or a result."""

    DATA = 24
    DIMENSIONS = 40


class Metadata(IntEnum):
    """Offsets in `XLA_FFI_Metadata`, and where `XLA_FFI_Metadata_Extension` points to it.

    XLA calls a handler once with this extension, to be told which version the handler is of.
    """

    IN_EXTENSION = 24
    MAJOR = 24
    MINOR = 28


class Api(IntEnum):
    """Offsets in `XLA_FFI_Api`: its version and pointers to XLA's functions."""

    MAJOR = 32
    ERROR_CREATE = 48
    STREAM_GET = 80
    THREAD_POOL_SCHEDULE = 136
    THREAD_POOL_NUM_THREADS = 144


class CallBytes(IntEnum):
    """Sizes of the structures that XLA's functions are called with."""

    ERROR_CREATE = 28
    STREAM_GET = 32
    THREAD_POOL_SCHEDULE = 40
    THREAD_POOL_NUM_THREADS = 32


# XLA_FFI_Error_Code_INTERNAL.
INTERNAL = 13

# A pointer of a structure, and the beginning of a handler: it answers XLA's question for its version, and goes on to
# the block `begin` where XLA's structures are as large as what is read from them, else to `nothing`.
PREAMBLE = """
define internal ptr @field(ptr %base, i64 %offset) alwaysinline {
  %p = getelementptr i8, ptr %base, i64 %offset
  %v = load ptr, ptr %p
  ret ptr %v
}

define ptr @NAME@(ptr %frame) {
entry:
  %extension = call ptr @field(ptr %frame, i64 @CallFrame.EXTENSION@)
  %asked = icmp ne ptr %extension, null
  br i1 %asked, label %describe, label %check
describe:
  %metadata = call ptr @field(ptr %extension, i64 @Metadata.IN_EXTENSION@)
  %major.p = getelementptr i8, ptr %metadata, i64 @Metadata.MAJOR@
  %minor.p = getelementptr i8, ptr %metadata, i64 @Metadata.MINOR@
  store i32 @MAJOR@, ptr %major.p
  store i32 @MINOR@, ptr %minor.p
  ret ptr null
check:
  %frame.size = load i64, ptr %frame
  %api = call ptr @field(ptr %frame, i64 @CallFrame.API@)
  %api.size = load i64, ptr %api
  %api.major.p = getelementptr i8, ptr %api, i64 @Api.MAJOR@
  %api.major = load i32, ptr %api.major.p
  %frame.fits = icmp uge i64 %frame.size, @CallFrame.SIZE@
  %api.fits = icmp uge i64 %api.size, @API_BYTES@
  %major.fits = icmp eq i32 %api.major, @MAJOR@
  %both = and i1 %frame.fits, %api.fits
  %fits = and i1 %both, %major.fits
  br i1 %fits, label %begin, label %nothing
nothing:
  ret ptr null
begin:"""

_OFFSETS = {
    f"{struct.__name__}.{name}": int(number)
    for struct in (CallFrame, Buffer, Metadata, Api, CallBytes)
    for name, number in struct.__members__.items()
}
_CONSTANTS = {"MAJOR": MAJOR, "MINOR": MINOR, "INTERNAL": INTERNAL, **_OFFSETS}


def fill(template: str, values: Mapping[str, object]) -> str:
    """Replace the marks `@MARK@` of a template.

    Args:
        template: LLVM code; `@PREAMBLE@` in it stands for what every handler begins with.
        values: what replaces the marks other than the constants of this file, by their names. `PREAMBLE` needs `NAME`,
            the handler's, and `API_BYTES`, how much of `XLA_FFI_Api` the handler reads.
    """
    text = template.replace("@PREAMBLE@", PREAMBLE)
    for mark, value in {**values, **_CONSTANTS}.items():
        text = text.replace(f"@{mark}@", str(value))
    return text
