"""`jaxgrasp convert`: grasps of any format that is read, in one that is written."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import Skipped, check_new_folder, check_options, check_output
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.setting import Reading
from jaxgrasp.cli.streams import notice, printing
from jaxgrasp.storage import reason_of

_FILES = {"jaxgrasp": (".npz",), "isaac_grasp": (".yaml", ".yml")}
_FOLDERS = ("dexgraspbench", "isaac_grasp")


@dataclass(frozen=True, kw_only=True)
class Convert(Reading):
    """Read grasps in any format and write them in another one.

    What files of docs/grasp_files.md say of joints, bases, objects, scales and stages comes along; what the other
    format has no word for is told in one line. Numbers are the same to float32 at least.
    """

    grasps: tyro.conf.Positional[tuple[Path, ...]]
    """Files, folders and patterns of grasps."""

    to: str
    """jaxgrasp (a file .npz), dexgraspbench (a folder with a file for each grasp), or isaac_grasp (a file .yaml, or a
    folder with one for each object and scale)."""

    output: Path
    """The file, or the new or empty folder, to write."""

    format: str | None = None
    """The format of the grasps; None looks at the content of each file. A wrong name is answered with all names."""

    hand: str | None = None
    """The hand: an MJCF or URDF file, or a name as for rank. It says where links stand that files give poses of, and
    the names and the order of joints."""

    object: str | None = None
    """Name of the object in the files written; without it the name that the files say."""

    scale: float | None = None
    """Factor on the object's lengths; without it the one that the files say."""

    keep_going: bool = False
    """Pass over files that cannot be used, with a line for each; the exit code is 2 then."""

    def run(self) -> int:
        """Reads, writes and prints.

        Returns:
            The exit code: 0, or 2 where a file was passed over.

        Raises:
            CommandError: The options or a file cannot be used, the output cannot be written, or Ctrl-C has ended the
                work early.
        """
        from jaxgrasp.cli.hand_grasps import grasps_of_files
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.files import write_grasps

        self._check()
        skipped = Skipped()
        grasps = grasps_of_files(
            self.grasps,
            self.format,
            hand=self.hand,
            scale=self.scale,
            skipped=skipped if self.keep_going else None,
            option="--format",
        )
        if self.object is not None:
            grasps = replace(grasps, object_name=np.full(len(grasps), self.object))
        done = 0
        try:
            with counting_bar("writing grasps", len(grasps)) as progress:

                def show(count: int) -> None:
                    nonlocal done
                    done = count
                    progress(count)
                    if count < len(grasps):
                        signals.checkpoint()

                lost = write_grasps(grasps, self.output, self.to, hand=self.hand, progress=show)
        except KeyboardInterrupt:
            early = f"{signals.word()}: wrote {done:,} of {len(grasps):,} grasps to {self.output}"
            raise CommandError(early, 130) from None
        except ValueError as error:
            text = str(error)
            raise CommandError(f"--{text}" if text.startswith("hand: ") else text) from error
        except OSError as error:
            raise CommandError(f"--output {self.output}: cannot be written ({reason_of(error)})") from error
        signals.note_written(self.output)
        if lost:
            notice(f"{self.to} cannot say: {'; '.join(lost)}")
        with printing():
            print(f"written: {self.output} ({len(grasps):,} grasps)")
        return skipped.exit_code()

    def _check(self) -> None:
        from jaxgrasp.files import WRITTEN

        plain = self.to.lower().replace("-", "_")
        check_options(
            ("--to", self.to, plain in WRITTEN, f"one of {', '.join(WRITTEN)}"),
            ("--scale", self.scale, self.scale is None or 0.0 < self.scale < math.inf, "a number > 0"),
        )
        if not self.grasps:
            raise CommandError("convert: got no files; wanted grasps to convert")
        endings = _FILES.get(plain, ())
        if self.output.suffix in endings:
            check_output(self.output, "--output", endings, self.grasps)
        elif plain in _FOLDERS:
            check_new_folder(self.output)
        else:
            got = f"the ending {self.output.suffix!r}"
            raise CommandError(f"--output {self.output}: got {got}; wanted {' or '.join(endings)}")
