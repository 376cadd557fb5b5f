"""What files of grasps leave open, and whoever reads them can say."""

from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.files.frames import compose, invert, unit
from jaxgrasp.files.grasp_set import STANDING
from jaxgrasp.storage import FileError

if TYPE_CHECKING:
    from jaxgrasp.hands.hand_frames import HandFrames

WORLD = "world"
"""Name of the world of a hand's file among its links."""
_ASSUMED = "{} is taken to stand in the world of the hand's file, which --hand would look up"


@dataclass(frozen=True, kw_only=True)
class Given:
    """The hand that the grasps are of."""

    hand: str | PathLike | None = None
    """Its file or name; None where nobody has said it."""
    assumed: set[str] = field(default_factory=set)
    """What was taken to be so, since nobody has said which hand it is."""

    @cached_property
    def _frames(self) -> "HandFrames | None":
        if self.hand is None:
            return None
        # What files of grasps hold takes no MuJoCo to read.
        from jaxgrasp.hands.hand_frames import HandFrames

        return HandFrames.of(self.hand)

    def base(self, path: Path, poses: np.ndarray, link: str | None = None) -> np.ndarray:
        """Poses of the frame of the hand file's world, from those of a link.

        Args:
            path: The file, for messages.
            poses: (N, 7) of the link.
            link: The link's name, "world" for the world of the hand's file; None for the hand's first one.

        Returns:
            (N, 7), the same to the last bit where the link stands in that world. Where nobody has said which hand it
            is, it is taken to, as that of every URDF file and of the formats' own hands does.

        Raises:
            FileError: The hand has no such link, or its joints move it.
            ValueError: The hand cannot be read.
        """
        if self._frames is None:
            if link != WORLD:
                self.assumed.add(_ASSUMED.format(link or "the hand's first link"))
            return poses
        try:
            place = self._frames.pose(link)
        except LookupError as error:
            raise FileError(path, "frame of the hand", error.args[0], "a link that no joint moves") from error
        return poses if (place == STANDING).all() else compose(unit(poses), invert(place))

    def has_link(self, link: str) -> bool:
        """Whether the hand has a link of a name; true where nobody has said which hand it is."""
        return self._frames is None or self._frames.has(link)

    def names_by_level(self, path: Path, field: str, count: int) -> tuple[str, ...]:
        """Names of joints that a file has in the order of the tree's levels, as PhysX does.

        Args:
            path: The file, for messages.
            field: Where they are.
            count: How many joints the file has.

        Returns:
            `dof_0`, `dof_1` ... where nobody has said which hand it is.

        Raises:
            FileError: The hand has another number of joints.
        """
        if self._frames is None:
            return tuple(f"dof_{k}" for k in range(count))
        names = self._frames.joints_by_level
        if len(names) != count:
            raise FileError(path, field, f"{count} joints", f"{len(names)}, those of the hand: {', '.join(names)}")
        return names

    def names_in_order(self) -> tuple[str, ...] | None:
        """Names of the hand's joints in the order of its file; None where nobody has said which hand it is."""
        return None if self._frames is None else self._frames.joints
