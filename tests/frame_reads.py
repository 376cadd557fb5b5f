"""What LLVM code of a kernel reads from a thread's memory though nothing was written there before.

Two frames are followed through the functions that work on them. A block's own begins with nothing written in it and
goes through `before`, `rounds`, `after` and `unpack`. The frame of those that wait begins with what is moved to it, by
the tables of the module, and goes through `rounds`, `after` and `unpack_rows`. Only bytes all of whose bits are written
on every path count. An access whose place is found at run time means the whole of its array: a store is taken to fill
it (loops over arrays do), a load to need all that is ever stored there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

BITS = {"double": 64, "float": 32, "ptr": 64}
FUNCTION = re.compile(r"define internal \S+ @(\w+)\([^\n]*\)[^\n]*\{\n(.*?)\n\}", re.S)
VECTOR = re.compile(r"<(\d+) x (\w+)>")
KNOWN = re.compile(r"%near(\d+)\.known = getelementptr i8, ptr %frame, i64 (-?\d+)")
ADDRESS = re.compile(r"(%[\w.]+) = getelementptr (<[^>]*>|\w+), ptr (%[\w.]+), i64 (\S+)")
LOAD = re.compile(r"%[\w.]+ = load (?:atomic )?(<[^>]*>|\w+), ptr (%[\w.]+)")
STORE = re.compile(r"store (<[^>]*>|\w+) .*, ptr (%[\w.]+)")


@dataclass(frozen=True)
class Access:
    """A load or a store; `place` is None where it is found at run time, and `array` where its array begins."""

    line: str
    stores: bool
    unit: str
    array: int
    place: int | None


def bits_of(unit: str) -> int:
    vector = VECTOR.fullmatch(unit)
    count, scalar = (int(vector[1]), vector[2]) if vector else (1, unit)
    return count * (BITS.get(scalar) or int(scalar[1:]))


def accesses(body: str) -> tuple[dict[str, list[Access]], dict[str, list[str]]]:
    """By block: loads and stores of the frame, in order, and the blocks that follow."""
    near: dict[str, int] = {}
    addresses: dict[str, tuple[int, int | None]] = {}
    found: dict[str, list[Access]] = {"entry": []}
    following: dict[str, list[str]] = {"entry": []}
    block = "entry"
    for line in map(str.strip, body.splitlines()):
        if line.endswith(":"):
            block = line[:-1]
            found.setdefault(block, [])
            following.setdefault(block, [])
        elif match := KNOWN.match(line):
            near[f"%near{match[1]}"] = int(match[2])
        elif match := ADDRESS.match(line):
            name, unit, base, index = match.groups()
            if base in near:
                addresses[name] = (near[base] + int(index),) * 2
            elif base in addresses:
                array, place = addresses[base]
                known = index.lstrip("-").isdigit() and place is not None
                addresses[name] = array, place + int(index) * bits_of(unit) // 8 if known else None
        elif line.startswith("br "):
            following[block] = re.findall(r"label %([\w.]+)", line)
        else:
            load, store = LOAD.match(line), STORE.match(line)
            match = load or store
            if match and match[2] in addresses:
                found[block].append(Access(line, bool(store), match[1], *addresses[match[2]]))
            elif not match and any(name in addresses for name in re.findall(r"ptr (%[\w.]+)", line)):
                raise AssertionError(f"an instruction that is not known uses the frame: {line}")
    return found, following


class Frame:
    """Bytes of a frame as bits of an integer.

    Args:
        functions: all accesses of the module.
        size: of the frame.
    """

    def __init__(self, functions: dict[str, tuple[dict[str, list[Access]], dict[str, list[str]]]], size: int) -> None:
        every = [a for blocks, _ in functions.values() for block in blocks.values() for a in block]
        starts = sorted({a.array for a in every}) + [size]
        self.ends = dict(zip(starts, starts[1:], strict=False))
        self.stored = 0
        for a in every:
            self.stored |= self.bytes_of(a) if a.stores else 0

    def bytes_of(self, a: Access) -> int:
        if a.place is None:
            whole = span(a.array, self.ends[a.array] - a.array)
            return whole if a.stores else whole & self.stored or whole
        # A store that leaves bits of its last byte alone does not write it.
        bits = bits_of(a.unit)
        return span(a.place, bits // 8 if a.stores else -(-bits // 8))


def span(start: int, size: int) -> int:
    return ((1 << size) - 1) << start


def followed(function, frame: Frame, written: int) -> tuple[int, list[str]]:
    """What is written where a function returns, and the lines that read what is not."""
    blocks, following = function
    first = {block: -1 for block in blocks} | {"entry": written}
    after: dict[str, int] = {}
    waiting = ["entry"]
    while waiting:
        block = waiting.pop()
        state = first[block]
        for a in blocks[block]:
            state |= frame.bytes_of(a) if a.stores else 0
        if after.get(block) == state:
            continue
        after[block] = state
        for other in following[block]:
            first[other] &= state
            waiting.append(other)
    wrong, returned = [], -1
    for block in after:
        state = first[block]
        for a in blocks[block]:
            if a.stores:
                state |= frame.bytes_of(a)
            elif frame.bytes_of(a) & ~state:
                wrong.append(a.line)
        returned &= state if not following[block] else -1
    return returned, wrong


def tables(text: str, width: int) -> int:
    """The bytes that are moved with the lanes that wait."""
    moved = 0
    for name, size in (("words", 4), ("longs", 8), ("flags", 1)):
        count = int(re.search(rf"@{name}\.count = internal constant i64 (\d+)", text)[1])
        entries = re.search(rf"@{name} = internal constant \[\d+ x i32\] \[(.*?)\]", text)[1]
        for entry in entries.split(", ")[:count]:
            moved |= span(int(entry.split()[1]), width * size)
    return moved


def framed(text: str) -> dict[str, tuple[dict[str, list[Access]], dict[str, list[str]]]]:
    """By function: see `accesses`."""
    return {name: accesses(body) for name, body in FUNCTION.findall(text) if "%frame" in body}


def unwritten(text: str) -> list[str]:
    """The lines of a module, each with its function, that read what was not written."""
    functions = framed(text)
    # On the stack or, if it is large, on the heap.
    size = int(re.search(r"(?:%frame = alloca \[|%bytes = add i64 )(\d+)", text)[1])
    width = int(re.search(r"udiv i64 %almost, (\d+)", text)[1])
    frame, wrong = Frame(functions, size), []

    def through(names: tuple[str, ...], written: int, whose: str) -> None:
        for name in names:
            if name in functions:
                written, lines = followed(functions[name], frame, written)
                wrong.extend(f"{whose} {name}: {line}" for line in lines)
            if name == "rounds" and whose == "block's" and "@flags.count" in text and tables(text, width) & ~written:
                wrong.append("moved, but not written")

    through(("before", "rounds", "after", "unpack"), 0, "block's")
    if "@flags.count" in text:
        through(("rounds", "after", "unpack_rows"), tables(text, width), "waiting")
    return wrong
