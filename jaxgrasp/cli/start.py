"""Starts a command, and answers with an exit code. Nothing that takes long to import is imported before signals are."""

import sys
from collections.abc import Sequence

from jaxgrasp.cli import signals
from jaxgrasp.cli.streams import one_line, prepared, printing


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command `jaxgrasp`. While it runs, Ctrl-C and SIGTERM are its own, see `signals`.

    Args:
        arguments: What follows the program's name; the process's own where None.

    Returns:
        The exit code: 0, 2 for what the caller can mend (one line on standard error says what), 130 after Ctrl-C and
        143 after SIGTERM, 1 where the computation itself failed.
    """
    with signals.handled(), prepared():
        code = _run(arguments)
        number = signals.received()
        if number is None:
            return code
        if not signals.stopped():
            one_line(signals.outcome())
        return 128 + number


def program() -> None:
    """Runs `main` as a process of its own."""
    with signals.handled():
        try:
            code = main()
        except SystemExit as leaving:
            code = leaving.code
        signals.end(code)
    sys.exit(code)


def _run(arguments: Sequence[str] | None) -> int:
    from jaxgrasp.cli.problems import CommandError
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
