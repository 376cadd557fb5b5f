"""Ctrl-C and SIGTERM while a command runs: one line, exit 130 or 143, and what was finished is kept.

No exception is thrown into whatever Python is doing: JAX calls it from C++ and from other threads, where exceptions are
lost or end the process. A thread of its own hears of a signal, also while the main thread is inside native code. Where
nothing is finished yet it ends the process then and there, without the interpreter's own end, which would free what
native threads still use. Where something is, the main thread is left to reach its next checkpoint, and stops there.
"""

import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator

from jaxgrasp.cli.streams import fill_closed_descriptors

# A tile or a compilation may lie between two checkpoints; whoever waits in vain can send the signal again.
_PATIENCE = 20.0
_NUMBERS = (signal.SIGINT, signal.SIGTERM)


class _Watch:
    """What is known while a command runs."""

    def __init__(self) -> None:
        self.received: int | None = None
        self.worth_keeping = False
        self.stopped = False
        self.leaving = False
        self.written: list[str] = []

    def listen(self, inbox: int) -> None:
        """Waits for signals, each a byte in a pipe, until its other end is closed."""
        deadline = float("inf")
        while True:
            waiting = self.received is not None
            if select.select([inbox], [], [], 0.5 if waiting else None)[0]:
                numbers = os.read(inbox, 16)
                if not numbers:
                    os.close(inbox)
                    return
                for number in filter(_NUMBERS.__contains__, numbers):
                    if self.received is not None or not self.worth_keeping:
                        self.leave(number)
                    self.received, deadline = number, time.monotonic() + _PATIENCE
            elif time.monotonic() > deadline and not self.stopped and not _ask_writer("unfinished"):
                self.leave(self.received or signal.SIGINT)

    def leave(self, number: int) -> None:
        """Ends the process from this thread."""
        self.leaving = True
        with contextlib.suppress(OSError):
            # Bars hide the cursor. The main thread may hold the locks of Python's own streams.
            line = f"jaxgrasp: {outcome(number)}\n".encode("utf-8", "backslashreplace")
            os.write(2, (b"\r\x1b[K\x1b[?25h" if os.isatty(2) else b"") + line)
        _ask_writer("discard_unfinished")
        os._exit(128 + number)


_watch: _Watch | None = None


@contextlib.contextmanager
def handled() -> Iterator[None]:
    """Handles signals inside this block, unless it is inside another one, or in a thread that gets none."""
    global _watch
    if _watch is not None or threading.current_thread() is not threading.main_thread():
        yield
        return
    fill_closed_descriptors()
    _watch = _Watch()
    inbox, outbox = os.pipe()
    os.set_blocking(outbox, False)
    before = signal.set_wakeup_fd(outbox, warn_on_full_buffer=False)
    # Who starts a command in the background has it pass Ctrl-C over.
    heard = [number for number in _NUMBERS if signal.getsignal(number) is not signal.SIG_IGN]
    handlers = {number: signal.signal(number, _pass_on) for number in heard}
    threading.Thread(target=_watch.listen, args=(inbox,), daemon=True, name="signals").start()
    try:
        yield
    finally:
        for number, handler in handlers.items():
            # Not where `end` has come in between.
            if signal.getsignal(number) is _pass_on:
                signal.signal(number, handler or signal.SIG_DFL)
        signal.set_wakeup_fd(before)
        os.close(outbox)
        _watch = None


def checkpoint() -> None:
    """Says that there is something worth keeping from here on, and that the command can stop here.

    Raises:
        KeyboardInterrupt: The command shall stop. It is raised once.
    """
    if _watch is not None:
        _watch.worth_keeping = True
        if _watch.received is not None and not _watch.stopped:
            _watch.stopped = True
            raise KeyboardInterrupt


def note_written(path: object) -> None:
    """Notes a file that was written, to be told where the command is ended."""
    if _watch is not None:
        _watch.written.append(str(path))


def received() -> int | None:
    """The signal that asked the command to stop."""
    return _watch.received if _watch is not None else None


def stopped() -> bool:
    """Whether a checkpoint has stopped the command."""
    return _watch is not None and _watch.stopped


def word(number: int | None = None) -> str:
    """What a signal, that which was received where None, has done to the command."""
    return "terminated" if (number or received()) == signal.SIGTERM else "interrupted"


def outcome(number: int | None = None) -> str:
    """The same, and what is left of the command's work."""
    written = ", ".join(_watch.written) if _watch is not None else ""
    return f"{word(number)}, {f'written: {written}' if written else 'nothing was written'}"


def let_end() -> None:
    """Waits for the process to end where a signal ends it: what fails meanwhile fails for that, and is not told."""
    if _watch is not None and _watch.leaving:
        threading.Event().wait()


def end(code: object) -> None:
    """Ends a process that was asked to stop; otherwise nothing is left to be stopped, and signals are passed over."""
    for number in _NUMBERS:
        signal.signal(number, signal.SIG_IGN)
    if received() is not None:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(code if isinstance(code, int) else 1)


def _pass_on(*_: object) -> None:
    """Leaves a signal to the thread, which has its number by the pipe."""


def _ask_writer(name: str) -> bool:
    """Calls a function of the writer, which is not imported before it is needed: a second is long for Ctrl-C."""
    function = getattr(sys.modules.get("jaxgrasp.storage"), name, None)
    return function is not None and bool(function())
