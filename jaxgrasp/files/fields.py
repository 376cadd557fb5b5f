"""Parts of files that must be there, in the shapes that their formats give them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxgrasp.files.columns import numbers, text_array
from jaxgrasp.files.grasp_set import GRASP, HandPoses
from jaxgrasp.storage import FileError, printable


def part(path: Path, table: object, field: str, kind: type | tuple[type, ...] = dict, where: str = "") -> Any:
    """An entry of a dict.

    Args:
        path: The file, for messages.
        table: What should be the dict.
        field: The entry's name.
        kind: What it should be.
        where: What lies above it, for messages.

    Raises:
        FileError: It is not there, or is something else.
    """
    name = f"{where}{field}"
    kinds = kind if isinstance(kind, tuple) else (kind,)
    wanted = " or ".join(dict.fromkeys(_WORDS.get(each, each.__name__) for each in kinds))
    if not isinstance(table, Mapping) or field not in table:
        there = ", ".join(printable(key) for key in list(table)[:20]) if isinstance(table, Mapping) else "no fields"
        raise FileError(path, name, f"nothing of this name (there is {there or 'nothing'})", wanted)
    value = table[field]
    if not isinstance(value, kinds):
        raise FileError(path, name, f"{_WORDS.get(type(value), type(value).__name__)}", wanted)
    return value


def array(path: Path, table: object, field: str, shape: Sequence[int | None], where: str = "") -> np.ndarray:
    """Numbers of some shape.

    Args:
        path: The file, for messages.
        table: The dict that has them.
        field: Their name.
        shape: Lengths of the axes; None for any.
        where: What lies above them, for messages.

    Returns:
        float64.

    Raises:
        FileError: They are not there, or of another shape.
    """
    value = part(path, table, field, (np.ndarray, list, tuple, int, float, np.generic), where)
    found = numbers(path, f"{where}{field}", value)
    fits = len(found.shape) == len(shape) and all(b in (None, a) for a, b in zip(found.shape, shape, strict=True))
    if not fits:
        wanted = ", ".join("N" if size is None else str(size) for size in shape)
        raise FileError(path, f"{where}{field}", f"shape {found.shape}", f"({wanted})")
    return found


def single_stage(base: np.ndarray, joints: np.ndarray) -> dict[str, HandPoses]:
    """The stages of a format that has the grasp alone."""
    return {GRASP: HandPoses(base, joints)}


def checked_joints(path: Path, field: str, names: Sequence[object]) -> tuple[str, ...]:
    """Names of joints as a file lists them.

    Raises:
        FileError: There is none, too many, or one is no text.
    """
    if not 0 < len(names) <= _JOINTS or not all(isinstance(name, str) for name in names):
        raise FileError(path, field, f"{len(names)} names of joints", f"text, 1 to {_JOINTS} of them")
    return tuple(text_array(path, field, [printable(name) for name in names]).tolist())


def stacked(path: Path, field: str, rows: Sequence[Mapping[str, object]], names: Sequence[str]) -> np.ndarray:
    """Values (N, n) of dicts that all have the same keys.

    Raises:
        FileError: A dict has other keys, or something that is no number.
    """
    keys = set(names)
    for number, row in enumerate(rows):
        if not isinstance(row, Mapping) or set(row) != keys:
            odd = sorted(map(str, keys ^ set(row)))[:3] if isinstance(row, Mapping) else ["no dict"]
            raise FileError(
                path, f"{field} of grasp {number}", f"other joints than grasp 0 ({', '.join(odd)})", "equal"
            )
    table = numbers(path, field, [[row[name] for name in names] for row in rows])
    return table.reshape(len(rows), len(names))


_JOINTS = 1_000
_WORDS = {
    dict: "a dict",
    list: "a list",
    tuple: "a tuple",
    str: "text",
    np.ndarray: "an array",
    int: "a number",
    float: "a number",
    np.generic: "a number",
    type(None): "nothing",
}
