"""The options by which subcommands take grasps of files with a hand and objects of one's own."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from jaxgrasp.cli.checks import Skipped, check_options
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.setting import Reading

if TYPE_CHECKING:
    from jaxgrasp.files import GraspSet


@dataclass(frozen=True, kw_only=True)
class Published(Reading):
    """Grasps, and the hand and the objects that they are of."""

    hand: str = ""
    """The hand: an MJCF or URDF file, shadow_hand or four_fingers, FOLDER/FILE of a local copy of mujoco_menagerie, or
    an entry of robot_descriptions that was downloaded before."""

    object: tuple[str, ...] = ()
    """The object: a folder of convex pieces, a mesh, an MJCF or URDF file, or sphere, capsule, box, cylinder or
    ellipsoid, 1 m wide along x. Several are told apart by their folders' or files' names, which the grasps name, or
    their files or folders bear."""

    grasps: tuple[Path, ...] = ()
    """Files, folders and patterns of grasps in any format that is known."""

    grasp_format: str | None = None
    """The format of --grasps; None looks at the content of each file. A wrong name is answered with all names."""

    scale: float | None = None
    """Factor on the objects' lengths; without it the one that each grasp says."""

    servo_gain: float | None = None
    """Give joints without an actuator, and motors, position servos of this many N m/rad, and joints without damping,
    armature or dry friction some of each."""

    keep_going: bool = False
    """Pass over files and objects that cannot be used, with a line for each, and exit with 2 in the end."""

    @property
    def name(self) -> str:
        """Name of the hand, for messages."""
        return self.hand

    @property
    def inputs(self) -> list[Path]:
        """Files that must not be overwritten."""
        return [Path(self.hand), *map(Path, self.object), *self.grasps]

    def check_published(self) -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        check_options(
            ("--hand", "none", bool(self.hand), "an MJCF or URDF file, or a name"),
            ("--object", "none", bool(self.object), "at least one"),
            ("--grasps", "none", bool(self.grasps), "files of grasps"),
            ("--scale", self.scale, self.scale is None or 0.0 < self.scale < math.inf, "a number > 0"),
            (
                "--servo-gain",
                self.servo_gain,
                self.servo_gain is None or 0.0 < self.servo_gain < math.inf,
                "N m/rad > 0",
            ),
        )

    def grasp_set(self, skipped: Skipped) -> "GraspSet":
        """Reads the grasps.

        Args:
            skipped: Told of files that cannot be used, with --keep-going.

        Raises:
            CommandError: A file cannot be used.
        """
        from jaxgrasp.cli.hand_grasps import grasps_of_files
        from jaxgrasp.files.objects import name_of_object

        names = [name_of_object(each) for each in self.object]
        for name in names:
            if names.count(name) > 1:
                raise CommandError(f"--object: got two that are called {name!r}; wanted different names")
        return grasps_of_files(
            self.grasps,
            self.grasp_format,
            hand=self.hand,
            scale=self.scale,
            skipped=skipped if self.keep_going else None,
        )


@contextlib.contextmanager
def one_line_error(options: Published) -> Iterator[None]:
    """Turns what a library finds wrong with hand, object or grasps into the line of a command."""
    from jaxgrasp.storage import FileError

    try:
        yield
    except FileError as error:
        raise CommandError(str(error)) from error
    except ValueError as error:
        text = " ".join(str(error).split())
        known = text.startswith(("hand:", "object:", "servo gain:"))
        text = text.replace("servo gain:", "servo-gain:", 1) if known else text
        raise CommandError(f"--{text}" if known else f"{options.name}: {text}") from error
