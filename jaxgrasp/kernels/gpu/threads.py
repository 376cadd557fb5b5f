"""Write LLVM code of a program: one lane of the batch per thread of a GPU.

Every value has a name and none is stored: the GPU's assembler knows how many registers a thread has. Loops and branches
follow the conditions of the thread's own lane.
"""

from collections.abc import Callable
from typing import Any

from jaxgrasp.kernels.code.values import ValueCode
from jaxgrasp.kernels.program.expressions import Address, Unsupported, Value
from jaxgrasp.kernels.program.lowering import Guard, Loop, ScalarProgram
from jaxgrasp.kernels.program.schedule import Schedule, in_memory

# The functions that GPUs have instructions for; others would be calls into a library.
_NATIVE = {"fma", "sqrt", "fabs", "floor"}


class Names:
    """Names of values, in place of `cpu.registers`: a name holds until the loop or guard ends in which it was given.

    Args:
        code: to write loads with.

    names: of the values that have one.
    outside: the names that hold outside each of the steps that were entered.
    """

    def __init__(self, code: "ThreadCode") -> None:
        """Begin without names."""
        self.code = code
        self.names: dict[Value, str] = {}
        self.outside: list[dict[Value, str]] = []

    def fetch(self, value: Value) -> str:
        """Return the name of a value; arguments are loaded where they are first needed."""
        if value not in self.names:
            assert in_memory(value), value.op
            self.names[value] = self.code.read(value)
        return self.names[value]

    def put(self, value: Value, name: str) -> None:
        """Name a value that was computed."""
        self.names[value] = name

    def enter(self) -> None:
        """Begin a step."""
        self.outside.append(dict(self.names))

    def leave(self) -> None:
        """End a step, and forget the names that were given in it."""
        self.names = self.outside.pop()


class ThreadCode(ValueCode):
    """Writes a program's instructions on scalars, into the block `work` of a kernel.

    The pointers to the thread's rows are written first, with `emit`; then `write` writes the program; then `lines` has
    all instructions. There are no functions and no frame.

    Args:
        program: what to compute.

    before: for every loop and guard, the block before it.
    heads: for every loop, the line of its first phi.
    """

    def __init__(self, program: ScalarProgram) -> None:
        """Begin in the block `work`."""
        super().__init__(program.builder.dtype, 1, estimates=False)
        self.types = {"f": self.scalar, "i": "i32", "b": "i1", "u": "i64"}
        self.block = "work"
        self.registers = Names(self)
        self.before: dict[Loop | Guard, str] = {}
        self.heads: dict[Loop, int] = {}

    def write(self, schedule: Schedule, own: list[str], store: Callable[[int, str], None]) -> None:
        """Write the program.

        Args:
            schedule: the program's events.
            own: for every argument, the pointer to the thread's row, or to the row that all lanes share.
            store: writes the code that stores a result; it is called with the result's number and name.

        Raises:
            Unsupported: the program needs functions that GPUs have no instructions for.
        """
        self.own, self.fused = own, schedule.fused
        for event in schedule.events:
            step = event.subject
            if event.what == "compute":
                self.registers.put(step, self.instruction(step))
            elif event.what == "store":
                store(step, self.registers.fetch(event.uses[0]) if event.uses else "")
            elif event.what == "test":
                self.branch(self.operand(step.condition, "b"), step)
            elif isinstance(step, Loop):
                (self.begin_loop if event.what == "enter" else self.end_loop)(step)
            else:
                (self.begin_guard if event.what == "enter" else self.end_guard)(step)

    # Steps

    def begin_loop(self, loop: Loop) -> None:
        """Begin a loop; carried scalars are phis, which `end_loop` completes."""
        if loop.filled or loop.stacked:
            raise Unsupported("tables on a GPU")
        initial = [self.operand(x, kind) for x, kind in zip(loop.initial, loop.kinds, strict=True)]
        head = self.label("head")
        self.labels[loop] = (head, self.label("body"), self.label("after"))
        self.before[loop] = self.block
        self.do(f"br label %{head}")
        self.registers.enter()
        self.enter(head)
        self.heads[loop] = len(self.lines)
        names = []
        for start, kind in zip(initial, loop.kinds, strict=True):
            names.append(self.emit(f"phi {self.types[kind]} [ {start}, %{self.before[loop]} ]"))
        self.slots[loop] = names
        if loop.counter is not None:
            self.registers.put(loop.counter, self.emit(f"phi i64 [ 0, %{self.before[loop]} ]"))

    def end_loop(self, loop: Loop) -> None:
        """End a round: complete the phis, and go round again or past the loop."""
        head, _, after = self.labels[loop]
        following = [self.operand(x, kind) for x, kind in zip(loop.outputs, loop.kinds, strict=True)]
        if loop.rounds is None:
            carried, left = following, self.slots[loop]
            self.do(f"br label %{head}")
        else:
            counter = loop.counter
            assert counter is not None
            number = self.emit(f"add i64 {self.registers.fetch(counter)}, 1")
            again = self.emit(f"icmp ult i64 {number}, {loop.rounds}")
            carried, left = [*following, number], following
            self.do(f"br i1 {again}, label %{head}, label %{after}")
        for line, name in enumerate(carried, self.heads[loop]):
            self.lines[line] += f", [ {name}, %{self.block} ]"
        self.registers.leave()
        self.slots[loop] = left
        self.enter(after)

    def begin_guard(self, guard: Guard) -> None:
        """Begin code that is jumped over where this lane does not need it."""
        asked = self.operand(guard.condition, "b")
        self.labels[guard] = ("", self.label("guarded"), self.label("after"))
        self.before[guard] = self.block
        self.registers.enter()
        self.branch(asked, guard)

    def end_guard(self, guard: Guard) -> None:
        """End a guard; its results are zero where it was jumped over."""
        after, inside = self.labels[guard][2], []
        for value in guard.outputs:
            inside.append((self.types[value.kind], self.operand(value, value.kind)))
        end = self.block
        self.do(f"br label %{after}")
        self.registers.leave()
        self.enter(after)
        nothing = f"[ zeroinitializer, %{self.before[guard]} ]"
        self.slots[guard] = [self.emit(f"phi {kind} [ {name}, %{end} ], {nothing}") for kind, name in inside]

    def branch(self, asked: str, step: Loop | Guard) -> None:
        """Branch into a step or past it."""
        _, inside, after = self.labels[step]
        self.do(f"br i1 {asked}, label %{inside}, label %{after}")
        self.enter(inside)

    # Scalars

    def operand(self, x: Any, kind: str) -> str:
        """Return the name or literal of a scalar as an operand of this type."""
        if type(x) is not Value:
            return self.constant(x, kind)
        name = self.registers.fetch(x)
        return self.emit(f"trunc i64 {name} to i32") if x.kind == "u" and kind != "u" else name

    def constant(self, value: Any, kind: str) -> str:
        """Return the literal of a constant of this type."""
        if kind == "f":
            return self.float_literal(value)
        return ("true" if value else "false") if kind == "b" else str(int(value))

    def intrinsic(self, name: str, *operands: str) -> str:
        """Write a call of one of LLVM's own functions, which becomes an instruction."""
        if name not in _NATIVE:
            raise Unsupported(f"the function {name} on a GPU")
        full = f"@llvm.{name}.f{8 * self.dtype.itemsize}"
        self.declare(f"declare {self.scalar} {full}({', '.join([self.scalar] * len(operands))})")
        return self.emit(f"call {self.scalar} {full}({', '.join(f'{self.scalar} {x}' for x in operands)})")

    # Memory

    def read(self, value: Value) -> str:
        """Return the name of a value that is not computed; scalars of arguments are loaded."""
        if value.op in ("carry", "result"):
            step, index = value.args
            return self.slots[step][index]
        unit = {"f": self.scalar, "i": "i32", "b": "i8"}[value.kind]
        place = self.place(value.address, unit, self.own[value.address.argument])
        found = self.emit(f"load {unit}, ptr addrspace(1) {place}")
        return self.emit(f"icmp ne i8 {found}, 0") if value.kind == "b" else found

    def place(self, address: Address, unit: str, base: str) -> str:
        """Write a pointer to an entry of the argument or result that begins at `base`."""
        return self.emit(f"getelementptr {unit}, ptr addrspace(1) {base}, i64 {self.offset(address)}")
