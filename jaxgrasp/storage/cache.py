"""The folder in which the package keeps between runs what it has compiled."""

import os
import stat
from pathlib import Path


def cache_folder(*parts: str) -> Path:
    """A folder of the package's cache, made where it is not there.

    Args:
        parts: Its name below the package's own folder.

    Raises:
        OSError: There is no home, the folder cannot be made, or others could write to it: code is kept in it.
    """
    folder = Path(_base(), "jaxgrasp", *parts)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    own = folder.stat()
    if os.name == "posix" and (own.st_uid != os.getuid() or own.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        raise PermissionError(f"{folder} can be written by others")
    return folder


def _base() -> Path:
    given = os.environ.get("XDG_CACHE_HOME")
    # The standard says that a relative one is to be passed over.
    if given and os.path.isabs(given):
        return Path(given)
    home = os.path.expanduser("~")
    if not os.path.isabs(home):
        raise FileNotFoundError("there is no home folder, and no XDG_CACHE_HOME")
    return Path(home, ".cache")
