"""`jaxgrasp synthesize`: an object in, a file of candidates and a figure out."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import check_options, check_output, conclude, write_files
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.setting import FIGURE_ENDINGS, Reading, configure_jax, named_disturbances
from jaxgrasp.cli.streams import printing
from jaxgrasp.cli.synthesize_hand import SceneSynthesis
from jaxgrasp.storage import atomic_write, printable

if TYPE_CHECKING:
    import numpy as np

    from jaxgrasp.geometry import Shape
    from jaxgrasp.synthesis import Synthesis

_SIZE, _FRICTION = 0.1, 0.6
BUILT_IN = ("sphere", "ellipsoid", "box", "capsule", "cylinder", "superquadric")


@dataclass(frozen=True, kw_only=True)
class Synthesize(Reading):
    """Make grasps of an object by gradient ascent on the largest disturbance that they resist.

    Contacts begin at random places on the surface and move along it. Writes an .npz file of candidates that `jaxgrasp
    rank` reads: positions about the centre of mass, outward_normals, friction, max_force, the best first. With --scene,
    or --hand and --object, a whole hand moves, its pose and its joints, and the file has configurations for `jaxgrasp
    rank --scene --qpos`, or `jaxgrasp rank --hand --object --grasps`.
    """

    object: str = "superquadric"
    """sphere, ellipsoid, box, capsule, cylinder or superquadric; or a mesh FILE, .stl, .obj or .ply. With --hand: a
    folder of convex pieces, a mesh, an MJCF or URDF file, or sphere, capsule, box, cylinder or ellipsoid, 1 m wide."""

    size: float | None = None
    """Longest side of a built-in object, m; None for 0.1."""

    scale: float = 1.0
    """Metres per unit of the mesh file; with --hand, of the object's lengths."""

    contacts: int = 4
    """Contacts of each grasp."""

    friction: float | None = None
    """Coulomb's friction coefficient; None for 0.6, with --scene or --hand for the models'."""

    max_force: float = 10.0
    """Largest normal force, N."""

    disturbances: str = "box"
    """forces: 1 N along the six axes; ball: 1 N in any direction; box: 1 N along each axis together with 0.02 N m about
    each; or a FILE of wrenches, .npy or .npz with the field wrenches (n_d, 6), N and N m. The margin is the factor by
    which they may grow."""

    spacing: float = 0.015
    """Least distance of two contacts on the same side of the object, m."""

    span: float | None = None
    """Largest distance of any two contacts, m; None for no limit."""

    starts: int = 1024
    """How many random starts."""

    steps: int = 200
    """Steps of the ascent."""

    seed: int = 0
    """Seed of the random numbers."""

    cone_edges: int = 8
    """Edges of the friction pyramid."""

    output: Path = Path("grasps.npz")
    """The file of candidates to write, .npz."""

    figure: Path | None = Path("synthesis.png")
    """The figure to write, .png, .svg or .pdf; None for no figure."""

    of_hand: Annotated[SceneSynthesis, tyro.conf.arg(name="")] = field(default_factory=SceneSynthesis)

    def run(self) -> int:
        """Synthesises, writes and prints.

        Returns:
            The exit code: 0.

        Raises:
            CommandError: The options or the files cannot be used, a file could not be written in the end, or Ctrl-C has
                ended the work early.
        """
        self._check()
        configure_jax()
        from jaxgrasp.candidates import CandidateError
        from jaxgrasp.geometry import MeshError

        try:
            disturbances, unit = named_disturbances(self.disturbances)
            if self.of_hand.given:
                names = ("object", "scale", "friction", "max_force", "starts", "steps", "seed", "output", "figure")
                return self.of_hand.run(disturbances, unit, **{name: getattr(self, name) for name in names})
            shape, centre, name, note = self._object()
        except (MeshError, CandidateError) as error:
            raise CommandError(str(error)) from error
        found = self._synthesize(shape, centre, disturbances)
        from jaxgrasp.cli.report import print_synthesis

        written, unwritten = self._write(found, shape, name, unit)
        zeros = self._why_zero(found, disturbances)
        with printing():
            print_synthesis(found, name, note, unit, zeros, written)
        conclude(f"{signals.word()}: grasps are those of fewer steps" if found.interrupted else "", unwritten)
        return 0

    def _check(self) -> None:
        span = math.inf if self.span is None else self.span
        check_options(
            ("--size", self.size, self.size is None or 0.0 < self.size < math.inf, "metres > 0"),
            ("--scale", self.scale, 0.0 < self.scale < math.inf, "a number > 0"),
            ("--contacts", self.contacts, self.contacts >= 2, "at least 2"),
            ("--friction", self.friction, self.friction is None or 0.0 < self.friction < math.inf, "a number > 0"),
            ("--max-force", self.max_force, 0.0 < self.max_force < math.inf, "newtons > 0"),
            ("--spacing", self.spacing, 0.0 <= self.spacing < math.inf, "metres >= 0"),
            ("--span", self.span, span > self.spacing, "metres above --spacing"),
            ("--starts", self.starts, self.starts >= 1, "at least 1"),
            ("--steps", self.steps, self.steps >= 1, "at least 1"),
            ("--seed", self.seed, 0 <= self.seed < 2**32, "from 0 to 2^32 - 1"),
            ("--cone-edges", self.cone_edges, self.cone_edges >= 3, "at least 3"),
        )
        if self.of_hand.given:
            self.of_hand.check()
            if self.size is not None or self.span is not None:
                raise CommandError("--size or --span: got a hand, too; wanted --scale, and the hand alone")
            if self.of_hand.scene and self.scale != 1.0:
                raise CommandError("--scale: got --scene, too; wanted --hand and --object with it")
        inputs = [Path(self.object), Path(self.disturbances), Path(self.of_hand.name)]
        if self.of_hand.given and self.of_hand.picture is not None:
            check_output(self.of_hand.picture, "--picture", FIGURE_ENDINGS, inputs)
        check_output(self.output, "--output", (".npz",), inputs)
        if self.figure is not None:
            check_output(self.figure, "--figure", FIGURE_ENDINGS, inputs)

    def _object(self) -> "tuple[Shape, Any, str, str]":
        """The shape, its centre of mass, its name, and what the conversion of a mesh cost."""
        import numpy as np

        from jaxgrasp import geometry

        half = 0.5 * (self.size or _SIZE)
        sides = half * np.array([0.6, 0.45, 1.0])
        built_in = {
            "sphere": lambda: geometry.Sphere.from_radius(half),
            "ellipsoid": lambda: geometry.Ellipsoid.from_semi_axes(sides),
            "box": lambda: geometry.Box.from_half_extents(sides, rounding=0.1 * half),
            "capsule": lambda: geometry.Capsule.from_radius(0.4 * half, 0.6 * half),
            "cylinder": lambda: geometry.Cylinder.from_radius(0.6 * half, half, rounding=0.1 * half),
            "superquadric": lambda: geometry.Superquadric.from_semi_axes(sides),
        }
        if self.object in built_in:
            return built_in[self.object](), np.zeros(3), self.object, ""
        path = Path(self.object)
        if not path.suffix:
            raise CommandError(f"--object: got {self.object!r}; wanted {', '.join(BUILT_IN)}, or a mesh file")
        import jax

        from jaxgrasp.cli.report import counting_bar

        mesh = geometry.Mesh.from_file(path, self.scale)
        try:
            with counting_bar("distances to the mesh", 1) as progress:
                grid = mesh.to_grid(progress=progress)
        except geometry.MeshError as error:
            raise geometry.MeshError(f"{path}: {error}") from None
        points = np.asarray(geometry.sample_surface(grid, jax.random.key(self.seed), 4096))
        off = mesh.deviation(points) * 1e3
        note = (
            f"{len(mesh.faces):,} triangles on a grid of {float(grid.spacing) * 1e3:.2f} mm; its surface is off theirs "
            f"by {np.median(off):.3f} mm in the median, {off.max():.2f} mm at most"
        )
        return grid, mesh.centroid, printable(path.stem), note

    def _synthesize(self, shape: "Shape", centre: "np.ndarray", disturbances: Any) -> "Synthesis":
        import jax

        from jaxgrasp.cli.report import ascent_bar
        from jaxgrasp.synthesis import synthesize

        with ascent_bar(self.steps) as progress:
            return synthesize(
                shape,
                self.contacts,
                jax.random.key(self.seed),
                disturbances=disturbances,
                friction=self.friction or _FRICTION,
                max_force=self.max_force,
                starts=self.starts,
                steps=self.steps,
                spacing=self.spacing,
                span=math.inf if self.span is None else self.span,
                center_of_mass=centre,
                cone_edges=self.cone_edges,
                progress=progress,
            )

    def _why_zero(self, found: "Synthesis", disturbances: Any) -> list[str]:
        from jaxgrasp.contact import Contacts
        from jaxgrasp.explanation import is_zero, why_zero

        given = {"friction": self.friction or _FRICTION, "max_force": self.max_force}
        return why_zero(
            lambda rows: Contacts.from_normals(found.positions[rows], found.outward_normals[rows], **given),
            is_zero(found.margin, found.status),
            disturbances,
            cone_edges=self.cone_edges,
        )

    def _write(self, found: "Synthesis", shape: "Shape", name: str, unit: str) -> tuple[list[Path], list[str]]:
        import numpy as np

        count = len(found.margin)

        def write_candidates(path: Path) -> None:
            with atomic_write(path) as stream:
                np.savez(
                    stream,
                    positions=found.positions,
                    outward_normals=found.outward_normals,
                    friction=np.full(count, self.friction or _FRICTION),
                    max_force=np.full(count, self.max_force),
                    center_of_mass=np.broadcast_to(found.center_of_mass, (count, 3)),
                    object_name=np.full(count, name),
                    synthesis_margin=found.margin,
                )

        def write_picture(path: Path) -> None:
            import jax

            from jaxgrasp.geometry import sample_surface
            from jaxgrasp.viewer import figure_of_synthesis, write_figure

            surface = np.asarray(sample_surface(shape, jax.random.key(self.seed), 1500)) - found.center_of_mass
            write_figure(
                figure_of_synthesis(found, surface, friction=self.friction or _FRICTION, name=name, unit=unit), path
            )

        return write_files((self.output, write_candidates), (self.figure, write_picture))
