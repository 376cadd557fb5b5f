"""The handler that XLA calls, and how its threads share the blocks of a call: LLVM code around that of a block.

Where one of XLA's structures is smaller than what is read from it, the handler does nothing at all: the caller finds
its results untouched. The calling thread waits only for blocks that a running thread has taken; a thread that comes
late finds none left, and the last one to leave frees the call's state.

The state of a call, which its threads share, is an array of words: the number of rows, of blocks, the next block, how
many blocks are done, how many threads use the state, and how many blocks a thread takes at a time; then the pointers to
the arguments' data and to the results'.
"""

from jaxgrasp.kernels.code.ffi import Api

# How much of `XLA_FFI_Api` the handler reads.
API_BYTES = Api.THREAD_POOL_NUM_THREADS + 8
# Where the pointers begin in the state of a call, in words.
POINTERS = 6

HANDLER = """
declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()
declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)
@DECLARATIONS@

@FUNCTIONS@
@BLOCK@

define internal void @take(ptr %state) {
entry:
@FRAMES@
  %queue = alloca [@QUEUE_WORDS@ x i64]
  store i64 0, ptr %queue
  %blocks.p = getelementptr i64, ptr %state, i64 1
  %next.p = getelementptr i64, ptr %state, i64 2
  %done.p = getelementptr i64, ptr %state, i64 3
  %chunk.p = getelementptr i64, ptr %state, i64 5
  %blocks = load i64, ptr %blocks.p
  %chunk = load i64, ptr %chunk.p
  br label %more
more:
  %before = phi i64 [ 0, %entry ], [ %taken, %counted ]
  %from = atomicrmw add ptr %next.p, i64 %chunk monotonic
  %some = icmp ult i64 %from, %blocks
  br i1 %some, label %work, label %out
work:
  %beyond = add i64 %from, %chunk
  %short = icmp ult i64 %blocks, %beyond
  %to = select i1 %short, i64 %blocks, i64 %beyond
  br label %one
one:
  %number = phi i64 [ %from, %work ], [ %following, %one ]
@SPOIL@
  call void @block(ptr %state, i64 %number, ptr %frame, ptr %spill, ptr %queue)
  %following = add i64 %number, 1
  %again = icmp ult i64 %following, %to
  br i1 %again, label %one, label %counted
counted:
  %share = sub i64 %to, %from
  %taken = add i64 %before, %share
  br label %more
out:
  call void @finish(ptr %state, ptr %spill, ptr %queue)
  %done = atomicrmw add ptr %done.p, i64 %before release
@RELEASE@
  ret void
}

define internal void @leave(ptr %state) {
entry:
  %users.p = getelementptr i64, ptr %state, i64 4
  %users = atomicrmw sub ptr %users.p, i64 1 acq_rel
  %last = icmp eq i64 %users, 1
  br i1 %last, label %gone, label %out
gone:
  call void @free(ptr %state)
  br label %out
out:
  ret void
}

define internal void @help(ptr %state) {
  call void @take(ptr %state)
  call void @leave(ptr %state)
  ret void
}
@PREAMBLE@
  %state = call ptr @malloc(i64 @STATE_BYTES@)
  %arguments = call ptr @field(ptr %frame, i64 @CallFrame.ARGUMENTS@)
  %results = call ptr @field(ptr %frame, i64 @CallFrame.RESULTS@)
  %context = call ptr @field(ptr %frame, i64 @CallFrame.CONTEXT@)
  br label %argument
argument:
  %a = phi i64 [ 0, %begin ], [ %a.next, %argument ]
  %a.p = getelementptr ptr, ptr %arguments, i64 %a
  %a.buffer = load ptr, ptr %a.p
  %a.data = call ptr @field(ptr %a.buffer, i64 @Buffer.DATA@)
  %a.place = add i64 %a, @POINTERS@
  %a.slot = getelementptr i64, ptr %state, i64 %a.place
  store ptr %a.data, ptr %a.slot
  %a.next = add i64 %a, 1
  %a.more = icmp ult i64 %a.next, @ARGUMENTS@
  br i1 %a.more, label %argument, label %result
result:
  %r = phi i64 [ 0, %argument ], [ %r.next, %result ]
  %r.p = getelementptr ptr, ptr %results, i64 %r
  %r.buffer = load ptr, ptr %r.p
  %r.data = call ptr @field(ptr %r.buffer, i64 @Buffer.DATA@)
  %r.place = add i64 %r, @FIRST_RESULT@
  %r.slot = getelementptr i64, ptr %state, i64 %r.place
  store ptr %r.data, ptr %r.slot
  %r.next = add i64 %r, 1
  %r.more = icmp ult i64 %r.next, @RESULTS@
  br i1 %r.more, label %result, label %share
share:
  %first.buffer = load ptr, ptr %results
  %dimensions = call ptr @field(ptr %first.buffer, i64 @Buffer.DIMENSIONS@)
  %rows = load i64, ptr %dimensions
  %padded = add i64 %rows, @WIDTH@
  %almost = sub i64 %padded, 1
  %blocks = udiv i64 %almost, @WIDTH@
  %count.p = alloca i64
  %question = alloca [4 x i64]
  store i64 1, ptr %count.p
  store i64 @CallBytes.THREAD_POOL_NUM_THREADS@, ptr %question
  %question.1 = getelementptr i64, ptr %question, i64 1
  %question.2 = getelementptr i64, ptr %question, i64 2
  %question.3 = getelementptr i64, ptr %question, i64 3
  store i64 0, ptr %question.1
  store ptr %context, ptr %question.2
  store ptr %count.p, ptr %question.3
  %threads.f = call ptr @field(ptr %api, i64 @Api.THREAD_POOL_NUM_THREADS@)
  %error = call ptr %threads.f(ptr %question)
  %threads = load i64, ptr %count.p
  %alone = icmp slt i64 %threads, 1
  %workers = select i1 %alone, i64 1, i64 %threads
  %parts = mul i64 %workers, 4
  %even = udiv i64 %blocks, %parts
  %large = icmp ugt i64 %even, @CHUNK@
  %capped = select i1 %large, i64 @CHUNK@, i64 %even
  %none = icmp eq i64 %capped, 0
  %chunk = select i1 %none, i64 1, i64 %capped
  %fewer = icmp ult i64 %blocks, %workers
  %used = select i1 %fewer, i64 %blocks, i64 %workers
  store i64 %rows, ptr %state
  %s1 = getelementptr i64, ptr %state, i64 1
  %s2 = getelementptr i64, ptr %state, i64 2
  %s3 = getelementptr i64, ptr %state, i64 3
  %s4 = getelementptr i64, ptr %state, i64 4
  %s5 = getelementptr i64, ptr %state, i64 5
  store i64 %blocks, ptr %s1
  store i64 0, ptr %s2
  store i64 0, ptr %s3
  store i64 %used, ptr %s4
  store i64 %chunk, ptr %s5
  %task = alloca [5 x i64]
  %task.1 = getelementptr i64, ptr %task, i64 1
  %task.2 = getelementptr i64, ptr %task, i64 2
  %task.3 = getelementptr i64, ptr %task, i64 3
  %task.4 = getelementptr i64, ptr %task, i64 4
  store i64 @CallBytes.THREAD_POOL_SCHEDULE@, ptr %task
  store i64 0, ptr %task.1
  store ptr %context, ptr %task.2
  store ptr @help, ptr %task.3
  store ptr %state, ptr %task.4
  %schedule.f = call ptr @field(ptr %api, i64 @Api.THREAD_POOL_SCHEDULE@)
  br label %call
call:
  %t = phi i64 [ 1, %share ], [ %t.next, %called ], [ %t.next, %refused ]
  %t.more = icmp ult i64 %t, %used
  %t.next = add i64 %t, 1
  br i1 %t.more, label %ask, label %own
ask:
  %refusal = call ptr %schedule.f(ptr %task)
  %ok = icmp eq ptr %refusal, null
  br i1 %ok, label %called, label %refused
called:
  br label %call
refused:
  %u = atomicrmw sub ptr %s4, i64 1 monotonic
  br label %call
own:
  call void @take(ptr %state)
  br label %wait
wait:
  %finished = load atomic i64, ptr %s3 acquire, align 8
  %all = icmp uge i64 %finished, %blocks
  br i1 %all, label %end, label %yield
yield:
  %y = call i32 @sched_yield()
  br label %wait
end:
  call void @leave(ptr %state)
  ret ptr null
}

attributes #0 = { nounwind }
"""

# A thread's two frames: on its stack where there is room, else on the heap.
_MOST_STACK = 3 << 17
_ON_STACK = """  %frame = alloca [@FRAME_BYTES@ x i8], align 64
  %spill = alloca [@SPILL_BYTES@ x i8], align 64"""
_ON_HEAP = """  %bytes = add i64 @FRAME_BYTES@, @SPILL_BYTES@
  %padded = add i64 %bytes, 64
  %heap = call ptr @malloc(i64 %padded)
  %address = ptrtoint ptr %heap to i64
  %above = add i64 %address, 63
  %aligned = and i64 %above, -64
  %frame = inttoptr i64 %aligned to ptr
  %spill = getelementptr i8, ptr %frame, i64 @FRAME_BYTES@"""


def frames(frame_bytes: int, spill_bytes: int) -> dict[str, str]:
    """Write how a thread gets and releases its two frames, whose sizes are multiples of 64; the marks are HANDLER's."""
    if frame_bytes + spill_bytes <= _MOST_STACK:
        return {"FRAMES": _ON_STACK, "RELEASE": ""}
    return {"FRAMES": _ON_HEAP, "RELEASE": "  call void @free(ptr %heap)"}


# Before each block, for tests: no bit of its frame is what it was, nor of the second one where no lane waits there.
SPOIL = """  %waiting = load i64, ptr %queue
  %nobody = icmp eq i64 %waiting, 0
  %unused = select i1 %nobody, i64 @SPILL_BYTES@, i64 0
  call void @llvm.memset.p0.i64(ptr %frame, i8 -1, i64 @FRAME_BYTES@, i1 false)
  call void @llvm.memset.p0.i64(ptr %spill, i8 -1, i64 %unused, i1 false)"""
