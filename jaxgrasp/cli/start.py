"""Starts a command, and answers with an exit code; what takes long to import is imported once signals are handled."""

import sys
from collections.abc import Sequence

from jaxgrasp.cli import signals
from jaxgrasp.cli.streams import one_line, prepared, printing


def run(arguments: Sequence[str] | None) -> int:
    """Runs a command, see `jaxgrasp.cli.main`."""
    with signals.handled(), prepared():
        code = _answer(arguments)
        number = signals.received()
        if number is None:
            return code
        if not signals.stopped():
            one_line(signals.outcome())
        return 128 + number


def run_process() -> None:
    """Runs a command as a process of its own."""
    with signals.handled():
        try:
            code = run(None)
        except SystemExit as leaving:
            code = leaving.code
        signals.end(code)
    sys.exit(code)


def _answer(arguments: Sequence[str] | None) -> int:
    from jaxgrasp.cli.errors import CommandError
    from jaxgrasp.cli.subcommands import parsed
    from jaxgrasp.storage import limited_to

    command = None
    try:
        with printing():
            command = parsed(arguments)
        if command is None:
            return 0
        with limited_to(command.budget):
            return command.run()
    except CommandError as error:
        one_line(error)
        return error.exit_code
    except MemoryError as error:
        one_line(f"not enough memory {f'({error})' if str(error) else ''}")
        return 2
    except KeyboardInterrupt:
        one_line(signals.outcome())
        return 130
