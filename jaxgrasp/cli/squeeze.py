"""`jaxgrasp squeeze`: grasps of files in, the same grasps with squeezes out."""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import Skipped, check_options, check_output, check_output_folder, conclude, write_files
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.published import Published, one_line_error
from jaxgrasp.cli.setting import configure_jax
from jaxgrasp.cli.streams import notice, printing
from jaxgrasp.storage import made_folder

if TYPE_CHECKING:
    from jaxgrasp.files import GraspSet

_PLAIN_WIDTH = 120
_NPZ = ".npz"


@dataclass(frozen=True, kw_only=True)
class Squeeze(Published):
    """Give grasps of files squeezes: joint targets that close the gap and then press with the forces of (22).

    Reads grasps in any format that is known, and writes the same grasps with the stage `squeeze`, the margin, the
    forces, the joints' torques and the actuators' commands beside it. Squeezes that the files have are replaced. See
    docs/evaluation.md.
    """

    mass: float = 0.1
    """Of the object, kg."""

    friction: float = 0.6
    """Coulomb's coefficient of every contact."""

    max_force: float = 10.0
    """Normal force of the most loaded contact, N."""

    contact_distance: float = 5e-3
    """Links nearer to the object are contacts, m."""

    output: Path = Path("squeezed")
    """A folder, which gets OBJECT.npz, or another format's OBJECT, for each object; or one file, .npz, for all."""

    format: str = "jaxgrasp"
    """How to write them, jaxgrasp or a format of `jaxgrasp convert`. A wrong name is answered with all names."""

    def run(self) -> int:
        """Squeezes, writes and prints.

        Returns:
            The exit code: 0, or 2 where a file or an object was passed over.

        Raises:
            CommandError: The options, the files or the hand cannot be used, a file could not be written in the end, or
                Ctrl-C has ended the work early.
        """
        self._check()
        configure_jax()
        from jaxgrasp.cli.report import stoppable_bar
        from jaxgrasp.hands.servos import prepared_hand
        from jaxgrasp.squeezing import squeeze_grasps

        skipped = Skipped()
        grasps = self.grasp_set(skipped)
        with one_line_error(self):
            hand, said = prepared_hand(self.hand, self.servo_gain)
        for line in said:
            notice(line)
        with one_line_error(self), stoppable_bar("squeezing grasps", len(grasps)) as progress:
            squeezed = squeeze_grasps(
                grasps,
                hand=hand,
                object=self.object,
                mass=self.mass,
                friction=self.friction,
                max_force=self.max_force,
                contact_distance=self.contact_distance,
                progress=progress,
                skipped=skipped if self.keep_going else None,
            )
        written, unwritten = self._write(squeezed)
        with printing():
            _print(squeezed, written)
        early = f"{signals.word()}: squeezed {len(squeezed):,} of {len(grasps):,}" if signals.stopped() else ""
        conclude(early, unwritten)
        return skipped.exit_code()

    def _check(self) -> None:
        from jaxgrasp.files import WRITTEN

        self.check_published()
        check_options(
            ("--mass", self.mass, 0.0 < self.mass < math.inf, "kg > 0"),
            ("--friction", self.friction, 0.0 <= self.friction < math.inf, "a number >= 0"),
            ("--max-force", self.max_force, 0.0 < self.max_force < math.inf, "newtons > 0"),
            ("--contact-distance", self.contact_distance, 0.0 <= self.contact_distance < math.inf, "metres >= 0"),
            ("--format", self.format, self.format in WRITTEN, f"one of {', '.join(WRITTEN)}"),
        )
        if self.output.suffix:
            check_options(("--format", self.format, self.format == "jaxgrasp", "a folder as --output for this format"))
            check_output(self.output, "--output", (_NPZ,), self.inputs)
            return
        check_output_folder(self.output)

    def _write(self, squeezed: "GraspSet") -> tuple[list[Path], list[str]]:
        if self.output.suffix:
            jobs = [(self.output, squeezed)]
        else:
            ending = _NPZ if self.format == "jaxgrasp" else ""
            names = list(dict.fromkeys(squeezed.object_name.tolist()))
            own = [squeezed.take(squeezed.object_name == name) for name in names]
            jobs = [(self.output / f"{name}{ending}", part) for name, part in zip(names, own, strict=True)]
        for path, _ in jobs:
            if any(path.resolve() == other.resolve() for other in self.inputs):
                raise CommandError(f"--output {path}: this file is read from; wanted another one")
        return write_files(
            *((path, lambda path, part=part: self._write_one(part, path)) for path, part in jobs if len(part))
        )

    def _write_one(self, squeezed: "GraspSet", path: Path) -> None:
        from jaxgrasp.files import write_grasps

        try:
            with made_folder(path.parent):
                lost = write_grasps(squeezed, path, self.format, hand=None if self.format == "jaxgrasp" else self.hand)
        except ValueError as error:
            raise CommandError(f"--format {self.format}: {error}") from error
        if lost:
            notice(f"{self.format} cannot say: {'; '.join(lost)}")


def _print(squeezed: "GraspSet", written: Sequence[Path]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH, highlight=False)
    table = Table(title=f"{len(squeezed):,} grasps with squeezes")
    for name in ("object", "grasps", "with a margin", "median margin", "strongest contact", "joints travel"):
        table.add_column(name, justify="left" if name == "object" else "right")
    travel = np.linalg.norm(squeezed.stages["squeeze"].joints - squeezed.stages["grasp"].joints, axis=-1)
    strongest = np.linalg.norm(squeezed.columns["forces"], axis=-1).max(-1) if len(squeezed) else np.zeros(0)
    for name in dict.fromkeys(squeezed.object_name.tolist()):
        rows = squeezed.object_name == name
        margin = squeezed.columns["margin"][rows]
        table.add_row(
            escape(name),
            f"{rows.sum():,}",
            f"{(margin > 1e-6).mean():.1%}",
            f"{np.nanmedian(margin) if np.isfinite(margin).any() else np.nan:.3g} N",
            f"{np.median(strongest[rows]):.3g} N",
            f"{np.nanmedian(travel[rows]) if np.isfinite(travel[rows]).any() else np.nan:.3g} rad",
        )
    console.print(table)
    if written:
        console.print("written: " + ", ".join(map(str, written)), markup=False)
