"""Files of grasps in, one set of grasps out: the format is looked up by the content of each file."""

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path

from jaxgrasp.files.columns import grasps_of_columns
from jaxgrasp.files.grasp_set import GraspSet, concatenate, in_order_of
from jaxgrasp.files.paths import grasp_files
from jaxgrasp.storage import FileError, read_archive

FORMATS = ("jaxgrasp",)
"""Names of the formats that are read."""


def read_grasps(
    paths: str | PathLike | Sequence[str | PathLike],
    format: str | None = None,
    *,
    skipped: Callable[[FileError], None] | None = None,
) -> GraspSet:
    """Reads grasps of files in any of the formats that are known; nothing in a file is ever run.

    Args:
        paths: Files, folders and patterns, see `paths.grasp_files`.
        format: One of `FORMATS`; None looks at the content of each file.
        skipped: Called with what is wrong with a file, which is then passed over; None raises it.

    Returns:
        The grasps of all files, in their order.

    Raises:
        FileError: A file cannot be used, or the files do not go together, or there is none.
        ValueError: The format is unknown.
    """
    if format is not None and format not in FORMATS:
        raise ValueError(f"format: got {format!r}, wanted one of {', '.join(FORMATS)}")
    given = [paths] if isinstance(paths, str | PathLike) else list(paths)
    parts: list[GraspSet] = []
    for path in grasp_files(map(Path, given)):
        try:
            part = grasps_of_columns(path, read_archive(path))
            parts.append(in_order_of(parts[0], part) if parts else part)
        except FileError as error:
            if skipped is None:
                raise
            skipped(error)
    if not parts:
        raise FileError(", ".join(map(str, given)) or "grasps", None, "no grasps at all", "files of grasps")
    return concatenate(parts)
