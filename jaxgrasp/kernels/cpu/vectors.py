"""Write LLVM code of a program: one lane of the batch per lane of a vector register."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxgrasp.kernels.code.values import ValueCode
from jaxgrasp.kernels.cpu.handler import POINTERS
from jaxgrasp.kernels.cpu.registers import Registers
from jaxgrasp.kernels.program.expressions import Address, Table, Value
from jaxgrasp.kernels.program.lowering import Guard, Loop, ScalarProgram
from jaxgrasp.kernels.program.schedule import Schedule, in_memory, is_computed_in


class Body(NamedTuple):
    """A description of a program's code for the functions around it.

    width: lanes of a vector.
    float_bytes: size of a number.
    frame_bytes: size of the frame that the program works in.
    has_main_loop: whether the program has a loop that some lanes take longer for, and with it the functions `rounds`
        and `after`; else `before` is all.
    lane_state: what a lane has in the frame where the main loop begins: types by offsets. It is moved with the lane.
    """

    width: int
    float_bytes: int
    frame_bytes: int
    has_main_loop: bool
    lane_state: dict[int, str]


def find_main_loop(schedule: Schedule) -> Loop | None:
    """Return the last loop of unknown length that is in no other loop; None if there is none."""
    loops = [e.subject for e in schedule.events if e.what == "test" and e.subject.body.depth == 1]
    return loops[-1] if loops else None


class VectorCode(ValueCode):
    """Writes a program's functions, in five phases.

    1. `begin` starts the function `before`. Like every function, it first loads the pointers to the arguments that all
       lanes share.
    2. The arrays of the arguments and results are allocated in the frame.
    3. `write` writes the program. Where it has a main loop, `write` ends `before`, and begins and ends `rounds`, and
       begins `after`; the caller ends the last one.
    4. More functions may follow, which work on the same frame, but allocate nothing in it.
    5. `text` returns the code.

    Args:
        program: what to compute.
        width: lanes of a vector.
        estimates: whether the processor has AVX-512's estimates of reciprocals.

    sizes: entries of a row of every argument.
    shared: names of pointers to the arguments that all lanes share, in the function that is being written.
    masks: for every loop of unknown length, the lanes whose condition holds in this round.
    counters: for every loop of known length, the name of its counter, the block before it, and the line of the phi.
    carried: for every next value of a carried scalar, the loop and the number of the scalar.
    in_slots: next values of carried scalars that were stored in the slots of these.
    tables: places of tables in the frame.
    stacked: for every value that a round writes to tables, the loop and the tables, with its places there.
    conjunctions: names of the masks that `conjoin` wrote.
    main_loop: the program's main loop, if it has one.
    lane_state: see `Body`.
    """

    def __init__(self, program: ScalarProgram, width: int, *, estimates: bool) -> None:
        """Begin a module without functions."""
        super().__init__(program.builder.dtype, width, estimates=estimates)
        self.program = program
        self.sizes = [math.prod(shape) for shape, _ in program.inputs]
        self.shared: list[str] = []
        self.masks: dict[Loop, str] = {}
        self.counters: dict[Loop, tuple[str, str, int]] = {}
        self.carried: dict[Value, tuple[Loop, int]] = {}
        self.in_slots: set[Value] = set()
        self.tables: dict[Table, str] = {}
        self.stacked: dict[Value, tuple[Loop, list[Address]]] = {}
        self.conjunctions: dict[tuple[str, Value], str] = {}
        self.main_loop: Loop | None = None
        self.lane_state: dict[int, str] = {}

    def begin(self, signature: str) -> None:
        """Begin a function, which must have pointers `%frame` and `%state`, see `handler`."""
        super().begin(signature)
        self.shared = [self.argument(number) if shared else "" for number, shared in enumerate(self.program.shared)]

    def argument(self, number: int) -> str:
        """Load the pointer to an argument's or a result's data; the results follow the arguments."""
        place = self.emit(f"getelementptr i64, ptr %state, i64 {POINTERS + number}")
        return self.emit(f"load ptr, ptr {place}")

    def operand(self, x: Any, kind: str) -> str:
        """Return the name or literal of a scalar as an operand of this type."""
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

    def write(self, schedule: Schedule, own: list[str], store: Callable[[int, str], None], registers: int) -> Body:
        """Write the program into the function `before` that was begun; see the class.

        Args:
            schedule: the program's events.
            own: the arrays of the arguments in the frame, "" where all lanes share one.
            store: writes the code that stores a result; it is called with the result's number and name.
            registers: vector registers for values.
        """
        self.own = own
        self.fused, self.main_loop = schedule.fused, find_main_loop(schedule)
        self.registers = Registers(self, schedule, registers)
        for number, event in enumerate(schedule.events):
            if event.what == "compute":
                self.compute(event.subject, number)
            elif event.what == "store":
                store(event.subject, self.registers.fetch(event.uses[0]) if event.uses else "")
            elif event.what == "test":
                self.masks[event.subject] = self.operand(event.subject.condition, "b")
                least = "%threshold" if event.subject is self.main_loop else "0"
                self.branch_if_more(self.masks[event.subject], event.subject, least)
            elif isinstance(event.subject, Loop):
                (self.enter_loop if event.what == "enter" else self.leave_loop)(event.subject, number)
            else:
                (self.enter_guard if event.what == "enter" else self.leave_guard)(event.subject, number)
            self.registers.advance(number)
        return Body(
            width=self.width,
            float_bytes=self.dtype.itemsize,
            frame_bytes=self.frame_bytes,
            has_main_loop=self.main_loop is not None,
            lane_state=self.lane_state,
        )

    def compute(self, value: Value, number: int) -> None:
        """Compute a value; store the next value of a carried scalar in its slot if the old one is no longer needed."""
        carried = self.carried.get(value)
        if carried is None:
            self.registers.put(value, self.instruction(value))
            self.stack(value)
            return
        (loop, index), place = carried, None
        mask, old = self.masks.get(loop), loop.carries[index]
        if mask is not None and value.op == "select" and value.args[2] is old:
            # One select for both: where a lane has left the loop, nobody reads what else follows from the value.
            name, mask = self.choice(value, self.conjoin(mask, value.args[0])), None
        else:
            name = self.instruction(value)
        if self.registers.schedule.last.get(old, -1) <= number:
            place = self.slots[loop][index]
            self.store_where(mask, name, place, value.kind)
            self.in_slots.add(value)
        self.registers.put(value, name, place)
        self.stack(value)

    def stack(self, value: Value) -> None:
        """Store a value in the tables that a round writes it to, if there are any."""
        loop, places = self.stacked.get(value, (None, ()))
        if loop is None:
            return
        for address in places:
            kind = address.table.kind
            self.store(kind, self.operand(value, kind), self.place_in_table(address))

    def add_table(self, table: Table) -> None:
        """Allocate a table; what is left of its last line of the cache is zero."""
        self.tables[table] = self.allocate(table.kind, table.size)
        for place in range(table.size, self.room(table)):
            self.store(table.kind, "zeroinitializer", self.place_in_table(Address(table, place)))

    def room(self, table: Table) -> int:
        """Count the entries of a table, to the end of its last line of the cache."""
        return -(-table.size * self.stride(table.kind) // 64) * 64 // self.stride(table.kind)

    def place_in_table(self, address: Address) -> str:
        """Write a pointer to an entry of a table."""
        return self.place(address, self.memory_types[address.table.kind], self.tables[address.table])

    def conjoin(self, mask: str, condition: Any) -> str:
        """Return the mask of lanes where a mask and a condition hold; it is written once."""
        name = self.operand(condition, "b")
        found = self.conjunctions.get((mask, condition))
        if found is None:
            found = self.conjunctions[mask, condition] = self.emit(f"and {self.types['b']} {mask}, {name}")
        return found

    def enter_loop(self, loop: Loop, number: int) -> None:
        """Begin a loop; carried scalars lie in memory."""
        slots = self.slots[loop] = [self.allocate(kind) for kind in loop.kinds]
        for slot, value, kind in zip(slots, loop.initial, loop.kinds, strict=True):
            self.store(kind, self.operand(value, kind), slot)
        for index, value in enumerate(loop.outputs):
            if type(value) is Value and is_computed_in(value, loop.body):
                self.carried.setdefault(value, (loop, index))
        for table, entries in loop.filled:
            self.add_table(table)
            for place, value in enumerate(entries):
                self.store(table.kind, self.operand(value, table.kind), self.place_in_table(Address(table, place)))
        for table, values in loop.stacked:
            self.add_table(table)
            for place, value in enumerate(values):
                address = Address(table, place, loop.counter, len(values))
                self.stacked.setdefault(value, (loop, []))[1].append(address)
        self.registers.flush(number)
        if loop is self.main_loop:
            self.lane_state = self.collect_lane_state(number)
            self.do("ret void")
            self.begin("i64 @rounds(ptr noalias %state, ptr noalias %frame, i64 %threshold)")
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
        """End a round: store carried scalars that are not in their slots yet, and go round again."""
        moved = []
        for index, (value, kind) in enumerate(zip(loop.outputs, loop.kinds, strict=True)):
            slot = self.slots[loop][index]
            is_there = value in self.in_slots and self.registers.places[value] == slot
            if not is_there and value is not loop.carries[index]:
                moved.append((self.operand(value, kind), slot, kind))
        for name, slot, kind in moved:
            self.store_where(self.masks.get(loop), name, slot, kind)
        for value in dict.fromkeys(x for _, values in loop.stacked for x in values):
            if not is_computed_in(value, loop.body):
                self.stack(value)
            del self.stacked[value]
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
        if loop is self.main_loop:
            self.do(f"ret i64 {self.unfinished}")
            self.begin("void @after(ptr noalias %state, ptr noalias %frame)")

    def enter_guard(self, guard: Guard, number: int) -> None:
        """Begin code that is jumped over where no lane needs it; its results are zero then."""
        slots = self.slots[guard] = [self.allocate(v.kind) for v in guard.results]
        for slot, value in zip(slots, guard.results, strict=True):
            self.store(value.kind, "zeroinitializer", slot)
        mask = self.operand(guard.condition, "b")
        self.registers.flush(number)
        self.labels[guard] = ("", self.label("guarded"), self.label("after"))
        self.branch_if_more(mask, guard, "0")

    def leave_guard(self, guard: Guard, number: int) -> None:
        """End a guard: store its results in their slots."""
        for slot, value in zip(self.slots[guard], guard.outputs, strict=True):
            self.store(value.kind, self.operand(value, value.kind), slot)
        self.registers.flush(number)
        self.do(f"br label %{self.labels[guard][2]}")
        self.enter(self.labels[guard][2])

    def branch_if_more(self, mask: str, step: Loop | Guard, least: str) -> None:
        """Branch into a step where the mask holds for more than `least` lanes, else past it."""
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

    def collect_lane_state(self, number: int) -> dict[int, str]:
        """Collect what is live of a lane where the main loop begins, at event `number`: see `Body.lane_state`."""
        found: dict[int, str] = {}

        def add(place: str, kind: str, entry: int = 0) -> None:
            found[self.offsets[place] + entry * self.stride(kind)] = kind

        assert self.main_loop is not None
        for slot, kind in zip(self.slots[self.main_loop], self.main_loop.kinds, strict=True):
            add(slot, kind)
        for event in self.registers.schedule.events[number + 1 :]:
            for value in event.uses:
                if value.op == "own":
                    at = value.address
                    entries = [at.offset] if at.counter is None else range(self.sizes[at.argument])
                    for entry in entries:
                        add(self.own[at.argument], value.kind, entry)
                elif value.op == "entry":
                    table = value.address.table
                    if table in self.tables:
                        for entry in range(self.room(table)):
                            add(self.tables[table], table.kind, entry)
                elif value.op == "result":
                    step, index = value.args
                    if step in self.slots:
                        add(self.slots[step][index], value.kind)
                elif value in self.registers.stored and not in_memory(value):
                    add(self.registers.places[value], value.kind)
        return found

    def store(self, kind: str, name: str, place: str) -> None:
        """Store a vector."""
        if kind == "b":
            name = self.emit(f"sext {self.types['b']} {name} to {self.memory_types['b']}")
        self.do(f"store {self.memory_types[kind]} {name}, ptr {self.pointer(place)}, align {self.stride(kind)}")

    def load(self, kind: str, place: str) -> str:
        """Load a vector."""
        name = self.emit(f"load {self.memory_types[kind]}, ptr {self.pointer(place)}, align {self.stride(kind)}")
        return self.emit(f"icmp slt {self.memory_types['b']} {name}, zeroinitializer") if kind == "b" else name

    def store_where(self, mask: str | None, new: str, slot: str, kind: str) -> None:
        """Store a vector in the lanes where the mask holds; None for all lanes."""
        vector = self.types[kind]
        # After a masked store the processor could not forward what was stored to the loads that follow.
        if mask is not None:
            old = self.load(kind, slot)
            new = self.emit(f"select {self.types['b']} {mask}, {vector} {new}, {vector} {old}")
        self.store(kind, new, slot)

    def read(self, value: Value) -> str:
        """Load a value that is not computed."""
        if value.op == "own":
            return self.load_own(value.kind, value.address)
        if value.op == "shared":
            return self.load_shared(value.kind, value.address)
        if value.op == "entry":
            return self.load(value.kind, self.place_in_table(value.address))
        step, index = value.args
        return self.load(value.kind, self.slots[step][index])

    # Memory

    def place(self, address: Address, unit: str, base: str) -> str:
        """Write a pointer to an entry of the argument that begins at `base`."""
        return self.emit(f"getelementptr {unit}, ptr {self.pointer(base)}, i64 {self.offset(address)}")

    def load_own(self, kind: str, address: Address) -> str:
        """Load a scalar of an argument that every lane has for itself."""
        return self.load(kind, self.place(address, self.memory_types[kind], self.own[address.argument]))

    def load_shared(self, kind: str, address: Address) -> str:
        """Load a scalar of an argument that all lanes share, and copy it to all lanes."""
        unit = {"f": self.scalar, "i": "i32", "b": "i8"}[kind]
        one = self.emit(f"load {unit}, ptr {self.place(address, unit, self.shared[address.argument])}")
        if kind == "b":
            one, unit = self.emit(f"icmp ne i8 {one}, 0"), "i1"
        vector = self.types[kind]
        lone = self.emit(f"insertelement {vector} poison, {unit} {one}, i64 0")
        return self.emit(f"shufflevector {vector} {lone}, {vector} poison, <{self.width} x i32> zeroinitializer")
