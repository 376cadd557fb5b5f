"""Which files a word on the command line means: a file, all files of a folder, or those that a pattern fits."""

import glob
import os
from collections.abc import Iterable
from pathlib import Path

from jaxgrasp.storage import FileError

ENDINGS = (".npy", ".npz", ".pkl", ".pickle", ".pt", ".pth", ".yaml", ".yml", ".json", ".h5", ".hdf5", ".xml")
ENDINGS += (".parquet", ".csv")
"""Of the files that are looked for in folders."""


def grasp_files(paths: Iterable[Path | str], endings: tuple[str, ...] = ENDINGS) -> list[Path]:
    """Files, folders and patterns as files.

    Args:
        paths: Files as they are; folders stand for the files in them and below with one of the endings, in the order of
            their names; patterns (`*`, `?`, `[...]`, `**`) for what they fit.
        endings: Of the files that are looked for in folders.

    Returns:
        The files, in the order of `paths`.

    Raises:
        FileError: A folder or a pattern has no such file.
    """
    found: list[Path] = []
    for given in paths:
        path = Path(given)
        if path.is_dir():
            found += _below(path, endings)
        elif os.path.lexists(path) or not glob.has_magic(str(given)):
            found.append(path)
        else:
            found += _fitting(str(given), endings)
    return found


def _below(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    inside = []
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        inside += [
            Path(root, name) for name in sorted(files) if not name.startswith(".") and name.lower().endswith(endings)
        ]
    if not inside:
        raise FileError(folder, None, "a folder without files of grasps", f"some with {', '.join(endings)}")
    return inside


def _fitting(pattern: str, endings: tuple[str, ...]) -> list[Path]:
    fitting = [Path(name) for name in sorted(glob.glob(pattern, recursive=True))]
    if not fitting:
        raise FileError(pattern, None, "a pattern that no file fits", "files of grasps")
    return [file for path in fitting for file in (_below(path, endings) if path.is_dir() else [path])]
