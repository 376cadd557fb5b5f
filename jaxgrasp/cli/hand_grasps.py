"""Grasps of files with a hand and an object of one's own: one scene a scale."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli.problems import CommandError, Skipped
from jaxgrasp.cli.streams import notice
from jaxgrasp.storage import FileError

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.cli.scene import GivenScene
    from jaxgrasp.files import GraspSet
    from jaxgrasp.hands import HandObject, Scene

_NOTES = 3


def candidates_of_grasps(
    options: "GivenScene", friction: float | None, max_force: float | None, skipped: Skipped | None = None
) -> "tuple[Candidates, list[HandObject]]":
    """The candidates of all files of grasps, in their order, and the scenes that they are of.

    Args:
        options: The hand, the object and the files.
        friction: Of every contact; None is the models'.
        max_force: Of every contact, N.
        skipped: Told of files that cannot be used; None raises.

    Raises:
        CommandError: A file or the scene cannot be used.
    """
    from jaxgrasp.candidates import concatenate
    from jaxgrasp.cli.report import counting_bar
    from jaxgrasp.ranking.configurations import candidates_of

    assert options.object is not None
    grasps = grasps_of_files(
        options.grasps, options.grasp_format, hand=options.hand, scale=options.scale, skipped=skipped
    )
    hands: list[HandObject] = []
    parts, order = [], []
    with counting_bar("finding contacts", len(grasps)) as progress:
        done = 0
        for scale in np.unique(grasps.object_scale):
            built = options.built(options.object, float(scale), friction)
            rows = np.flatnonzero(grasps.object_scale == scale)
            chosen = grasps.take(rows)
            qpos = configurations(built, chosen)
            # Tables have no names of joints: theirs are in the hand's order.
            chosen = chosen.for_hand(built.joint_names)
            hands.append(options.hand_of(built.model, None, max_force))
            parts.append(
                candidates_of(
                    hands[-1],
                    qpos,
                    source="",
                    limited=options.actuators,
                    columns=_travelling(chosen) | {"scene": np.full(len(rows), len(hands) - 1)},
                    engine=options.engine,
                )
            )
            order.append(rows)
            done += len(rows)
            progress(done)
    found = concatenate(parts).take(np.argsort(np.concatenate(order)))
    files, source, index = _sources(grasps)
    return replace(found, sources=files, source=source, index=index), hands


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


def _travelling(grasps: "GraspSet") -> dict[str, np.ndarray]:
    """The columns that a table has beside its own."""
    from jaxgrasp.files.columns import columns_of_grasps

    table = columns_of_grasps(grasps)
    return {name: column for name, column in table.items() if name != "joint_names"}


def _sources(grasps: "GraspSet") -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Files in the order of their first grasps, and for each grasp the number of its file and its row there."""
    parted = [text.rpartition(":") for text in grasps.source.tolist()]
    number = {file: k for k, file in enumerate(dict.fromkeys(file for file, _, _ in parted))}
    source = np.array([number[file] for file, _, _ in parted])
    return tuple(number), source, np.array([int(row) for _, _, row in parted])
