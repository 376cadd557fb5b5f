"""The handler that XLA calls to launch a kernel on a GPU: LLVM code for the host.

Where one of XLA's structures is smaller than what is read from it, the handler does nothing at all: the caller finds
its results untouched. Pointers need not be copied: the driver is given the places in XLA's structures where they, and
the number of rows of the first result, are. The driver launches on the stream's device. XLA is not told that calls may
be recorded in its command buffers: the driver may still be loading the kernel.
"""

from jaxgrasp.kernels.code import ffi

# How much of `XLA_FFI_Api` the handler reads.
_API_BYTES = ffi.Api.STREAM_GET + 8

_HANDLER = """
declare i32 @snprintf(ptr, i64, ptr, ...)
@format = private constant [@LENGTH@ x i8] c"@FORMAT@"
@PREAMBLE@
  %context = call ptr @field(ptr %frame, i64 @CallFrame.CONTEXT@)
  %arguments = call ptr @field(ptr %frame, i64 @CallFrame.ARGUMENTS@)
  %results = call ptr @field(ptr %frame, i64 @CallFrame.RESULTS@)
  %first = call ptr @field(ptr %results, i64 0)
  %rows.p = call ptr @field(ptr %first, i64 @Buffer.DIMENSIONS@)
  %rows = load i64, ptr %rows.p
  %empty = icmp eq i64 %rows, 0
  br i1 %empty, label %nothing, label %ask
ask:
  %question = alloca [4 x i64]
  store i64 @CallBytes.STREAM_GET@, ptr %question
  %question.1 = getelementptr i64, ptr %question, i64 1
  store ptr null, ptr %question.1
  %question.2 = getelementptr i64, ptr %question, i64 2
  store ptr %context, ptr %question.2
  %stream.p = getelementptr i64, ptr %question, i64 3
  store ptr null, ptr %stream.p
  %stream.f = call ptr @field(ptr %api, i64 @Api.STREAM_GET@)
  %refusal = call ptr %stream.f(ptr %question)
  %given = icmp eq ptr %refusal, null
  br i1 %given, label %launch, label %refused
refused:
  ret ptr %refusal
launch:
  %stream = load ptr, ptr %stream.p
  %count.p = getelementptr i8, ptr %frame, i64 @CallFrame.ARGUMENT_COUNT@
  %count = load i64, ptr %count.p
  %left.p = getelementptr i8, ptr %frame, i64 @CallFrame.RESULT_COUNT@
  %left = load i64, ptr %left.p
  %both.count = add i64 %count, %left
  %places = add i64 %both.count, 1
  %parameters = alloca ptr, i64 %places
  br label %argument
argument:
  %a = phi i64 [ 0, %launch ], [ %a.next, %argument ]
  %a.p = getelementptr ptr, ptr %arguments, i64 %a
  %a.buffer = load ptr, ptr %a.p
  %a.data = getelementptr i8, ptr %a.buffer, i64 @Buffer.DATA@
  %a.slot = getelementptr ptr, ptr %parameters, i64 %a
  store ptr %a.data, ptr %a.slot
  %a.next = add i64 %a, 1
  %a.more = icmp ult i64 %a.next, %count
  br i1 %a.more, label %argument, label %result
result:
  %r = phi i64 [ 0, %argument ], [ %r.next, %result ]
  %r.p = getelementptr ptr, ptr %results, i64 %r
  %r.buffer = load ptr, ptr %r.p
  %r.data = getelementptr i8, ptr %r.buffer, i64 @Buffer.DATA@
  %r.place = add i64 %count, %r
  %r.slot = getelementptr ptr, ptr %parameters, i64 %r.place
  store ptr %r.data, ptr %r.slot
  %r.next = add i64 %r, 1
  %r.more = icmp ult i64 %r.next, %left
  br i1 %r.more, label %result, label %go
go:
  %last = getelementptr ptr, ptr %parameters, i64 %both.count
  store ptr %rows.p, ptr %last
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
  %length = call i32 (ptr, i64, ptr, ...) @snprintf(ptr %message, i64 128, ptr @format, i32 %code)
  %report = alloca [4 x i64]
  store i64 @CallBytes.ERROR_CREATE@, ptr %report
  %report.1 = getelementptr i64, ptr %report, i64 1
  store ptr null, ptr %report.1
  %report.2 = getelementptr i64, ptr %report, i64 2
  store ptr %message, ptr %report.2
  %report.3 = getelementptr i64, ptr %report, i64 3
  store i64 @INTERNAL@, ptr %report.3
  %error.f = call ptr @field(ptr %api, i64 @Api.ERROR_CREATE@)
  %error = call ptr %error.f(ptr %report)
  ret ptr %error
}
"""  # noqa: E501

_FORMAT = "jaxgrasp: the GPU's driver does not launch a kernel, CUDA error %d"


def write_module(name: str, *, kernel: int, launch: int, threads: int) -> str:
    """Write LLVM code of a handler that launches a kernel of all arguments and results and the number of rows.

    Args:
        name: of the handler.
        kernel: the driver's handle of the kernel.
        launch: address of `cuLaunchKernel`.
        threads: how many threads a block has.
    """
    values = {
        "NAME": f"@{name}",
        "API_BYTES": _API_BYTES,
        "BEYOND": threads - 1,
        "THREADS": threads,
        "LAUNCH": launch,
        "KERNEL": kernel,
        "FORMAT": _FORMAT + "\\00",
        "LENGTH": len(_FORMAT) + 1,
    }
    return ffi.fill(_HANDLER, values)
