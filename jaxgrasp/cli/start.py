"""Starts a command, and answers with an exit code; what takes long to import is imported once signals are handled."""

import os
import sys
from collections.abc import Sequence

from jaxgrasp.cli import signals
from jaxgrasp.cli.streams import one_line, prepared, printing, tell_notices


def run(arguments: Sequence[str] | None) -> int:
    """Runs a command, see `jaxgrasp.cli.main`."""
    with signals.handled(), prepared():
        try:
            code, line = _answer(arguments)
        finally:
            signals.let_end()
        number = signals.received()
        if number is not None:
            code, line = 128 + number, line if signals.stopped() else signals.outcome()
        # What goes well has notices to tell; what is refused or stopped says that in one line, and nothing else.
        if line:
            one_line(line)
        else:
            tell_notices()
        return code


def run_process() -> None:
    """Runs a command as a process of its own."""
    # XLA's alarms about slow compiling, for developers, would tear the progress bar.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    with signals.handled():
        try:
            code = run(None)
        except SystemExit as leaving:
            code = leaving.code
        signals.end(code)
    sys.exit(code)


def _answer(arguments: Sequence[str] | None) -> tuple[int, str]:
    """Returns the exit code, and the line that tells why it is none of success."""
    from jaxgrasp.cli.errors import CommandError
    from jaxgrasp.cli.subcommands import parsed
    from jaxgrasp.storage import limited_to

    command = None
    try:
        with printing():
            command = parsed(arguments)
        if command is None:
            return 0, ""
        with limited_to(command.budget):
            return command.run(), ""
    except CommandError as error:
        return error.exit_code, str(error)
    except MemoryError as error:
        return 2, f"not enough memory {f'({error})' if str(error) else ''}"
    except KeyboardInterrupt:
        return 130, signals.outcome()
