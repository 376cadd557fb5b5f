"""Grasps to files."""

from os import PathLike

import numpy as np

from jaxgrasp.files.columns import columns_of_grasps
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.storage import atomic_write

WRITTEN = ("jaxgrasp",)
"""Names of the formats that are written."""


def write_grasps(grasps: GraspSet, path: str | PathLike, format: str = "jaxgrasp") -> None:
    """Writes grasps, in place of older files only once they are whole.

    Args:
        grasps: The grasps.
        path: The file.
        format: One of `WRITTEN`.

    Raises:
        ValueError: The format is unknown.
        OSError: The file cannot be written.
    """
    if format not in WRITTEN:
        raise ValueError(f"format: got {format!r}, wanted one of {', '.join(WRITTEN)}")
    with atomic_write(path) as stream:
        _write_columns(stream, columns_of_grasps(grasps))


def _write_columns(stream, table: dict[str, np.ndarray]) -> None:
    import zipfile

    # numpy.savez takes the columns as keyword arguments and trips over one that is called 'file'.
    with zipfile.ZipFile(stream, "w") as archive:
        for name, column in table.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(column), allow_pickle=False)
