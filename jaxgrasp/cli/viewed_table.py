"""Tables of `jaxgrasp rank`, which say of each grasp where it came from, and the grasps that they are of."""

from pathlib import Path

import numpy as np

from jaxgrasp.candidates import Candidates
from jaxgrasp.files.content import read_content
from jaxgrasp.storage import FileError, open_archive

# What a table of a ranking has for every grasp.
_KEYS = ("rank", "source", "index", "margin")
_WANTED = f"a table of jaxgrasp rank, with {', '.join(_KEYS)}"


def is_table(path: Path) -> bool:
    """Whether a file is a table of a ranking, and not one of candidates.

    Raises:
        FileError: It cannot be read.
    """
    if path.suffix != ".npz":
        return True
    with open_archive(path) as archive:
        return "positions" not in archive.headers and all(name in archive.headers for name in _KEYS)


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Reads a table of a ranking.

    Returns:
        Its columns by name.

    Raises:
        FileError: It is no such table.
    """
    columns = {name: np.asarray(value) for name, value in read_content(path).table.items()}
    missing = [name for name in _KEYS if name not in columns]
    if missing:
        raise FileError(path, missing[0], "no such column", _WANTED)
    count = columns["rank"].size
    for name, column in columns.items():
        if column.ndim == 0 or len(column) != count:
            raise FileError(path, name, f"shape {column.shape}", f"({count}, ...)")
    for name in _KEYS:
        kinds = "U" if name == "source" else "iu" if name == "index" else "iuf"
        if columns[name].ndim != 1 or columns[name].dtype.kind not in kinds:
            raise FileError(path, name, f"{columns[name].dtype} {columns[name].shape}", _WANTED)
    if not count:
        raise FileError(path, None, "no rows", _WANTED)
    return columns


def source_of(table: Path, name: str) -> Path | None:
    """Where a file that a table names is: where it was, or beside the table; None where it is not there."""
    return next((path for path in (Path(name), table.parent / Path(name).name) if path.is_file()), None)


def joined(
    table: dict[str, np.ndarray], candidates: Candidates, path: Path
) -> tuple[Candidates, dict[str, np.ndarray]]:
    """The candidates that a table has, in its order, and its rows that there are candidates of.

    Args:
        table: Of `read_table`.
        candidates: With the table's sources among theirs.
        path: Of the table, for messages.

    Raises:
        FileError: No row has a candidate.
    """
    sources = [candidates.sources[source] for source in candidates.source.tolist()]
    number = {key: row for row, key in enumerate(zip(sources, candidates.index.tolist(), strict=True))}
    wanted = zip(table["source"].tolist(), table["index"].tolist(), strict=True)
    rows = np.array([number.get(key, -1) for key in wanted])
    if (rows < 0).all():
        raise FileError(path, "source", f"rows of {table['source'][0]}", f"rows of {candidates.sources[0]}")
    return candidates.take(rows[rows >= 0]), {key: column[rows >= 0] for key, column in table.items()}
