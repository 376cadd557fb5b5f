"""The handler that XLA calls to launch a kernel on a GPU: LLVM code for the host.

The offsets are those of xla/ffi/api/c_api.h, version 0.3. Where a structure is smaller than what is read from it, the
handler does nothing at all: the caller finds its results untouched. Pointers need not be copied: the driver is given
the places in XLA's buffers where they, and the number of rows, are. It launches where the stream is, whichever device
that is. XLA is not told that calls may be recorded in its command buffers: the driver may still be loading the kernel.
"""

_HANDLER = """
declare i32 @snprintf(ptr, i64, ptr, ...)
@said = private constant [@LENGTH@ x i8] c"@SAID@"

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
  %version = getelementptr i8, ptr %metadata, i64 24
  store i32 0, ptr %version
  %minor = getelementptr i8, ptr %metadata, i64 28
  store i32 3, ptr %minor
  ret ptr null
check:
  %frame.size = load i64, ptr %frame
  %api = call ptr @field(ptr %frame, i64 16)
  %api.size = load i64, ptr %api
  %major.p = getelementptr i8, ptr %api, i64 32
  %major = load i32, ptr %major.p
  %frame.fits = icmp uge i64 %frame.size, 120
  %api.fits = icmp uge i64 %api.size, 88
  %major.fits = icmp eq i32 %major, 0
  %both = and i1 %frame.fits, %api.fits
  %fits = and i1 %both, %major.fits
  br i1 %fits, label %begin, label %nothing
nothing:
  ret ptr null
begin:
  %context = call ptr @field(ptr %frame, i64 24)
  %arguments = call ptr @field(ptr %frame, i64 72)
  %results = call ptr @field(ptr %frame, i64 112)
  %first = call ptr @field(ptr %results, i64 0)
  %rows.p = call ptr @field(ptr %first, i64 40)
  %rows = load i64, ptr %rows.p
  %empty = icmp eq i64 %rows, 0
  br i1 %empty, label %nothing, label %ask
ask:
  %question = alloca [4 x i64]
  store i64 32, ptr %question
  %question.1 = getelementptr i64, ptr %question, i64 1
  store ptr null, ptr %question.1
  %question.2 = getelementptr i64, ptr %question, i64 2
  store ptr %context, ptr %question.2
  %stream.p = getelementptr i64, ptr %question, i64 3
  store ptr null, ptr %stream.p
  %stream.f = call ptr @field(ptr %api, i64 80)
  %refusal = call ptr %stream.f(ptr %question)
  %given = icmp eq ptr %refusal, null
  br i1 %given, label %launch, label %refused
refused:
  ret ptr %refusal
launch:
  %stream = load ptr, ptr %stream.p
  %parameters = alloca [@PARAMETERS@ x ptr]
@FILL@
  %padded = add i64 %rows, @BEYOND@
  %blocks.wide = udiv i64 %padded, @THREADS@
  %blocks = trunc i64 %blocks.wide to i32
  %launch.f = inttoptr i64 @LAUNCH@ to ptr
  %kernel = inttoptr i64 @KERNEL@ to ptr
  %code = call i32 %launch.f(ptr %kernel, i32 %blocks, i32 1, i32 1, i32 @THREADS@, i32 1, i32 1, i32 0, ptr %stream, ptr %parameters, ptr null)
  %good = icmp eq i32 %code, 0
  br i1 %good, label %nothing, label %failed
failed:
  %message = alloca [128 x i8]
  %length = call i32 (ptr, i64, ptr, ...) @snprintf(ptr %message, i64 128, ptr @said, i32 %code)
  %report = alloca [4 x i64]
  store i64 28, ptr %report
  %report.1 = getelementptr i64, ptr %report, i64 1
  store ptr null, ptr %report.1
  %report.2 = getelementptr i64, ptr %report, i64 2
  store ptr %message, ptr %report.2
  %report.3 = getelementptr i64, ptr %report, i64 3
  store i64 13, ptr %report.3
  %error.f = call ptr @field(ptr %api, i64 48)
  %error = call ptr %error.f(ptr %report)
  ret ptr %error
}
"""  # noqa: E501

_SAID = "jaxgrasp: the GPU's driver does not launch a kernel, CUDA error %d"


def module(name: str, arguments: int, results: int, *, kernel: int, launch: int, threads: int) -> str:
    """LLVM code of the handler `name`.

    Args:
        name: of the handler.
        arguments: how many the kernel takes.
        results: how many it leaves, at least one, each with the rows as its first axis.
        kernel: the driver's handle.
        launch: address of `cuLaunchKernel`.
        threads: of a block.
    """
    said = _SAID + "\\00"
    values = {
        "@NAME@": f"@{name}",
        "@FILL@": "\n".join(_fill(arguments, results)),
        "@PARAMETERS@": str(arguments + results + 1),
        "@BEYOND@": str(threads - 1),
        "@THREADS@": str(threads),
        "@LAUNCH@": str(launch),
        "@KERNEL@": str(kernel),
        "@SAID@": said,
        "@LENGTH@": str(len(_SAID) + 1),
    }
    text = _HANDLER
    for mark, value in values.items():
        text = text.replace(mark, value)
    return text


def _fill(arguments: int, results: int) -> list[str]:
    """Where the kernel's parameters are: a buffer's pointer is 24 bytes from where the buffer is."""
    lines = []
    for number in range(arguments + results):
        array, index = ("%arguments", number) if number < arguments else ("%results", number - arguments)
        lines += [
            f"  %buffer{number} = call ptr @field(ptr {array}, i64 {8 * index})",
            f"  %data{number} = getelementptr i8, ptr %buffer{number}, i64 24",
            f"  %slot{number} = getelementptr ptr, ptr %parameters, i64 {number}",
            f"  store ptr %data{number}, ptr %slot{number}",
        ]
    last = arguments + results
    return [*lines, f"  %slot = getelementptr ptr, ptr %parameters, i64 {last}", "  store ptr %rows.p, ptr %slot"]
