"""Pickles for the users of NumPy: dicts, text, numbers and arrays, as `numpy.save` writes them, and nothing else."""

from pathlib import Path

import numpy as np

from jaxgrasp.storage import atomic_write


def write_pickled(path: Path, table: dict[str, object], *, more_follow: bool = False) -> None:
    """Writes a dict as `numpy.save` does: a pickle in an array without axes.

    Args:
        path: The file.
        table: Numbers, truth values, text and arrays of them by name.
        more_follow: As for `storage.atomic_write`.

    Raises:
        OSError: The file cannot be written.
    """
    boxed = np.empty((), object)
    boxed[()] = table
    with atomic_write(path, more_follow=more_follow) as stream:
        np.lib.format.write_array(stream, boxed, allow_pickle=True)
