"""The command `jaxgrasp`, one file a subcommand.

This file answers signals until `signals` does, and is all that is imported before: it imports what Python itself has.
"""

# `signal` also imports `enum`, which takes four milliseconds. Python's stubs lack this one.
import _signal  # pyright: ignore[reportMissingImports]
import os


def main(arguments: list[str] | None = None) -> int:
    """Runs the command `jaxgrasp`. While it runs, Ctrl-C and SIGTERM are its own, see `signals`.

    Args:
        arguments: What follows the program's name; the process's own where None.

    Returns:
        The exit code: 0, 2 for what the caller can mend (one line on standard error says what), 130 after Ctrl-C and
        143 after SIGTERM, 1 where the computation itself failed.
    """
    from jaxgrasp.cli.start import run

    return run(arguments)


def program() -> None:
    """Runs `main` as a process of its own."""
    for number in (_signal.SIGINT, _signal.SIGTERM):
        # Who starts a command in the background has it pass Ctrl-C over.
        if _signal.getsignal(number) != _signal.SIG_IGN:
            _signal.signal(number, _leave)
    from jaxgrasp.cli.start import run_process

    run_process()


def _leave(number: int, frame: object) -> None:
    """Ends the process while the package is being imported."""
    word = b"interrupted" if number == _signal.SIGINT else b"terminated"
    try:
        os.write(2, b"jaxgrasp: " + word + b", nothing was written\n")
    finally:
        os._exit(128 + number)
