"""What `jaxgrasp view --export` writes."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli.checks import conclude, write_files
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.streams import printing

if TYPE_CHECKING:
    from jaxgrasp.hands import HandObject
    from jaxgrasp.viewer.browser import Viewed


def export(viewed: "Viewed", hands: "Sequence[HandObject]", count: int, paths: Sequence[Path]) -> None:
    """Writes the first grasps, and says so.

    Args:
        viewed: The grasps.
        hands: The scenes that they are of; the column `scene` says which.
        count: How many of the first are written.
        paths: The files.

    Raises:
        CommandError: There are no configurations to write, or a file cannot be written.
    """
    from jaxgrasp.viewer.browser.exports import write_keyframes, write_shapes

    rows = list(range(min(count, len(viewed))))
    jobs = []
    for path in paths:
        if path.suffix == ".xml":
            names, qpos, controls = _keyframes(viewed, hands, rows, path)
            jobs.append((path, partial(write_keyframes, names=names, qpos=qpos, controls=controls)))
        else:
            jobs.append((path, partial(write_shapes, viewed, rows)))
    written, unwritten = write_files(*jobs)
    if written:
        with printing():
            print(f"written: {', '.join(map(str, written))} ({len(rows):,} grasps)")
    conclude("", unwritten)


def _keyframes(
    viewed: "Viewed", hands: "Sequence[HandObject]", rows: Sequence[int], path: Path
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names, configurations and commands that squeeze, of one scene."""
    from jaxgrasp.ranking import rank

    columns = viewed.candidates.columns
    if not hands:
        raise CommandError(f"--export {path}: got contacts without a hand; wanted --scene or --hand for keyframes")
    scenes = set(columns["scene"][rows].tolist()) if "scene" in columns else {0}
    if len(scenes) > 1:
        raise CommandError(f"--export {path}: got grasps of {len(scenes)} scales; wanted --scale, or fewer with --top")
    hand = hands[scenes.pop()]
    found = rank(
        viewed.candidates.take(np.array(rows)),
        viewed.disturbances,
        cone_edges=viewed.cone_edges,
        share=viewed.share,
        top=len(rows),
    )
    controls = np.tile(hand.model.key_ctrl[0] if hand.model.nkey else np.zeros(hand.model.nu), (len(rows), 1))
    own = np.full((len(rows), len(hand.actuators)), np.nan)
    if found.controls.shape[-1]:
        own[found.order] = found.controls
    controls[:, hand.actuators] = own
    return [f"{place + 1}: {viewed.name(row)}" for place, row in enumerate(rows)], columns["qpos"][rows], controls
