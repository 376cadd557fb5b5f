"""Files that take the place of older ones only once they are whole and on the disk.

A new file is written beside its target under a name of its own, which is locked for as long as its process lives. Such
files of dead processes are therefore those that can be locked, and the next writer in the same folder removes them.
"""

import contextlib
import errno
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows, where nobody can remove a file that somebody has open.
    fcntl = None

_PREFIX, _SUFFIX = ".jaxgrasp-", ".part"
_unfinished: set[Path] = set()
_made_folders: list[Path] = []


@contextlib.contextmanager
def atomic_write(path: Path | str, *, more_follow: bool = False) -> Iterator[BinaryIO]:
    """Opens a file for writing that replaces an older one at the end of the block, or, after an error, does not.

    A symbolic link stays, and the file that it points to is replaced. The older file's permissions are kept.

    Args:
        path: The file.
        more_follow: Whether other files for the same folder follow: what is done once for the folder (removing what
            dead processes have left, and bringing the new names to the disk) is left to the last of them.

    Yields:
        A stream of bytes.

    Raises:
        OSError: The file cannot be written; an older one is as it was.
    """
    target = _target(path)
    if not more_follow:
        _sweep(target.parent)
    part, descriptor = _begin(target.parent)
    try:
        with contextlib.suppress(OSError):
            os.chmod(part, stat.S_IMODE(target.stat().st_mode))
        # The descriptor stays ours: some libraries close the streams that they write to.
        with open(descriptor, "wb", closefd=False) as stream:
            yield stream
        os.fsync(descriptor)
        os.replace(part, target)
    finally:
        with contextlib.suppress(FileNotFoundError):
            part.unlink()
        os.close(descriptor)
        _unfinished.discard(part)
    if not more_follow:
        _make_lasting(target.parent)


@contextlib.contextmanager
def made_folder(folder: Path | str) -> Iterator[None]:
    """Makes a folder, and those above it; of these, what is still empty at the end of the block is removed.

    Raises:
        OSError: It cannot be made, or there is something else of this name.
    """
    folder = Path(folder)
    made: list[Path] = []
    try:
        for each in reversed([folder, *folder.parents]):
            if each.is_dir():
                continue
            try:
                each.mkdir()
            except FileExistsError:
                # Another process may have made it in between.
                if not each.is_dir():
                    raise
                continue
            made.append(each)
            _made_folders.append(each)
        yield
    finally:
        for each in reversed(made):
            _made_folders.remove(each)
            with contextlib.suppress(OSError):
                each.rmdir()


def check_writable(path: Path | str) -> None:
    """Finds out whether a file can be written, and leaves everything as it was.

    Raises:
        OSError: It cannot.
    """
    # Permissions of the folder say little about read-only, full or remote ones: only a file in it tells.
    part, descriptor = _begin(_target(path).parent)
    part.unlink()
    os.close(descriptor)
    _unfinished.discard(part)


@contextlib.contextmanager
def claimed(path: Path | str) -> Iterator[None]:
    """Keeps other processes from claiming the same file while this block runs; the file is made where it is not there.

    Raises:
        BlockingIOError: Another process has claimed it.
        OSError: It cannot be opened.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
    try:
        if _locked(descriptor) is False:
            raise BlockingIOError(errno.EAGAIN, "another process is at work on it", str(path))
        yield
    finally:
        os.close(descriptor)


def unfinished() -> bool:
    """Whether this process is writing a file now."""
    return bool(_unfinished)


def discard_unfinished() -> None:
    """Removes the files that this process is writing, and empty folders for them: for a process that ends at once."""
    for part in tuple(_unfinished):
        with contextlib.suppress(OSError):
            part.unlink()
    for folder in reversed(_made_folders):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _target(path: Path | str) -> Path:
    target = Path(os.path.realpath(path))
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    if not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    return target


def _begin(folder: Path) -> tuple[Path, int]:
    """A new and locked file in a folder."""
    while True:
        part = folder / f"{_PREFIX}{secrets.token_hex(8)}{_SUFFIX}"
        descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o666)
        _unfinished.add(part)
        # Somebody who swept between the two calls has the lock, or has had it and removed the file.
        if _locked(descriptor) is not False and part.exists():
            return part, descriptor
        os.close(descriptor)
        _unfinished.discard(part)


def _sweep(folder: Path) -> None:
    """Removes what dead processes have left unfinished in a folder."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if not (entry.name.startswith(_PREFIX) and entry.name.endswith(_SUFFIX)):
                continue
            with contextlib.suppress(OSError):
                descriptor = os.open(entry.path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
                try:
                    if _locked(descriptor):
                        os.unlink(entry.path)
                finally:
                    os.close(descriptor)


def _locked(descriptor: int) -> bool | None:
    """Locks a file; False where another process has, None where the file system knows no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _make_lasting(folder: Path) -> None:
    """The file's new name is on the disk, too; what the file system cannot do is left undone."""
    if os.name != "posix":
        return
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
