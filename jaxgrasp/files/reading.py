"""Files of grasps in, one set of grasps out: the format is looked up by the content of each file."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from jaxgrasp.files.content import read_content
from jaxgrasp.files.formats import format_of, named
from jaxgrasp.files.given import Given
from jaxgrasp.files.grasp_set import GraspSet, concatenate, in_order_of
from jaxgrasp.files.paths import grasp_files
from jaxgrasp.storage import FileError


def read_grasps(
    paths: str | PathLike | Sequence[str | PathLike],
    format: str | None = None,
    *,
    hand: str | PathLike | None = None,
    skipped: Callable[[FileError], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> GraspSet:
    """Reads grasps of files in any of the formats that are known; nothing in a file is ever run.

    Args:
        paths: Files, folders and patterns, see `paths.grasp_files`.
        format: One of `FORMATS`; None looks at the content of each file.
        hand: The hand's file or name, for formats that tell poses of a link of it, or joints without names.
        skipped: Called with what is wrong with a file, which is then passed over; None raises it.
        progress: Called after each file with how many are done, and how many there are.

    Returns:
        The grasps of all files, in their order; `notes` has what was assumed where files do not say it.

    Raises:
        FileError: A file cannot be used, or the files do not go together, or there is none.
        ValueError: The format is unknown, or the hand cannot be read.
    """
    chosen = None if format is None else named(format)
    given = Given(hand=hand)
    words = [paths] if isinstance(paths, str | PathLike) else list(paths)
    parts: list[GraspSet] = []
    files = grasp_files(map(Path, words))
    for number, path in enumerate(files):
        try:
            content = read_content(path)
            part = (chosen or format_of(content)).read(content, given)
            _check_scales(path, part)
            parts, part = _named_alike(parts, part, given)
            parts.append(in_order_of(parts[0], part) if parts else part)
        except FileError as error:
            if skipped is None:
                raise
            skipped(error)
        if progress is not None:
            progress(number + 1, len(files))
    if not parts:
        raise FileError(", ".join(map(str, words)) or "grasps", None, "no grasps at all", "files of grasps")
    found = concatenate(parts)
    return replace(found, notes=(*found.notes, *sorted(given.assumed)))


def _check_scales(path: Path, part: GraspSet) -> None:
    """Refuses scales with which there is no object; those that a file does not say are no numbers."""
    wrong = np.flatnonzero((part.object_scale <= 0) | np.isinf(part.object_scale))
    if len(wrong):
        raise FileError(path, "object_scale", f"{part.object_scale[wrong[0]]:g} in row {wrong[0]}", "a number above 0")


def _named_alike(parts: list[GraspSet], part: GraspSet, given: Given) -> tuple[list[GraspSet], GraspSet]:
    """Names joints by the hand, where there is one, in files without names that lie beside files with names."""
    names = None
    if parts and (parts[0].joint_names is None) != (part.joint_names is None):
        names = given.names_in_order()
    if names is None:
        return parts, part
    if part.joint_names is None:
        return parts, part.for_hand(names)
    return [other.for_hand(names) for other in parts], part.for_hand(names)
