"""What can be found wrong with a command line before any long work, and with its files in the end."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates

from jaxgrasp.cli import signals
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.streams import one_line
from jaxgrasp.storage import check_writable, reason_of


class Skipped:
    """Files that were passed over, each with a line on standard error."""

    def __init__(self) -> None:
        """Starts with none."""
        self.count = 0
        """Number of files that were passed over."""

    def __call__(self, error: Exception) -> None:
        """Tells what is wrong with one."""
        self.count += 1
        one_line(error)

    def exit_code(self) -> int:
        """2 where files were passed over, else 0."""
        return 2 if self.count else 0


def check_options(*checks: tuple[str, object, bool, str]) -> None:
    """Refuses values that cannot be used.

    Args:
        checks: Option, value, whether it can be used, and what is wanted.

    Raises:
        CommandError: One of them, the first, cannot be used.
    """
    for option, value, admissible, wanted in checks:
        if not admissible:
            raise CommandError(f"{option}: got {value}; wanted {wanted}")


def check_output(path: Path, option: str, endings: Sequence[str], inputs: Sequence[Path]) -> None:
    """Finds out whether a file can be written, and leaves everything as it was.

    Args:
        path: The file.
        option: The option that names it.
        endings: The endings that say a known format.
        inputs: Files that must not be overwritten.

    Raises:
        CommandError: The ending is unknown, the file is one of the inputs, or it cannot be written.
    """
    if path.suffix not in endings:
        raise CommandError(f"{option} {path}: got the ending {path.suffix!r}; wanted one of {', '.join(endings)}")
    # Not by Path.resolve, which answers loops of links with an exception.
    if any(os.path.realpath(path) == os.path.realpath(other) for other in inputs):
        raise CommandError(f"{option} {path}: this file is read from; wanted another one")
    try:
        check_writable(path)
    except (OSError, ValueError) as error:
        raise CommandError(f"{option} {path}: cannot be written ({reason_of(error)})") from error


def warn_of_conventions(candidates: "Candidates") -> None:
    """Tells on standard error, in one line, of units and directions of contacts that can hardly be meant.

    Args:
        candidates: Grasps by their contacts.
    """
    from jaxgrasp.candidates import doubtful_conventions

    doubts = doubtful_conventions(candidates)
    if doubts:
        one_line(f"warning: {' | '.join(doubts)}")


def write_files(*jobs: tuple[Path | None, Callable[[Path], None]]) -> tuple[list[Path], bool]:
    """Writes one file after the other; what cannot be written is told on standard error and keeps no other back.

    Args:
        jobs: File, None where it is not wanted, and what writes it.

    Returns:
        The files that were written, and whether any could not be.

    Raises:
        KeyboardInterrupt: Ctrl-C came while one of them was written, which is whole then.
    """
    written, failed = [], False
    for path, write in jobs:
        if path is None:
            continue
        signals.checkpoint()
        try:
            write(path)
            written.append(path)
            signals.note_written(path)
        except OSError as error:
            one_line(f"{path}: cannot be written ({error.strerror or error})")
            failed = True
    return written, failed
