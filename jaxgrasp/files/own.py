"""Our own files: `.npz`, Parquet, CSV and HDF5 with the columns of `columns`."""

import re
from typing import Any

from jaxgrasp.files.columns import STAGE, grasps_of_columns
from jaxgrasp.files.content import Content
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GRASP, GraspSet

NAME = "jaxgrasp"


def recognises(content: Content) -> bool:
    """Whether the content is of this format."""
    return content.kind in ("arrays", "hdf5", "table") and GRASP + STAGE in content.table


def read(content: Content, given: Given) -> GraspSet:
    """Reads all grasps of a file.

    Raises:
        FileError: A field cannot be used.
    """
    table = dict(content.table)
    names: Any = table.get("joint_names")
    if content.kind == "table" and getattr(names, "ndim", 0) in (1, 2):
        # A table has a row for every grasp: the same names in each.
        names = names[0] if names.ndim == 2 else re.split(r"\s*;\s*|\s+", names[0])
        table["joint_names"] = list(map(str, names))
    return grasps_of_columns(content.path, table)
