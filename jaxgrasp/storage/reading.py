"""Files that nobody vouches for: opened only where they are regular ones, and read only as far as a budget goes."""

import contextlib
import contextvars
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

# Archives of zeros shrink a thousandfold; grasps, hardly at all. Small members, such as a constant column of a million
# candidates, may shrink as they like.
_INFLATION, _SMALL = 100, 256 << 20
# A million candidates with eight contacts and their frames take 0.9 GiB.
_allowance = contextvars.ContextVar("allowance", default=2 << 30)


class FileError(ValueError):
    """A file cannot be used. The message is one line: file, field, what came, what is wanted."""

    def __init__(self, file: Path | str, field: str | None, got: str, wanted: str):
        """Makes the line.

        Args:
            file: The file that was read.
            field: The part of it in question; None where it is the file as a whole.
            got: What came.
            wanted: What is wanted.
        """
        self._given = file, field, got, wanted
        place = f"{file}: {field}" if field else str(file)
        super().__init__(printable(" ".join(f"{place}: got {got}; wanted {wanted}".split())))

    def __reduce__(self) -> tuple[type["FileError"], tuple[Path | str, str | None, str, str]]:
        """Takes it apart, so that it can go from one process to another."""
        return FileError, self._given


def printable(text: object) -> str:
    """Text in which what no line of text may have (line ends, control characters, surrogates) is written as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


@contextlib.contextmanager
def limited_to(size: int) -> Iterator[None]:
    """Sets how many bytes one file, and what is made of it in memory, may have inside this block."""
    token = _allowance.set(size)
    try:
        yield
    finally:
        _allowance.reset(token)


def allowance() -> int:
    """How many bytes one file, and what is made of it in memory, may have; 2 GiB if nothing else is set."""
    return _allowance.get()


@contextlib.contextmanager
def open_regular(path: Path | str, wanted: str = "a regular file", cost: int = 1) -> Iterator[BinaryIO]:
    """Opens a file for reading: a regular one, which has an end and keeps nobody waiting.

    Args:
        path: The file.
        wanted: What the file should be, for the message.
        cost: Bytes of memory that a byte of the file takes once it is read.

    Yields:
        A stream of bytes.

    Raises:
        FileError: The file is absent or unreadable, a folder, a device, a pipe or a socket, or above the budget.
    """
    try:
        # A pipe that nobody writes to must not keep us waiting, nor a terminal become ours.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)
        _check(path, os.stat(path), wanted, cost)
        stream = open(os.open(path, flags), "rb")
    except (OSError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, None, reason_of(error), wanted) from error
    with stream:
        # The name may have come to mean another file since.
        _check(path, os.fstat(stream.fileno()), wanted, cost)
        try:
            yield stream
        except OSError as error:
            raise FileError(path, None, reason_of(error), wanted) from error


def reason_of(error: BaseException) -> str:
    """What an error says, in a few words."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error) or type(error).__name__


def _check(path: Path | str, found: os.stat_result, wanted: str, cost: int) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise FileError(path, None, _KINDS.get(stat.S_IFMT(found.st_mode), "no regular file"), wanted)
    if cost * found.st_size > allowance():
        limit = f"at most {in_bytes(allowance() / cost)} (see --read-limit)"
        raise FileError(path, None, f"a file of {in_bytes(found.st_size)}", limit)


_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def in_bytes(size: float) -> str:
    """A number of bytes with a unit that suits it."""
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if size < 1024:
            return f"{size:.3g} {unit}"
        size /= 1024
    return f"{size:.3g} TiB"


def check_inflation(path: Path | str, field: str | None, stored: int, inflated: int, remedy: str = "") -> None:
    """Refuses what would inflate to more than 256 MiB and a hundredfold: grasps hardly shrink.

    Args:
        path: The file.
        field: The largest part of it; None where none is named.
        stored: Bytes on the disk.
        inflated: Bytes in memory.
        remedy: Who writes such files otherwise.

    Raises:
        FileError: It would.
    """
    if inflated > max(_SMALL, _INFLATION * stored):
        got = f"{in_bytes(stored)} that inflate to {in_bytes(inflated)}"
        raise FileError(path, field, got, f"at most {_INFLATION} times as much{remedy}")
