"""What can be found wrong with a command line before any long work, and with its files in the end."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates


class CommandError(Exception):
    """Something that the caller can mend, in one line."""

    exit_code = 2


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
    if any(path.resolve() == other.resolve() for other in inputs):
        raise CommandError(f"{option} {path}: this file is read from; wanted another one")
    existed = path.exists()
    try:
        # Permissions of the file's folder say little about read-only, full or remote ones: only opening it tells.
        with path.open("ab"):
            pass
        if not existed:
            os.unlink(path)
    except OSError as error:
        raise CommandError(f"{option} {path}: cannot be written ({(error.strerror or str(error)).lower()})") from error


def warn_of_conventions(candidates: "Candidates") -> None:
    """Tells on standard error, in one line, of units and directions of contacts that can hardly be meant.

    Args:
        candidates: Grasps by their contacts.
    """
    from jaxgrasp.candidates import doubtful_conventions

    doubts = doubtful_conventions(candidates)
    if doubts:
        print(f"jaxgrasp: warning: {' | '.join(doubts)}", file=sys.stderr)


def write_files(*jobs: tuple[Path | None, Callable[[Path], None]]) -> tuple[list[Path], bool]:
    """Writes one file after the other; what cannot be written is told on standard error and keeps no other back.

    Args:
        jobs: File, None where it is not wanted, and what writes it.

    Returns:
        The files that were written, and whether any could not be.
    """
    written, failed = [], False
    for path, write in jobs:
        if path is None:
            continue
        try:
            write(path)
            written.append(path)
        except OSError as error:
            print(f"jaxgrasp: {path}: cannot be written ({error.strerror or error})", file=sys.stderr)
            failed = True
    return written, failed
