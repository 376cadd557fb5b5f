"""Lane compaction: LLVM code that runs the main loop of a program only on vectors most of whose lanes need it.

Some lanes take more rounds than the others of their block. A vector of which few lanes (a quarter) are unfinished is
not worth a round: these lanes are moved to a second frame, the thread's spill frame (`%spill`), where they wait for
lanes of later blocks until it is nearly full. Nothing else of a lane changes, so its result does not depend on the
other lanes of its block.

Beside its two frames a thread has a work queue (`%queue`), an array of words: how many lanes wait, their rows, and the
sources and targets of the lanes that are being moved.
"""

from jaxgrasp.kernels.cpu.vectors import Body

_ALONE = """
define internal void @block(ptr %state, i64 %number, ptr %frame, ptr %spill, ptr %queue) {
  call void @before(ptr %state, i64 %number, ptr %frame)
@ROUNDS@
  call void @unpack(ptr %state, i64 %number, ptr %frame)
  ret void
}

define internal void @finish(ptr %state, ptr %spill, ptr %queue) {
  ret void
}
"""

_ROUNDS = """  %finished = call i64 @rounds(ptr %state, ptr %frame, i64 0)
  call void @after(ptr %state, ptr %frame)"""

# Lanes are moved value by value, since a value of all lanes is a line of the cache: each is touched once.
_MOVE = """
define internal void @move.@TABLE@(ptr %a, ptr %b, ptr %sources, ptr %targets, i64 %lanes) {
entry:
  %count = load i64, ptr @@TABLE@.count
  br label %more
more:
  %n = phi i64 [ 0, %entry ], [ %n.next, %moved ]
  %some = icmp ult i64 %n, %count
  br i1 %some, label %one, label %out
one:
  %place = getelementptr i32, ptr @@TABLE@, i64 %n
  %short = load i32, ptr %place
  %offset = zext i32 %short to i64
  %from = getelementptr i8, ptr %a, i64 %offset
  %to = getelementptr i8, ptr %b, i64 %offset
  br label %each
each:
  %k = phi i64 [ 0, %one ], [ %k.next, %each ]
  %source.p = getelementptr i64, ptr %sources, i64 %k
  %target.p = getelementptr i64, ptr %targets, i64 %k
  %source = load i64, ptr %source.p
  %target = load i64, ptr %target.p
  %from.p = getelementptr @UNIT@, ptr %from, i64 %source
  %to.p = getelementptr @UNIT@, ptr %to, i64 %target
  %value = load @UNIT@, ptr %from.p
  store @UNIT@ %value, ptr %to.p
  %k.next = add i64 %k, 1
  %again = icmp ult i64 %k.next, %lanes
  br i1 %again, label %each, label %moved
moved:
  %n.next = add i64 %n, 1
  br label %more
out:
  ret void
}
"""

_TOGETHER = """
@TABLES@
@MOVES@
define internal void @move(ptr %a, ptr %b, ptr %queue, i64 %lanes) {
entry:
  %sources = getelementptr i64, ptr %queue, i64 @SOURCES@
  %targets = getelementptr i64, ptr %queue, i64 @TARGETS@
  %none = icmp eq i64 %lanes, 0
  br i1 %none, label %out, label %some
some:
  call void @move.words(ptr %a, ptr %b, ptr %sources, ptr %targets, i64 %lanes)
  call void @move.longs(ptr %a, ptr %b, ptr %sources, ptr %targets, i64 %lanes)
  call void @move.flags(ptr %a, ptr %b, ptr %sources, ptr %targets, i64 %lanes)
  br label %out
out:
  ret void
}

declare i64 @llvm.cttz.i64(i64, i1)

define internal void @block(ptr %state, i64 %number, ptr %frame, ptr %spill, ptr %queue) {
entry:
  call void @before(ptr %state, i64 %number, ptr %frame)
  %unfinished = call i64 @rounds(ptr %state, ptr %frame, i64 @THRESHOLD@)
  %rows = load i64, ptr %state
  %first = mul i64 %number, @WIDTH@
  %waiting = load i64, ptr %queue
  %queue.rows = getelementptr i64, ptr %queue, i64 1
  %queue.sources = getelementptr i64, ptr %queue, i64 @SOURCES@
  %queue.targets = getelementptr i64, ptr %queue, i64 @TARGETS@
  br label %more
more:
  %lanes = phi i64 [ %unfinished, %entry ], [ %others, %counted ]
  %moved = phi i64 [ 0, %entry ], [ %moved.next, %counted ]
  %some = icmp ne i64 %lanes, 0
  br i1 %some, label %one, label %listed
one:
  %lane = call i64 @llvm.cttz.i64(i64 %lanes, i1 true)
  %less = sub i64 %lanes, 1
  %others = and i64 %lanes, %less
  %row = add i64 %first, %lane
  %target = add i64 %waiting, %moved
  %row.p = getelementptr i64, ptr %queue.rows, i64 %target
  %source.p = getelementptr i64, ptr %queue.sources, i64 %moved
  %target.p = getelementptr i64, ptr %queue.targets, i64 %moved
  store i64 %row, ptr %row.p
  store i64 %lane, ptr %source.p
  store i64 %target, ptr %target.p
  %real = icmp ult i64 %row, %rows
  %one.more = zext i1 %real to i64
  %moved.next = add i64 %moved, %one.more
  br label %counted
counted:
  br label %more
listed:
  call void @move(ptr %frame, ptr %spill, ptr %queue, i64 %moved)
  %kept = add i64 %waiting, %moved
  store i64 %kept, ptr %queue
  call void @after(ptr %state, ptr %frame)
  call void @unpack(ptr %state, i64 %number, ptr %frame)
  %full = icmp ugt i64 %kept, @ALMOST@
  br i1 %full, label %complete, label %out
complete:
  call void @finish(ptr %state, ptr %spill, ptr %queue)
  br label %out
out:
  ret void
}

define internal void @finish(ptr %state, ptr %spill, ptr %queue) {
entry:
  %queue.rows = getelementptr i64, ptr %queue, i64 1
  %queue.sources = getelementptr i64, ptr %queue, i64 @SOURCES@
  %queue.targets = getelementptr i64, ptr %queue, i64 @TARGETS@
  %count = load i64, ptr %queue
  %none = icmp eq i64 %count, 0
  br i1 %none, label %out, label %fill
fill:
  %lane = phi i64 [ %count, %entry ], [ %lane.next, %copy ]
  %empty = phi i64 [ 0, %entry ], [ %empty.next, %copy ]
  %more = icmp ult i64 %lane, @WIDTH@
  br i1 %more, label %copy, label %run
copy:
  %source.p = getelementptr i64, ptr %queue.sources, i64 %empty
  %target.p = getelementptr i64, ptr %queue.targets, i64 %empty
  store i64 0, ptr %source.p
  store i64 %lane, ptr %target.p
  %lane.next = add i64 %lane, 1
  %empty.next = add i64 %empty, 1
  br label %fill
run:
  call void @move(ptr %spill, ptr %spill, ptr %queue, i64 %empty)
  %unfinished = call i64 @rounds(ptr %state, ptr %spill, i64 0)
  call void @after(ptr %state, ptr %spill)
  call void @unpack_rows(ptr %state, ptr %queue.rows, i64 %count, ptr %spill)
  store i64 0, ptr %queue
  br label %out
out:
  ret void
}
"""


def compacts(body: Body) -> bool:
    """Tell whether lanes wait in a second frame: they do where there is a main loop."""
    return body.has_main_loop


def write_block(body: Body) -> str:
    """Write the function `block`, which runs the program on a block of lanes, and `finish`, for the lanes that wait."""
    if not compacts(body):
        return _ALONE.replace("@ROUNDS@", _ROUNDS if body.has_main_loop else "")
    width, threshold = body.width, body.width // 4
    values = {
        "@MOVES@": _write_moves(),
        "@TABLES@": _write_tables(body),
        "@THRESHOLD@": str(threshold),
        "@ALMOST@": str(width - threshold),
        "@SOURCES@": str(1 + width),
        "@TARGETS@": str(1 + 2 * width),
        "@WIDTH@": str(width),
    }
    text = _TOGETHER
    for mark, value in values.items():
        text = text.replace(mark, value)
    return text


def _write_moves() -> str:
    """Write the functions that copy a lane's state to another lane: words, longs and flags, of 4, 8 and 1 bytes."""
    units = {"words": "i32", "longs": "i64", "flags": "i8"}
    return "".join(_MOVE.replace("@UNIT@", unit).replace("@TABLE@", name) for name, unit in units.items())


def _write_tables(body: Body) -> str:
    """Write the offsets of a lane's state in a frame: of words, longs and flags."""
    sizes = {"f": body.float_bytes, "i": 4, "b": 1}
    lines = []
    for name, size in (("words", 4), ("longs", 8), ("flags", 1)):
        offsets = sorted(offset for offset, kind in body.lane_state.items() if sizes[kind] == size)
        entries = ", ".join(f"i32 {offset}" for offset in offsets or [0])
        lines.append(f"@{name} = internal constant [{max(1, len(offsets))} x i32] [{entries}]")
        lines.append(f"@{name}.count = internal constant i64 {len(offsets)}")
    return "\n".join(lines)
