"""The order in which a program's values are computed, and when each is used.

A program becomes one list of events. Values are computed depth first, when they are first needed, so that few have to
be kept at a time; a product that is used once, in a sum, becomes part of it.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from jaxgrasp.kernels.program.expressions import Region, Value
from jaxgrasp.kernels.program.lowering import Guard, Loop, Program
from jaxgrasp.kernels.program.sums import chain_sums

Step = Loop | Guard


@dataclass(eq=False)
class Event:
    """Something that happens: `what` is "compute", "store" (a result of the program), "enter", "test" or "leave".

    subject: the value that is computed, the number of the result, or the loop or guard.
    uses: the values that are needed for it.
    """

    what: str
    subject: Any
    uses: list[Value]


@dataclass
class Schedule:
    """Events in order.

    fused: products that are part of a sum.
    uses: where each value is used, as numbers of events; a use in a loop that its value is not of lasts to its end.
    last: the last of them.
    """

    events: list[Event]
    fused: set[Value]
    uses: dict[Value, list[int]] = field(default_factory=dict)
    last: dict[Value, int] = field(default_factory=dict)


def in_memory(value: Value) -> bool:
    """Whether a value is read from memory wherever it is used."""
    return value.op in ("own", "shared", "carry", "result")


def scheduled(program: Program) -> Schedule:
    """Put a program in order."""
    results = [x for out in program.outputs for x in out.flat]
    values, count = _used(program.builder.region, results)
    order = _Order(_products(chain_sums(values, count), count))
    order.region(program.builder.region, results)
    for number, value in enumerate(results):
        order.events.append(Event("store", number, _values([value])))
    schedule = Schedule(_spread(order.events), order.fused)
    _count(schedule)
    return schedule


# Values that wait for their turn beside each other, and how long a value takes, in values.
_WINDOW = 64
_LATENCY = {"div": 14, "rsqrt": 18, "sqrt": 24}


def _spread(events: list[Event]) -> list[Event]:
    """The same in an order in which values are ready when they are needed, as far as a few events can be exchanged.

    One value a cycle begins. Where none of the next ones has all it needs, the one that has it first is next.
    """
    out: list[Event] = []
    finished: dict[Value, int] = {}
    # With each event that waits, when it has all it needs; None as long as that is not known.
    waiting: list[tuple[Event, int | None]] = []
    pending: set[Value] = set()
    time = place = 0
    while place < len(events) or waiting:
        while place < len(events) and len(waiting) < _WINDOW and events[place].what == "compute":
            waiting.append((events[place], None))
            pending.add(events[place].subject)
            place += 1
        if not waiting:
            out.append(events[place])
            place += 1
            continue
        best, first = -1, 0
        for number, (event, ready) in enumerate(waiting):
            if ready is None:
                if not pending.isdisjoint(event.uses):
                    continue
                ready = max([finished.get(value, 0) for value in event.uses], default=0)
                waiting[number] = event, ready
            if best < 0 or ready < first:
                best, first = number, ready
                if ready <= time:
                    break
        event, _ = waiting.pop(best)
        time = max(time, first)
        pending.discard(event.subject)
        finished[event.subject] = time + _LATENCY.get(event.subject.op, 4)
        time += 1
        out.append(event)
    return out


def operands(value: Value, fused: set[Value]) -> list[Value]:
    """What has to be known to compute a value: its operands, and where those lie that are in memory."""
    if value.op in ("own", "shared"):
        return _values([value.address.counter])
    if value.op in ("carry", "result", "counter"):
        return []
    needed: list[Value] = []
    for x in value.args:
        if type(x) is not Value:
            continue
        if x in fused:
            needed += [y for y in x.args if type(y) is Value]
        else:
            needed.append(x)
    return _addressed(needed)


def _addressed(values: list[Value]) -> list[Value]:
    """With what the addresses of those in memory depend on."""
    far = [x.address.counter for x in values if x.op in ("own", "shared")]
    return values + _values(far) if far else values


def _values(entries: Iterable[Any]) -> list[Value]:
    return [x for x in entries if type(x) is Value]


def _roots(step: Step) -> list[Any]:
    entered = [*step.initial, step.condition] if isinstance(step, Loop) else [step.condition]
    return [*entered, *step.outputs]


def _used(region: Region, results: list[Any]) -> tuple[list[Value], Counter[Value]]:
    """All values that are needed, and how often."""
    count: Counter[Value] = Counter()
    seen: dict[Value, None] = {}
    stack: list[Value] = []
    none: set[Value] = set()

    def need(entries: Iterable[Any]) -> None:
        for value in _values(entries):
            count[value] += 1
            stack.append(value)
        while stack:
            value = stack.pop()
            if value in seen:
                continue
            seen[value] = None
            needed = operands(value, none)
            count.update(needed)
            stack.extend(needed)

    def visit(region: Region) -> None:
        for step in region.steps:
            need(_roots(step))
            visit(step.body)

    visit(region)
    need(results)
    return list(seen), count


def _products(sums: list[Value], count: Counter[Value]) -> set[Value]:
    """Products that can be part of a sum: used once, where they are computed."""
    fused: set[Value] = set()
    for value in sums:
        for x in _values(value.args):
            if x.op == "mul" and count[x] == 1 and x.region is value.region:
                fused.add(x)
                break
    return fused


class _Order:
    def __init__(self, fused: set[Value]) -> None:
        self.fused = fused
        self.events: list[Event] = []
        self.done: set[Value] = set()

    def region(self, region: Region, results: Iterable[Any]) -> None:
        """Steps, and what is asked for after them."""
        for step in region.steps:
            self.step(step, region)
        self.compute_all(results)

    def step(self, step: Step, region: Region) -> None:
        for value in self.outside(step, region):
            self.compute(value)
        body = step.body
        if isinstance(step, Guard):
            self.compute_all([step.condition])
            self.events.append(Event("enter", step, _values([step.condition])))
        else:
            self.compute_all(step.initial)
            self.events.append(Event("enter", step, _values(step.initial)))
            if step.rounds is None:
                self.compute_all([step.condition])
                self.events.append(Event("test", step, _values([step.condition])))
        self.region(body, step.outputs)
        self.events.append(Event("leave", step, _values(step.outputs)))

    def compute_all(self, entries: Iterable[Any]) -> None:
        for value in _addressed(_values(entries)):
            self.compute(value)

    def compute(self, root: Value) -> None:
        """A value, and first what it is made of."""
        stack = [root]
        while stack:
            value = stack[-1]
            if value in self.done or in_memory(value) or value.op == "counter":
                stack.pop()
                continue
            needed = operands(value, self.fused)
            missing = [x for x in needed if not (x in self.done or in_memory(x) or x.op == "counter")]
            if missing:
                stack.extend(reversed(missing))
                continue
            stack.pop()
            self.done.add(value)
            self.events.append(Event("compute", value, needed))

    def outside(self, step: Step, region: Region) -> list[Value]:
        """What a step needs of the code around it."""
        found: dict[Value, None] = {}
        seen: set[Value] = set()

        def visit(roots: Iterable[Any]) -> None:
            stack = _values(roots)
            while stack:
                value = stack.pop()
                if value in seen:
                    continue
                seen.add(value)
                if value.region.depth <= region.depth and not in_memory(value):
                    found[value] = None
                else:
                    stack.extend(operands(value, self.fused))

        def enter(step: Step) -> None:
            visit(_roots(step))
            for inner in step.body.steps:
                enter(inner)

        enter(step)
        return list(found)


def _count(schedule: Schedule) -> None:
    """When values are used."""
    inside: list[tuple[Step, int]] = []
    ends: dict[Step, int] = {e.subject: i for i, e in enumerate(schedule.events) if e.what == "leave"}
    for number, event in enumerate(schedule.events):
        if event.what == "leave":
            inside.pop()
        for value in event.uses:
            schedule.uses.setdefault(value, []).append(number)
            last = number
            for step, _ in inside:
                if isinstance(step, Loop) and value.region.depth < step.body.depth:
                    last = max(last, ends[step])
            schedule.last[value] = max(schedule.last.get(value, -1), last)
        if event.what == "enter":
            inside.append((event.subject, number))
