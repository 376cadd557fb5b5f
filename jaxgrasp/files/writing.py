"""Grasps to files."""

import zipfile
from collections.abc import Callable
from os import PathLike
from pathlib import Path

import numpy as np

from jaxgrasp.files import dexgraspbench, isaac_grasp, isaac_writer, own
from jaxgrasp.files.columns import columns_of_grasps
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet
from jaxgrasp.storage import atomic_write


def write_grasps(
    grasps: GraspSet,
    path: str | PathLike,
    format: str = own.NAME,
    *,
    hand: str | PathLike | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> list[str]:
    """Writes grasps, each file in place of an older one only once it is whole.

    Args:
        grasps: The grasps.
        path: "jaxgrasp": a file `.npz`. "dexgraspbench": a folder, in which each grasp has a file. "isaac_grasp": a
            file `.yaml` for grasps of one object and scale, or a folder, in which each object and scale has one.
        format: One of `WRITTEN`.
        hand: The hand's file or name, for the names and the order of joints; None keeps those of the grasps.
        progress: Called with how many grasps are written.

    Returns:
        What the format cannot say, a phrase each; nothing where all of it came along.

    Raises:
        ValueError: The format is unknown, or cannot hold these grasps, or the hand has other joints.
        OSError: A file cannot be written.
    """
    plain = format.lower().replace("-", "_")
    if plain not in _WRITERS:
        raise ValueError(f"format: got {format!r}, wanted one of {', '.join(WRITTEN)}")
    if plain != own.NAME:
        # What others have no word for is asked for.
        grasps = grasps.with_scale(None)
    names = Given(hand=hand).names_in_order()
    if names is not None:
        grasps = grasps.for_hand(names)
        if plain == dexgraspbench.NAME:
            if missing := [name for name in names if name not in (grasps.joint_names or ())]:
                raise ValueError(f"hand: got a joint {missing[0]!r} that the grasps do not have, wanted that of these")
            # Its columns are in the order of the hand's file and have no names.
            grasps = grasps.unnamed()
    return _WRITERS[plain](grasps, Path(path), progress)


def _write_own(grasps: GraspSet, path: Path, progress: Callable[[int], None]) -> list[str]:
    # numpy.savez takes the columns as keyword arguments and trips over one that is called 'file'.
    with atomic_write(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name, column in columns_of_grasps(grasps).items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(column), allow_pickle=False)
    progress(len(grasps))
    return []


_WRITERS = {own.NAME: _write_own, dexgraspbench.NAME: dexgraspbench.write, isaac_grasp.NAME: isaac_writer.write}
WRITTEN = tuple(_WRITERS)
"""Names of the formats that are written."""
