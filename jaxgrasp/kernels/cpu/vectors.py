"""LLVM code of a program: one problem per lane of a vector register."""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxgrasp.kernels.code.values import ValueCode
from jaxgrasp.kernels.cpu.registers import Registers
from jaxgrasp.kernels.program.expressions import Address, Value
from jaxgrasp.kernels.program.lowering import Guard, Loop
from jaxgrasp.kernels.program.schedule import Schedule, in_memory


def main_loop(schedule: Schedule) -> Loop | None:
    """The last loop that goes on for as long as any problem's condition holds and is in no other, if there is one."""
    loops = [e.subject for e in schedule.events if e.what == "test" and e.subject.body.depth == 1]
    return loops[-1] if loops else None


class VectorCode(ValueCode):
    """Writes instructions.

    Args:
        dtype: of numbers.
        width: lanes of a vector.
        estimates: whether the processor has AVX-512's estimates of reciprocals.
    """

    def __init__(self, dtype: np.dtype, width: int, *, estimates: bool) -> None:
        """See the class."""
        super().__init__(dtype, width, estimates=estimates)
        self.sizes: list[int] = []
        self.shared: list[str] = []
        self.masks: dict[Loop, str] = {}
        self.counters: dict[Loop, tuple[str, str, int]] = {}
        self.carried: dict[Value, tuple[Loop, int]] = {}
        self.homes: set[Value] = set()
        self.narrowed: dict[tuple[str, Value], str] = {}
        self.main: Loop | None = None
        self.live: dict[int, str] = {}

    def operand(self, x: Any, kind: str) -> str:
        """The name or literal of a scalar."""
        if type(x) is not Value:
            return self.constant(x, kind)
        name = self.registers.fetch(x)
        if x.kind == "u" and kind != "u":
            short = self.emit(f"trunc i64 {name} to i32")
            one = self.emit(f"insertelement {self.types['i']} poison, i32 {short}, i64 0")
            return self.emit(
                f"shufflevector {self.types['i']} {one}, {self.types['i']} poison, <{self.width} x i32> zeroinitializer"
            )
        return name

    # Events

    def follow(self, schedule: Schedule, result: Callable[[int, str], None], registers: int) -> None:
        """Write a whole program.

        Args:
            schedule: its events.
            result: told the number and the name of every result.
            registers: vector registers for values.
        """
        self.fused, self.main = schedule.fused, main_loop(schedule)
        self.registers = Registers(self, schedule, registers)
        for number, event in enumerate(schedule.events):
            if event.what == "compute":
                self.compute(event.subject, number)
            elif event.what == "store":
                result(event.subject, self.registers.fetch(event.uses[0]) if event.uses else "")
            elif event.what == "test":
                self.masks[event.subject] = self.operand(event.subject.condition, "b")
                least = "%few" if event.subject is self.main else "0"
                self.branch_if_more(self.masks[event.subject], event.subject, least)
            elif isinstance(event.subject, Loop):
                (self.enter_loop if event.what == "enter" else self.leave_loop)(event.subject, number)
            else:
                (self.enter_guard if event.what == "enter" else self.leave_guard)(event.subject, number)
            self.registers.passed(number)

    def compute(self, value: Value, number: int) -> None:
        """A value; the next value of something carried takes its place where nobody needs the old one any more."""
        carried = self.carried.get(value)
        if carried is None:
            self.registers.put(value, self.instruction(value))
            return
        (loop, index), place = carried, None
        mask, old = self.masks.get(loop), loop.carries[index]
        if mask is not None and value.op == "select" and value.args[2] is old:
            # One choice for both: where the loop is over, nobody asks what else follows from the value.
            name, mask = self.choice(value, self.both(mask, value.args[0])), None
        else:
            name = self.instruction(value)
        if self.registers.schedule.last.get(old, -1) <= number:
            place = self.slots[loop][index]
            self.store_where(mask, name, place, value.kind)
            self.homes.add(value)
        self.registers.put(value, name, place)

    def both(self, mask: str, condition: Any) -> str:
        """Where the mask and a condition hold; written once."""
        name = self.operand(condition, "b")
        found = self.narrowed.get((mask, condition))
        if found is None:
            found = self.narrowed[mask, condition] = self.emit(f"and {self.types['b']} {mask}, {name}")
        return found

    def enter_loop(self, loop: Loop, number: int) -> None:
        """Carried values live in memory."""
        slots = self.slots[loop] = [self.allocate(kind) for kind in loop.kinds]
        for slot, value, kind in zip(slots, loop.initial, loop.kinds, strict=True):
            self.store(kind, self.operand(value, kind), slot)
        for index, value in enumerate(loop.outputs):
            if type(value) is Value and value.region is loop.body and not in_memory(value):
                self.carried.setdefault(value, (loop, index))
        self.registers.flush(number)
        if loop is self.main:
            self.live = self.alive(number)
            self.do("ret void")
            self.begin("i64 @rounds(ptr noalias %state, ptr noalias %frame, i64 %few)")
        before, head = self.block, self.label("head")
        self.labels[loop] = (head, self.label("body"), self.label("after"))
        self.do(f"br label %{head}")
        self.enter(head)
        if loop.rounds is not None:
            self.count += 1
            self.counters[loop] = (f"%c{self.count}", before, len(self.lines))
            self.do("")
            if loop.counter is not None:
                self.registers.put(loop.counter, self.counters[loop][0])

    def leave_loop(self, loop: Loop, number: int) -> None:
        """What has not found its place yet does, and round again."""
        moved = []
        for index, (value, kind) in enumerate(zip(loop.outputs, loop.kinds, strict=True)):
            slot = self.slots[loop][index]
            if not (value in self.homes and self.registers.places[value] == slot) and value is not loop.carries[index]:
                moved.append((self.operand(value, kind), slot, kind))
        for name, slot, kind in moved:
            self.store_where(self.masks.get(loop), name, slot, kind)
        self.registers.flush(number)
        head, _, after = self.labels[loop]
        if loop.rounds is None:
            self.do(f"br label %{head}")
        else:
            counter, before, place = self.counters[loop]
            following = self.emit(f"add i64 {counter}, 1")
            self.lines[place] = f"{counter} = phi i64 [ 0, %{before} ], [ {following}, %{self.block} ]"
            done = self.emit(f"icmp eq i64 {following}, {loop.rounds}")
            self.do(f"br i1 {done}, label %{after}, label %{head}")
        self.enter(after)
        if loop is self.main:
            self.do(f"ret i64 {self.unfinished}")
            self.begin("void @after(ptr noalias %state, ptr noalias %frame)")

    def enter_guard(self, guard: Guard, number: int) -> None:
        """Code that is jumped over where no lane needs it; its results are zero then."""
        slots = self.slots[guard] = [self.allocate(v.kind) for v in guard.results]
        for slot, value in zip(slots, guard.results, strict=True):
            self.store(value.kind, "zeroinitializer", slot)
        mask = self.operand(guard.condition, "b")
        self.registers.flush(number)
        self.labels[guard] = ("", self.label("guarded"), self.label("after"))
        self.branch_if_more(mask, guard, "0")

    def leave_guard(self, guard: Guard, number: int) -> None:
        """Its results go to their places."""
        for slot, value in zip(self.slots[guard], guard.outputs, strict=True):
            self.store(value.kind, self.operand(value, value.kind), slot)
        self.registers.flush(number)
        self.do(f"br label %{self.labels[guard][2]}")
        self.enter(self.labels[guard][2])

    def branch_if_more(self, mask: str, step: Loop | Guard, least: str) -> None:
        """Into the step where the mask holds for more than so many lanes, else past it."""
        bits = self.emit(f"bitcast {self.types['b']} {mask} to i{self.width}")
        self.unfinished = self.emit(f"zext i{self.width} {bits} to i64")
        number = self.unfinished
        if least != "0":
            self.declare("declare i64 @llvm.ctpop.i64(i64)")
            number = self.emit(f"call i64 @llvm.ctpop.i64(i64 {number})")
        some = self.emit(f"icmp ugt i64 {number}, {least}")
        _, inside, after = self.labels[step]
        self.do(f"br i1 {some}, label %{inside}, label %{after}")
        self.enter(inside)

    def alive(self, number: int) -> dict[int, str]:
        """What a lane has in the frame where the main loop begins, event `number`: kinds by offset."""
        found: dict[int, str] = {}

        def add(place: str, kind: str, entry: int = 0) -> None:
            found[self.offsets[place] + entry * self.stride(kind)] = kind

        assert self.main is not None
        for slot, kind in zip(self.slots[self.main], self.main.kinds, strict=True):
            add(slot, kind)
        for event in self.registers.schedule.events[number + 1 :]:
            for value in event.uses:
                if value.op == "own":
                    at = value.address
                    entries = [at.offset] if at.counter is None else range(self.sizes[at.buffer])
                    for entry in entries:
                        add(self.own[at.buffer], value.kind, entry)
                elif value.op == "result":
                    step, index = value.args
                    if step in self.slots:
                        add(self.slots[step][index], value.kind)
                elif value in self.registers.stored and not in_memory(value):
                    add(self.registers.places[value], value.kind)
        return found

    def store(self, kind: str, name: str, place: str) -> None:
        """Put a vector in memory."""
        if kind == "b":
            name = self.emit(f"sext {self.types['b']} {name} to {self.kept['b']}")
        self.do(f"store {self.kept[kind]} {name}, ptr {self.pointer(place)}, align {self.stride(kind)}")

    def load(self, kind: str, place: str) -> str:
        """Read a vector."""
        name = self.emit(f"load {self.kept[kind]}, ptr {self.pointer(place)}, align {self.stride(kind)}")
        return self.emit(f"icmp slt {self.kept['b']} {name}, zeroinitializer") if kind == "b" else name

    def store_where(self, mask: str | None, new: str, slot: str, kind: str) -> None:
        """Put a vector in memory, where the mask holds."""
        vector = self.types[kind]
        # A store by a mask would keep what is read soon after from being taken from it.
        if mask is not None:
            old = self.load(kind, slot)
            new = self.emit(f"select {self.types['b']} {mask}, {vector} {new}, {vector} {old}")
        self.store(kind, new, slot)

    def read(self, value: Value) -> str:
        """A value that lies in memory."""
        if value.op == "own":
            return self.load_own(value.kind, value.address)
        if value.op == "shared":
            return self.load_shared(value.kind, value.address)
        step, index = value.args
        return self.load(value.kind, self.slots[step][index])

    # Memory

    def place(self, address: Address, unit: str, base: str) -> str:
        """Write a pointer to an entry of the argument that begins at `base`."""
        return self.emit(f"getelementptr {unit}, ptr {self.pointer(base)}, i64 {self.offset(address)}")

    def load_own(self, kind: str, address: Address) -> str:
        """Load a scalar of an argument that every lane has for itself."""
        return self.load(kind, self.place(address, self.kept[kind], self.own[address.buffer]))

    def load_shared(self, kind: str, address: Address) -> str:
        """Load a scalar of an argument that all lanes share, and copy it to all lanes."""
        unit = {"f": self.scalar, "i": "i32", "b": "i8"}[kind]
        one = self.emit(f"load {unit}, ptr {self.place(address, unit, self.shared[address.buffer])}")
        if kind == "b":
            one, unit = self.emit(f"icmp ne i8 {one}, 0"), "i1"
        vector = self.types[kind]
        lone = self.emit(f"insertelement {vector} poison, {unit} {one}, i64 0")
        return self.emit(f"shufflevector {vector} {lone}, {vector} poison, <{self.width} x i32> zeroinitializer")
