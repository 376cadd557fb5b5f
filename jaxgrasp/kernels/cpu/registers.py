"""Decide which values are in vector registers, and which in memory.

LLVM could decide, but that would take most of a kernel's compile time. The code here has no branches but those of loops
and guards, so that the best choice is known (Belady's): spill what is used last. Around loops and guards everything is
in memory.
"""

from typing import Any

from jaxgrasp.kernels.program.expressions import Value
from jaxgrasp.kernels.program.schedule import Schedule, in_memory


class Registers:
    """Names of the values that are in registers, and places of those that are in memory.

    Args:
        code: a `VectorCode`, to write loads and stores with.
        schedule: when values are used.
        count: registers for values.

    names: of values in registers.
    places: of values in memory.
    stored: values that are in memory.
    free: places that can be used again, by type.
    used: how many of its uses a value has behind it.
    next_use: for every vector in a register, the event that uses it next.
    ending: values by the last event up to which they are needed.
    """

    def __init__(self, code: Any, schedule: Schedule, count: int) -> None:
        """Begin with no value in a register."""
        self.code, self.schedule, self.count = code, schedule, count
        self.names: dict[Value, str] = {}
        self.places: dict[Value, str] = {}
        self.stored: set[Value] = set()
        self.free: dict[str, list[str]] = {"f": [], "i": [], "b": []}
        self.used: dict[Value, int] = dict.fromkeys(schedule.uses, 0)
        self.next_use: dict[Value, int] = {}
        self.ending: dict[int, list[Value]] = {}
        for value, last in schedule.last.items():
            if value.kind != "u":
                self.ending.setdefault(last, []).append(value)

    def fetch(self, value: Value) -> str:
        """Return the name of a value, which is loaded if it is not in a register."""
        if value not in self.names:
            if in_memory(value):
                self.names[value] = self.code.read(value)
            else:
                self.names[value] = self.code.load(value.kind, self.places[value])
        return self.names[value]

    def put(self, value: Value, name: str, place: str | None = None) -> None:
        """Take note of a value that was computed, with its place where it is in memory already."""
        self.names[value] = name
        if place is not None:
            self.places[value] = place
            self.stored.add(value)

    def advance(self, number: int) -> None:
        """After event `number`: drop values that have no more uses; spill those used last if there are too many."""
        event = self.schedule.events[number]
        for value in event.uses:
            self.find_next_use(value, number)
        if event.what == "compute":
            self.find_next_use(event.subject, number)
        for value in self.ending.get(number, ()):
            self.drop(value)
            place = self.places.pop(value, None)
            if place is not None and value not in self.code.in_slots:
                self.free[value.kind].append(place)
        while len(self.next_use) > self.count:
            value = max(self.next_use, key=self.next_use.__getitem__)
            self.save(value)
            self.drop(value)

    def find_next_use(self, value: Value, number: int) -> None:
        """Find the event after `number` that uses a vector next."""
        if value not in self.names or value.kind not in "fi":
            return
        uses, at = self.schedule.uses.get(value, ()), self.used.get(value, 0)
        while at < len(uses) and uses[at] <= number:
            at += 1
        self.used[value] = at
        self.next_use[value] = uses[at] if at < len(uses) else self.schedule.last.get(value, number)

    def drop(self, value: Value) -> None:
        """Take a value out of its register."""
        self.names.pop(value, None)
        self.next_use.pop(value, None)

    def save(self, value: Value) -> None:
        """Store a value that is not in memory yet."""
        if in_memory(value) or value in self.stored or value.kind == "u":
            return
        free = self.free[value.kind]
        place = self.places[value] = free.pop() if free else self.code.allocate(value.kind)
        self.code.store(value.kind, self.names[value], place)
        self.stored.add(value)

    def flush(self, number: int) -> None:
        """Store everything that is needed after event `number`, before the code branches."""
        for value in list(self.names):
            if value.kind == "u":
                continue
            if self.schedule.last.get(value, -1) > number or value in self.schedule.events[number].uses:
                self.save(value)
        self.names = {v: name for v, name in self.names.items() if v.kind == "u"}
        self.next_use.clear()
