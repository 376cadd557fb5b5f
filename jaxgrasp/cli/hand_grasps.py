"""Grasps of files with a hand and an object of one's own: one scene a scale."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli.checks import Skipped
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.streams import notice
from jaxgrasp.storage import FileError

if TYPE_CHECKING:
    from jaxgrasp.files import GraspSet
    from jaxgrasp.hands import Scene

_NOTES = 3


def grasps_of_files(
    paths: Sequence[Path],
    format: str | None = None,
    *,
    hand: str | None = None,
    scale: float | None = None,
    skipped: Skipped | None = None,
    option: str = "--grasp-format",
) -> "GraspSet":
    """Reads grasps of files in any format that is known, with a bar.

    Args:
        paths: Files, folders and patterns.
        format: The format of all of them; None looks at the content.
        hand: The hand's file or name.
        scale: Of the object; None is the files' own.
        skipped: Told of files that cannot be used, which are then passed over; None raises what is wrong with the
            first one.
        option: The option that says the format.

    Raises:
        CommandError: A file cannot be used.
    """
    from jaxgrasp.cli.report import counting_bar
    from jaxgrasp.files import read_grasps

    try:
        with counting_bar("reading grasps", len(paths)) as progress:
            found = read_grasps(paths, format, hand=hand, skipped=skipped, progress=progress)
        _tell(found.notes)
        return found.with_scale(scale)
    except ValueError as error:
        text = str(error)
        raise CommandError(f"{option}: {text[8:]}" if text.startswith("format: ") else _as_option(text)) from error


def configurations(built: "Scene", grasps: "GraspSet", stage: str = "grasp") -> np.ndarray:
    """Configurations (N, nq) of a scene.

    Args:
        built: A scene of the grasps' hand, and of the object in their scale.
        grasps: The grasps.
        stage: Which of their stages.

    Raises:
        CommandError: The hand has other joints.
    """
    from jaxgrasp.files.objects import configurations

    try:
        return configurations(built, grasps, stage)
    except FileError as error:
        raise CommandError(str(error)) from error


def _tell(notes: Sequence[str]) -> None:
    """Notes the first few."""
    for note in notes[:_NOTES]:
        notice(note)
    if len(notes) > _NOTES:
        notice(f"... and {len(notes) - _NOTES:,} more like these")


def _as_option(text: str) -> str:
    """Puts the option `--hand` in front of a message about the hand."""
    return f"--{text}" if text.startswith("hand: ") else text


def travelling_columns(grasps: "GraspSet") -> dict[str, np.ndarray]:
    """The columns that a table has beside its own."""
    from jaxgrasp.files.columns import columns_of_grasps

    table = columns_of_grasps(grasps)
    return {name: column for name, column in table.items() if name != "joint_names"}


def sources_of(grasps: "GraspSet") -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Files in the order of their first grasps, and for each grasp the number of its file and its row there."""
    parted = [text.rpartition(":") for text in grasps.source.tolist()]
    number = {file: k for k, file in enumerate(dict.fromkeys(file for file, _, _ in parted))}
    source = np.array([number[file] for file, _, _ in parted])
    return tuple(number), source, np.array([int(row) for _, _, row in parted])
