"""What can be found wrong with a command line before any long work, and with its files in the end."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates

from jaxgrasp.cli import signals
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.streams import notice, one_line
from jaxgrasp.storage import check_writable, made_folder, reason_of


class Skipped:
    """Files that were passed over, as the caller wished: each has a line on standard error at once."""

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


def check_output_folder(folder: Path) -> None:
    """Finds out whether files can be written into a folder, and leaves everything as it was: also that it is not there.

    Args:
        folder: That of `--output`.

    Raises:
        CommandError: They cannot.
    """
    try:
        with made_folder(folder):
            check_writable(folder / "0")
    except (OSError, ValueError) as error:
        raise CommandError(f"--output {folder}: cannot be written ({reason_of(error)})") from error


def check_new_folder(folder: Path) -> None:
    """Finds out whether a folder is new or empty, and can be written.

    Args:
        folder: That of `--output`.

    Raises:
        CommandError: It is not, or cannot.
    """
    try:
        if folder.is_dir() and any(folder.iterdir()):
            raise CommandError(f"--output {folder}: got a folder with files in it; wanted a new or empty one")
    except OSError as error:
        raise CommandError(f"--output {folder}: cannot be written ({reason_of(error)})") from error
    check_output_folder(folder)


def warn_of_conventions(candidates: "Candidates") -> None:
    """Notes, in one line, units and directions of contacts that can hardly be meant.

    Args:
        candidates: Grasps by their contacts.
    """
    from jaxgrasp.candidates import doubtful_conventions

    doubts = doubtful_conventions(candidates)
    if doubts:
        notice(f"warning: {' | '.join(doubts)}")


def write_files(*jobs: tuple[Path | None, Callable[[Path], None]]) -> tuple[list[Path], list[str]]:
    """Writes one file after the other; one that cannot be written keeps no other back.

    Args:
        jobs: File, None where it is not wanted, and what writes it.

    Returns:
        The files that were written, and what is wrong with others, a phrase for each reason.

    Raises:
        KeyboardInterrupt: Ctrl-C came while one of them was written, which is whole then.
    """
    written: list[Path] = []
    failed: dict[str, list[str]] = {}
    for path, write in jobs:
        if path is None:
            continue
        signals.checkpoint()
        try:
            write(path)
            written.append(path)
            signals.note_written(path)
        except OSError as error:
            failed.setdefault(str(error.strerror or error), []).append(str(path))
    return written, [f"{', '.join(paths)}: cannot be written ({reason})" for reason, paths in failed.items()]


def conclude(complaint: str, unwritten: Sequence[str], code: int = 130) -> None:
    """Ends a command after all that it could write and print, where something is left to complain about.

    Args:
        complaint: Why the work itself was not finished; empty where it was.
        unwritten: What is wrong with files that could not be written.
        code: The exit code with a complaint.

    Raises:
        CommandError: There is a complaint, or a file that could not be written.
    """
    if complaint or unwritten:
        raise CommandError("; ".join(filter(None, (complaint, *unwritten))), code if complaint else 2)
