"""`jaxgrasp pieces`: a mesh as a folder of convex pieces."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import check_new_folder, check_options
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.setting import Reading
from jaxgrasp.cli.streams import printing
from jaxgrasp.storage import atomic_write, made_folder, printable, reason_of

if TYPE_CHECKING:
    from jaxgrasp.geometry import Mesh


@dataclass(frozen=True, kw_only=True)
class Pieces(Reading):
    """Take a mesh apart into convex pieces, for `--object` of other commands.

    Engines of contacts take a mesh by its convex hull, which fills handles and hollows. A folder of pieces does not.
    Needs the extra pieces.
    """

    mesh: tyro.conf.Positional[Path]
    """A mesh, .obj, .stl or .ply."""

    output: Path
    """The new or empty folder to write, an .obj for each piece."""

    threshold: float = 0.05
    """Largest concavity of a piece, as CoACD measures it: 0.01 (many pieces) to 1."""

    most: int | None = None
    """Largest number of pieces; None for as many as it takes."""

    def run(self) -> int:
        """Reads, writes and prints.

        Returns:
            The exit code, 0.

        Raises:
            CommandError: The options or the mesh cannot be used, or the output cannot be written.
        """
        check_options(
            ("--threshold", self.threshold, 0.01 <= self.threshold <= 1.0, "0.01 to 1"),
            ("--most", self.most, self.most is None or self.most >= 1, "at least 1"),
        )
        check_new_folder(self.output)
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.geometry import Mesh, MeshError, convex_pieces

        try:
            mesh = Mesh.from_file(self.mesh)
            with counting_bar("taking the mesh apart", 1):
                pieces = convex_pieces(mesh, self.threshold, most=self.most)
        except MeshError as error:
            raise CommandError(str(error)) from error
        except ImportError as error:
            raise CommandError(f"pieces: {error}") from error
        try:
            with made_folder(self.output):
                for number, piece in enumerate(pieces):
                    signals.checkpoint()
                    with atomic_write(self.output / f"piece_{number:03d}.obj") as stream:
                        stream.write(_obj(piece))
        except OSError as error:
            raise CommandError(f"--output {self.output}: cannot be written ({reason_of(error)})") from error
        signals.note_written(self.output)
        with printing():
            filled = math.fsum(piece.volume for piece in pieces) / mesh.volume
            print(f"{printable(self.mesh.name)}: {len(pieces)} convex pieces, together {filled:.1%} of its volume")
            print(f"written: {self.output}")
        return 0


def _obj(mesh: "Mesh") -> bytes:
    corners = (f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist())
    faces = (f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist())
    return "\n".join((*corners, *faces, "")).encode()
