"""Pickles of strangers, read as data: a machine of our own that knows no way to run anything.

Python's unpickler calls what a pickle names. This one keeps a stack and a memo as that does, knows the opcodes that
plain data and NumPy arrays take, and answers the few names in `pickled_arrays.KNOWN`, compared as text, with functions
of this package; any other name, opcode or call ends the reading. Nothing is imported and no attribute is set. Data
lie in the file at their full length, so that nothing grows beyond it; opcodes, depth and what the memo repeats are
counted.
"""

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxgrasp.files.pickled_arrays import KNOWN, Name, Unbuilt
from jaxgrasp.storage import FileError, allowance, printable

WANTED = "NumPy arrays, dicts, lists, tuples, text and numbers alone (nothing in a file is run)"
# An opcode takes at most some hundred bytes of memory: together a tenth of the budget.
_PER_OPCODE = 1024
# Files of grasps nest dicts, lists and tuples four deep.
_DEPTH = 16
_MARKS = 64
# Whole numbers beyond 64 bits are no data, and many of them have the same hash.
_LONG = 9
_LINE = 256


def unpickle(
    path: Path,
    content: bytes,
    start: int = 0,
    *,
    known: Mapping[tuple[str, str], Name] = KNOWN,
    persistent: Callable[[object], object] | None = None,
) -> object:
    """Reads a pickle without running anything that it asks for.

    Args:
        path: The file that it is of, for messages.
        content: Bytes with the pickle in them.
        start: Where it begins.
        known: What stands for a module and a name in it.
        persistent: What stands for a persistent id; None refuses them.

    Returns:
        NumPy arrays and scalars, dicts, lists, tuples, text, bytes, numbers, truth values and None. Arrays of objects
        with one axis are lists, those without any their one entry.

    Raises:
        FileError: It is damaged, too large, too deep, or has anything else in it.
    """
    machine = _Machine(path, content, start, known, persistent)
    try:
        found = machine.run()
    except FileError:
        raise
    except (ValueError, TypeError, LookupError, OverflowError, struct.error, UnicodeError) as error:
        raise FileError(path, "pickle", f"damaged data ({type(error).__name__})", "an intact file") from error
    _check_tree(path, found)
    return found


class _Stop(Exception):
    pass


class _Machine:
    """Stack, memo and the place in the content."""

    def __init__(
        self,
        path: Path,
        content: bytes,
        start: int,
        known: Mapping[tuple[str, str], Name],
        persistent: Callable[[object], object] | None,
    ):
        self._path, self._content, self._place = path, content, start
        self._known, self._persistent = known, persistent
        self._stack: list = []
        self._below: list[list] = []
        self._memo: dict[int, object] = {}

    def run(self) -> object:
        content, handlers = self._content, _HANDLERS
        most = max(1, allowance() // _PER_OPCODE)
        try:
            for _ in range(most):
                code = content[self._place]
                self._place += 1
                handler = handlers.get(code)
                if handler is None:
                    self._refuse(f"the opcode {bytes([code])!r}, which plain data do not have")
                handler(self)
        except _Stop:
            return self._stack.pop()
        raise FileError(self._path, "pickle", f"more than {most:,} opcodes", "fewer (see --read-limit)")

    def _refuse(self, got: str) -> NoReturn:
        raise FileError(self._path, "pickle", got, WANTED)

    def _take(self, size: int) -> bytes:
        end = self._place + size
        if size < 0 or end > len(self._content):
            raise FileError(self._path, "pickle", "data that end early", "an intact file")
        piece = self._content[self._place : end]
        self._place = end
        return piece

    def _line(self, longest: int = _LINE) -> str:
        end = self._content.find(b"\n", self._place, self._place + longest)
        if end < 0:
            raise FileError(self._path, "pickle", "a line without an end", "an intact file")
        piece = self._content[self._place : end]
        self._place = end + 1
        return piece.decode("latin-1")

    def _number(self, form: str) -> int:
        return struct.unpack(form, self._take(struct.calcsize(form)))[0]

    def _to_mark(self) -> list:
        above, self._stack = self._stack, self._below.pop()
        return above

    # What starts and ends a pickle.

    def proto(self) -> None:
        if (version := self._take(1)[0]) > 5:
            self._refuse(f"a pickle of protocol {version}")

    def frame(self) -> None:
        self._take(8)

    def stop(self) -> None:
        raise _Stop

    # Numbers and text.

    def integer(self) -> None:
        text = self._line()
        self._stack.append({"00": False, "01": True}[text] if text in ("00", "01") else self._checked(int(text)))

    def long_line(self) -> None:
        self._stack.append(self._checked(int(self._line().rstrip("L"))))

    def long1(self) -> None:
        size = self._take(1)[0]
        if size > _LONG:
            self._refuse(f"a whole number of {size} bytes")
        self._stack.append(int.from_bytes(self._take(size), "little", signed=True))

    def _checked(self, number: int) -> int:
        if number.bit_length() > 64:
            self._refuse("a whole number beyond 64 bits")
        return number

    def real_line(self) -> None:
        self._stack.append(float(self._line()))

    def unicode_line(self) -> None:
        self._stack.append(self._line(len(self._content)).encode("latin-1").decode("raw-unicode-escape"))

    def bytearray8(self) -> None:
        self._stack.append(self._take(self._number("<Q")))

    # Containers.

    def mark(self) -> None:
        if len(self._below) >= _MARKS:
            self._refuse(f"containers more than {_MARKS} deep")
        self._below.append(self._stack)
        self._stack = []

    def pop(self) -> None:
        self._stack.pop() if self._stack else self._to_mark()

    def pop_mark(self) -> None:
        self._to_mark()

    def append(self) -> None:
        value = self._stack.pop()
        self._top(list).append(value)

    def appends(self) -> None:
        values = self._to_mark()
        self._top(list).extend(values)

    def to_list(self) -> None:
        values = self._to_mark()
        self._stack.append(values)

    def to_tuple(self) -> None:
        values = self._to_mark()
        self._stack.append(tuple(values))

    def short_tuple(self, size: int) -> None:
        if len(self._stack) < size:
            raise LookupError
        self._stack[-size:] = [tuple(self._stack[-size:])]

    def to_dict(self) -> None:
        values = self._to_mark()
        self._stack.append({})
        self._set(values)

    def setitem(self) -> None:
        value, key = self._stack.pop(), self._stack.pop()
        self._set([key, value])

    def setitems(self) -> None:
        self._set(self._to_mark())

    def _set(self, values: list) -> None:
        if len(values) % 2:
            raise LookupError
        table = self._top(dict)
        for key, value in zip(values[::2], values[1::2], strict=True):
            if type(key) not in (str, int):
                self._refuse(f"a key of type {type(key).__name__}")
            table[key] = value

    def _top(self, kind: type) -> Any:
        top = self._stack[-1]
        # Types that Python's own subclasses could stand in for never come to be here.
        if type(top) is not kind:
            self._refuse(f"entries put into what is no {kind.__name__}")
        return top

    # The memo.

    def get(self, number: int) -> None:
        self._stack.append(self._memo[number])

    def put(self, number: int) -> None:
        value = self._memo[number] = self._stack[-1]
        if isinstance(value, Unbuilt):
            value.kept_as.append(number)

    # Names and calls.

    def name(self) -> None:
        module, name = self._line(), self._line()
        self._stack.append(self._named(module, name))

    def stack_name(self) -> None:
        name, module = self._stack.pop(), self._stack.pop()
        self._stack.append(self._named(module, name))

    def _named(self, module: object, name: object) -> Name:
        found = self._known.get((module, name)) if type(module) is str and type(name) is str else None
        if found is None:
            self._refuse(f"the name {printable(module)[:80]}.{printable(name)[:80]}")
        return found

    def reduce(self) -> None:
        arguments, called = self._stack.pop(), self._stack.pop()
        if not isinstance(called, Name) or called.make is None or type(arguments) is not tuple:
            self._refuse("a call of what cannot be called")
        self._stack.append(self._made(called.make, *arguments))

    def build(self) -> None:
        state, unbuilt = self._stack.pop(), self._stack.pop()
        if not isinstance(unbuilt, Unbuilt):
            self._refuse("a state for what has none")
        value = self._made(unbuilt.built, state)
        for number in unbuilt.kept_as:
            self._memo[number] = value
        self._stack.append(value)

    def _made(self, make: Callable[..., object], *arguments: object) -> object:
        try:
            return make(*arguments)
        except (ValueError, TypeError, LookupError, OverflowError) as error:
            if isinstance(error, FileError) and str(error).startswith(str(self._path)):
                raise
            self._refuse(f"an array that cannot be made ({error})")

    def persistent(self) -> None:
        if self._persistent is None:
            self._refuse("a persistent id")
        self._stack.append(self._made(self._persistent, self._stack.pop()))


def _constant(value: object) -> Callable[[_Machine], None]:
    return lambda machine: machine._stack.append(value)


def _fixed(form: str) -> Callable[[_Machine], None]:
    return lambda machine: machine._stack.append(machine._number(form))


def _sized(form: str, encoding: str | None) -> Callable[[_Machine], None]:
    """Text, or bytes where there is no encoding, after its length."""

    def push(machine: _Machine) -> None:
        piece = machine._take(machine._number(form))
        machine._stack.append(piece.decode(encoding, "surrogatepass") if encoding else piece)

    return push


_HANDLERS: dict[int, Callable[[_Machine], None]] = {
    code[0]: handler
    for code, handler in (
        (b"\x80", _Machine.proto),
        (b"\x95", _Machine.frame),
        (b".", _Machine.stop),
        (b"N", _constant(None)),
        (b"\x88", _constant(True)),
        (b"\x89", _constant(False)),
        (b"J", _fixed("<i")),
        (b"K", _fixed("<B")),
        (b"M", _fixed("<H")),
        (b"G", _fixed(">d")),
        (b"I", _Machine.integer),
        (b"L", _Machine.long_line),
        (b"F", _Machine.real_line),
        (b"V", _Machine.unicode_line),
        (b"\x8a", _Machine.long1),
        (b"X", _sized("<I", "utf-8")),
        (b"\x8c", _sized("<B", "utf-8")),
        (b"\x8d", _sized("<Q", "utf-8")),
        # Text of Python 2, which has no other bytes.
        (b"T", _sized("<i", "latin-1")),
        (b"U", _sized("<B", "latin-1")),
        (b"B", _sized("<I", None)),
        (b"C", _sized("<B", None)),
        (b"\x8e", _sized("<Q", None)),
        (b"\x96", _Machine.bytearray8),
        (b"(", _Machine.mark),
        (b"0", _Machine.pop),
        (b"1", _Machine.pop_mark),
        (b"]", lambda machine: machine._stack.append([])),
        (b")", _constant(())),
        (b"}", lambda machine: machine._stack.append({})),
        (b"a", _Machine.append),
        (b"e", _Machine.appends),
        (b"l", _Machine.to_list),
        (b"t", _Machine.to_tuple),
        (b"\x85", lambda machine: machine.short_tuple(1)),
        (b"\x86", lambda machine: machine.short_tuple(2)),
        (b"\x87", lambda machine: machine.short_tuple(3)),
        (b"d", _Machine.to_dict),
        (b"s", _Machine.setitem),
        (b"u", _Machine.setitems),
        (b"g", lambda machine: machine.get(int(machine._line()))),
        (b"h", lambda machine: machine.get(machine._number("<B"))),
        (b"j", lambda machine: machine.get(machine._number("<I"))),
        (b"p", lambda machine: machine.put(int(machine._line()))),
        (b"q", lambda machine: machine.put(machine._number("<B"))),
        (b"r", lambda machine: machine.put(machine._number("<I"))),
        (b"\x94", lambda machine: machine.put(len(machine._memo))),
        (b"c", _Machine.name),
        (b"\x93", _Machine.stack_name),
        (b"R", _Machine.reduce),
        (b"b", _Machine.build),
        (b"Q", _Machine.persistent),
    )
}
_LEAVES = (str, bytes, int, float, bool, type(None))


def _check_tree(path: Path, tree: object) -> None:
    """Refuses what is deep, goes in circles, repeats itself without end, or has anything but data in it."""
    level: list[Any] = [tree]
    seen, most, size = 0, max(1, allowance() // _PER_OPCODE), 0
    for _ in range(_DEPTH):
        below: list = []
        for value in level:
            if type(value) is dict:
                below.extend(value.values())
            elif type(value) in (list, tuple):
                below.extend(value)
            elif type(value) is np.ndarray:
                # The memo may repeat an array any number of times; readers make eight-byte numbers of each.
                size += 8 * value.size
            elif type(value) not in _LEAVES and not isinstance(value, np.generic):
                raise FileError(path, "pickle", "a part of an array without the rest of it", WANTED)
            if size > allowance():
                raise FileError(path, "pickle", "arrays that repeat beyond the budget", "fewer (see --read-limit)")
            if seen + len(below) > most:
                raise FileError(path, "pickle", f"more than {most:,} entries", "fewer (see --read-limit)")
        seen += len(below)
        if not below:
            return
        level = below
    raise FileError(path, "pickle", f"containers more than {_DEPTH} deep", "dicts and lists of arrays")
