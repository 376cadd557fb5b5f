"""Put a program's values in the order in which they are computed, and record when each is used.

A program becomes one list of events. Values are computed depth first, when they are first needed, so that few have to
be kept at a time; a product that is used once, in a sum, becomes part of a fused multiply-add.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from jaxgrasp.kernels.program.contraction import chain_sums
from jaxgrasp.kernels.program.expressions import Region, Value
from jaxgrasp.kernels.program.lowering import Guard, Loop, ScalarProgram

Step = Loop | Guard


@dataclass(eq=False)
class Event:
    """Something that a kernel does.

    what: "compute" a value, "store" a result of the program, "enter" or "leave" a loop or guard, or "test" a loop's
        condition.
    subject: the value, the number of the result, or the loop or guard.
    uses: the values that are needed for it.
    """

    what: str
    subject: Any
    uses: list[Value]


@dataclass
class Schedule:
    """The events of a program in order.

    fused: products that are computed within a sum, as a fused multiply-add.
    uses: event indices of each use of a value.
    last: the index of the last event up to which a value is needed; a loop that reads a value from outside needs it
        until the loop ends.
    """

    events: list[Event]
    fused: set[Value]
    uses: dict[Value, list[int]] = field(default_factory=dict)
    last: dict[Value, int] = field(default_factory=dict)


def in_memory(value: Value) -> bool:
    """Tell whether a value is not computed, but read from memory wherever it is used."""
    return value.op in ("own", "shared", "entry", "carry", "result")


def is_computed_in(value: Value, region: Region) -> bool:
    """Tell whether a region computes a value."""
    return value.region is region and not in_memory(value) and value.op != "counter"


def schedule(program: ScalarProgram) -> Schedule:
    """Put a program in order. Its sums are changed in place, so that a program can be scheduled only once."""
    results = [x for out in program.outputs for x in out.flat]
    values, count = _collect_used(program.builder.region, results)
    order = _Order(_find_fused(chain_sums(values, count), count))
    order.region(program.builder.region, results)
    for number, value in enumerate(results):
        order.events.append(Event("store", number, _values([value])))
    found = Schedule(_interleave(order.events), order.fused)
    _record_uses(found)
    return found


# How many computations are considered for the next place, and how many cycles a value takes; all others take 4.
_WINDOW = 64
_LATENCY = {"div": 14, "rsqrt": 18, "sqrt": 24}


def _interleave(events: list[Event]) -> list[Event]:
    """Reorder computations within a window, so that operands are ready when they are needed (list scheduling).

    One value begins in every cycle: the first whose operands are ready, else the one whose operands are ready soonest.
    """
    out: list[Event] = []
    finished: dict[Value, int] = {}
    # The events in the window, each with the cycle in which its operands are ready; None while that is not known.
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
    """Return what has to be known to compute a value: its operands, and the counters of their addresses."""
    if value.op in ("own", "shared", "entry"):
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
    return _with_counters(needed)


def _with_counters(values: list[Value]) -> list[Value]:
    """Append the counters that the addresses of values in memory depend on."""
    far = [x.address.counter for x in values if x.op in ("own", "shared", "entry")]
    return values + _values(far) if far else values


def _values(entries: Iterable[Any]) -> list[Value]:
    """Leave constants out."""
    return [x for x in entries if type(x) is Value]


def _roots(step: Step) -> list[Any]:
    """Return what a step needs: to begin, to be tested, and of its body."""
    if isinstance(step, Guard):
        return [step.condition, *step.outputs]
    return [*_entered(step), step.condition, *step.outputs, *_stacked(step)]


def _entered(loop: Loop) -> list[Any]:
    """Return what a loop begins with: carried scalars, and what its tables are filled with."""
    return [*loop.initial, *[x for _, entries in loop.filled for x in entries]]


def _stacked(loop: Loop) -> list[Value]:
    """Return what every round of a loop writes to tables."""
    return [x for _, entries in loop.stacked for x in entries]


def _collect_used(region: Region, results: list[Any]) -> tuple[list[Value], Counter[Value]]:
    """Return all values that are needed, and how often each is."""
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


def _find_fused(sums: list[Value], count: Counter[Value]) -> set[Value]:
    """Choose at most one product of every sum for a fused multiply-add: it is used once, in its own region."""
    fused: set[Value] = set()
    for value in sums:
        for x in _values(value.args):
            if x.op == "mul" and count[x] == 1 and x.region is value.region:
                fused.add(x)
                break
    return fused


class _Order:
    """Collects the events of a program, values depth first.

    Args:
        fused: products that are not computed by themselves.
    """

    def __init__(self, fused: set[Value]) -> None:
        self.fused = fused
        self.events: list[Event] = []
        self.done: set[Value] = set()

    def region(self, region: Region, results: Iterable[Any]) -> None:
        """Add a region: its steps, then what is asked for after them."""
        for step in region.steps:
            self.step(step, region)
        self.compute_all(results)

    def step(self, step: Step, region: Region) -> None:
        """Add a loop or guard; what it reads from outside is computed before it."""
        for value in self.outside(step, region):
            self.compute(value)
        body = step.body
        if isinstance(step, Guard):
            self.compute_all([step.condition])
            self.events.append(Event("enter", step, _values([step.condition])))
        else:
            self.compute_all(_entered(step))
            self.events.append(Event("enter", step, _values(_entered(step))))
            if step.rounds is None:
                self.compute_all([step.condition])
                self.events.append(Event("test", step, _values([step.condition])))
        written = _stacked(step) if isinstance(step, Loop) else []
        self.region(body, [*step.outputs, *written])
        # What the body computes is written where it is computed.
        rest = [x for x in written if not is_computed_in(x, body)]
        self.events.append(Event("leave", step, [*_values(step.outputs), *rest]))

    def compute_all(self, entries: Iterable[Any]) -> None:
        """Add scalars that are not there yet."""
        for value in _with_counters(_values(entries)):
            self.compute(value)

    def compute(self, root: Value) -> None:
        """Add a value that is not there yet, after its operands."""
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
        """Find the values that a step reads of the code around it."""
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


def _record_uses(schedule: Schedule) -> None:
    """Fill in `uses` and `last`."""
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
    for number, event in enumerate(schedule.events):
        if event.what == "compute":
            # What a round writes to a table may be used by nobody else.
            schedule.last.setdefault(event.subject, number)
