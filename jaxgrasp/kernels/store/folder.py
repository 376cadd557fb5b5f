"""The folder in which compiled kernels are kept."""

import hashlib

from jaxgrasp.storage import FileError, atomic_write, cache_folder, open_regular


def read(key: str) -> bytes | None:
    """Read what is kept under a key; None unless it is whole and only this user could have written it."""
    try:
        with open_regular(cache_folder("kernels") / key) as stream:
            content = stream.read()
    except (OSError, FileError):
        return None
    digest, rest = content[:32], content[32:]
    return rest if _digest(key, rest) == digest else None


def keep(key: str, content: bytes) -> None:
    """Keep content, such as object code, under a key.

    Raises:
        OSError: the folder cannot be written, or others could write to it.
    """
    with atomic_write(cache_folder("kernels") / key) as file:
        file.write(_digest(key, content) + content)


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\n" + content).digest()
