"""NumPy archives that nobody vouches for: every way they can be broken is one line of text."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

# What zipfile, zlib and numpy raise for damaged, encrypted, oddly compressed or pickled members.
_BROKEN = (ValueError, KeyError, EOFError, OSError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)


class CandidateError(ValueError):
    """A file of candidates cannot be used. The message is one line: file, field, what came, what is wanted."""

    def __init__(self, file: Path | str, field: str | None, got: str, wanted: str):
        """Makes the line.

        Args:
            file: The file that was read.
            field: The column in question; None where it is the file as a whole.
            got: What came.
            wanted: What is wanted.
        """
        place = f"{file}: {field}" if field else str(file)
        super().__init__(" ".join(f"{place}: got {got}; wanted {wanted}".split()))


def read_archive(path: Path) -> dict[str, np.ndarray]:
    """Reads every array of an `.npz` file; objects are never unpickled.

    Args:
        path: The file.

    Returns:
        The arrays by name, in the file's order.

    Raises:
        CandidateError: The file is absent, unreadable, not an archive, truncated, damaged, or has an array of objects.
    """
    _check_archive(path)
    arrays: dict[str, np.ndarray] = {}
    field = None
    try:
        # A stream of our own: NumPy leaves the file open where the archive's directory is damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            for field in archive.files:
                arrays[field] = _array(path, field, archive[field])
    except CandidateError:
        raise
    except _BROKEN as error:
        wanted = "an intact .npz file"
        if "allow_pickle" in str(error):
            raise CandidateError(path, field, "Python objects, which are never unpickled", "a plain array") from error
        raise CandidateError(path, field, f"damaged data ({_reason(error)})", wanted) from error
    return arrays


def read_array(path: Path) -> np.ndarray:
    """Reads the one array of an `.npy` file; objects are never unpickled.

    Args:
        path: The file.

    Returns:
        The array.

    Raises:
        CandidateError: The file is absent, unreadable, of another kind, truncated, or has an array of objects.
    """
    try:
        with path.open("rb") as stream:
            return _array(path, None, np.lib.format.read_array(stream, allow_pickle=False))
    except CandidateError:
        raise
    except _BROKEN as error:
        raise CandidateError(path, None, _reason(error), "an intact .npy file of plain numbers") from error


def _check_archive(path: Path) -> None:
    wanted = "an .npz file of candidates (numpy.savez)"
    try:
        with path.open("rb") as stream:
            magic = stream.read(6)
            complete = zipfile.is_zipfile(stream)
    except OSError as error:
        raise CandidateError(path, None, _reason(error), wanted) from error
    if complete:
        return
    if magic.startswith(b"PK\x03\x04"):
        raise CandidateError(path, None, "a truncated .npz file", "the whole of it")
    kind = {b"": "an empty file", b"\x93NUMPY": "a single .npy array"}.get(magic, "a file of another kind")
    raise CandidateError(path, None, kind, wanted)


def _array(path: Path, field: str | None, value: object) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        raise CandidateError(path, field, "a member that is no array", "arrays only")
    return value


def _reason(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return str(error) or type(error).__name__
