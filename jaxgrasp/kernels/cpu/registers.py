"""Which values are in vector registers, and which in memory.

LLVM could decide, but takes most of a kernel's compile time to. Code here has no branches but those of loops, so that
the best choice is known: out goes what is used last. Around loops and guards everything is in memory.
"""

from typing import Any

from jaxgrasp.kernels.program.expressions import Value
from jaxgrasp.kernels.program.schedule import Schedule, in_memory


class Registers:
    """Names of the values that are in registers, and places of those that are not.

    Args:
        code: where instructions go.
        schedule: when values are used.
        count: registers for values.
    """

    def __init__(self, code: Any, schedule: Schedule, count: int) -> None:
        """See the class."""
        self.code, self.schedule, self.count = code, schedule, count
        self.names: dict[Value, str] = {}
        self.places: dict[Value, str] = {}
        self.stored: set[Value] = set()
        self.free: dict[str, list[str]] = {"f": [], "i": [], "b": []}
        self.used: dict[Value, int] = dict.fromkeys(schedule.uses, 0)
        # When each vector in a register is used next.
        self.ahead: dict[Value, int] = {}
        self.ending: dict[int, list[Value]] = {}
        for value, last in schedule.last.items():
            if value.kind != "u":
                self.ending.setdefault(last, []).append(value)

    def fetch(self, value: Value) -> str:
        """The name of a value, which is read from memory if need be."""
        if value not in self.names:
            if in_memory(value):
                self.names[value] = self.code.read(value)
            else:
                self.names[value] = self.code.load(value.kind, self.places[value])
        return self.names[value]

    def put(self, value: Value, name: str, place: str | None = None) -> None:
        """A value that was computed; with its place where it is in memory already."""
        self.names[value] = name
        if place is not None:
            self.places[value] = place
            self.stored.add(value)

    def passed(self, number: int) -> None:
        """Event `number` is over: what is not used again goes, and what is used last where there are too many."""
        event = self.schedule.events[number]
        for value in event.uses:
            self.look(value, number)
        if event.what == "compute":
            self.look(event.subject, number)
        for value in self.ending.get(number, ()):
            self.drop(value)
            place = self.places.pop(value, None)
            if place is not None and value not in self.code.homes:
                self.free[value.kind].append(place)
        while len(self.ahead) > self.count:
            value = max(self.ahead, key=self.ahead.__getitem__)
            self.save(value)
            self.drop(value)

    def look(self, value: Value, number: int) -> None:
        """Find out when a vector is used next."""
        if value not in self.names or value.kind not in "fi":
            return
        uses, at = self.schedule.uses.get(value, ()), self.used.get(value, 0)
        while at < len(uses) and uses[at] <= number:
            at += 1
        self.used[value] = at
        self.ahead[value] = uses[at] if at < len(uses) else self.schedule.last.get(value, number)

    def drop(self, value: Value) -> None:
        """Out of its register."""
        self.names.pop(value, None)
        self.ahead.pop(value, None)

    def save(self, value: Value) -> None:
        """Make sure that a value is in memory."""
        if in_memory(value) or value in self.stored or value.kind == "u":
            return
        free = self.free[value.kind]
        place = self.places[value] = free.pop() if free else self.code.allocate(value.kind)
        self.code.store(value.kind, self.names[value], place)
        self.stored.add(value)

    def flush(self, number: int) -> None:
        """Before code branches: everything that is needed later goes to memory."""
        for value in list(self.names):
            if value.kind == "u":
                continue
            if self.schedule.last.get(value, -1) > number or value in self.schedule.events[number].uses:
                self.save(value)
        self.names = {v: name for v, name in self.names.items() if v.kind == "u"}
        self.ahead.clear()
