"""The options by which `jaxgrasp rank` takes a hand and an object from MJCF, and candidates from joint angles."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli.problems import CommandError, check_options
from jaxgrasp.cli.streams import one_line
from jaxgrasp.storage import FileError, read_archive, read_array

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.hands import HandObject
    from jaxgrasp.ranking import Ranking

BUILT_IN = ("shadow_hand", "four_fingers")
SAMPLED = 2_000
_PICTURES = 4


@dataclass(frozen=True, kw_only=True)
class HandScene:
    """A hand and an object."""

    scene: str | None = None
    """A hand and an object in MJCF: a file, or shadow_hand or four_fingers, which come with the package."""

    object_body: str = "object"
    """The object's body in the scene."""

    object_shape: str = "sphere"
    """The object of a scene that comes with the package: sphere, capsule, box, cylinder, ellipsoid, mesh, or a FILE."""

    contact_distance: float = 1e-3
    """Geoms no farther apart than this touch, m."""

    max_contacts: int = 8
    """How many contacts a grasp keeps, the nearest ones."""

    picture: Path | None = Path("hands.png")
    """The rendered picture of the best configurations to write, .png; None for none."""

    def check(self) -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        check_options(
            ("--contact-distance", self.contact_distance, 0.0 <= self.contact_distance < math.inf, "metres >= 0"),
            ("--max-contacts", self.max_contacts, self.max_contacts >= 1, "at least 1"),
        )

    @property
    def built_in(self) -> bool:
        """Whether the scene comes with the package."""
        return self.scene in BUILT_IN

    def hand(self, friction: float | None, max_force: float | None) -> "HandObject":
        """Reads the scene.

        Args:
            friction: Of all contacts; None is MuJoCo's.
            max_force: Of every contact, N.

        Raises:
            CommandError: It cannot be used.
        """
        from jaxgrasp.hands import HandObject, scenes

        assert self.scene is not None
        try:
            given = getattr(scenes, self.scene)(self.object_shape) if self.built_in else Path(self.scene)
            return HandObject.from_mjcf(
                given,
                self.object_body,
                contact_distance=self.contact_distance,
                max_contacts=self.max_contacts,
                friction=friction,
                max_force=10.0 if max_force is None else max_force,
            )
        except (ValueError, OSError) as error:
            raise CommandError(f"--scene {self.scene}: {' '.join(str(error).split())}") from error


@dataclass(frozen=True, kw_only=True)
class Scene(HandScene):
    """A hand and an object, whose candidates are configurations."""

    scene: str | None = None
    """Rank configurations of a hand: an MJCF file with a hand and an object, or shadow_hand or four_fingers, which come
    with the package. The weight in the scene's gravity must be borne."""

    qpos: Path | None = None
    """Configurations: .npy (N, nq), or .npz with the field qpos; other columns travel along. None samples them around
    the scene's own: the object turned and moved, the fingers closed until they touch."""

    samples: int = SAMPLED
    """How many configurations to sample."""

    seed: int = 0
    """Of the samples."""

    min_contacts: int = 2
    """Leave out configurations with fewer contacts."""

    max_penetration: float = 0.002
    """Leave out configurations in which hand and object are deeper in each other, m."""

    actuators: bool = True
    """Whether the limits of the hand's actuators count; else every contact may push with --max-force."""

    def check(self) -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        if self.scene is None:
            if self.qpos is not None:
                raise CommandError("--qpos: got a file without --scene; wanted the scene that it is for, too")
            return
        super().check()
        check_options(
            ("--samples", self.samples, self.samples >= 1, "at least 1"),
            ("--min-contacts", self.min_contacts, self.min_contacts >= 0, "a number >= 0"),
            ("--max-penetration", self.max_penetration, self.max_penetration >= 0.0, "metres >= 0"),
        )

    def candidates(self, hand: "HandObject") -> "Candidates":
        """Reads or samples the configurations, finds their contacts and leaves out what the options say.

        Raises:
            CommandError: The file cannot be used, or no configuration is left.
        """
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.ranking.configurations import candidates_of, kept

        columns: dict[str, np.ndarray] = {}
        if self.actuators and not len(hand.actuators):
            print("jaxgrasp: the hand has no actuators: every contact may push with --max-force", file=sys.stderr)
        if self.qpos is None:
            from jaxgrasp.hands import sample_configurations

            with counting_bar("closing fingers", self.samples) as progress:
                qpos = sample_configurations(hand, self.samples, self.seed, progress)
        else:
            qpos, columns = self._read(hand)
        with counting_bar("finding contacts", len(qpos)) as progress:
            found = candidates_of(
                hand,
                qpos,
                source=self.scene if self.qpos is None else str(self.qpos),
                limited=self.actuators and len(hand.actuators) > 0,
                columns=columns,
                progress=progress,
            )
        left = kept(found, self.min_contacts, self.max_penetration)
        touching = found.columns["touching"]
        if not left.any():
            raise CommandError(
                f"--scene {self.scene}: none of {len(qpos):,} configurations has {self.min_contacts} contacts and less "
                f"than {1e3 * self.max_penetration:g} mm of penetration (the most contacts are {touching.max()}, the "
                f"least penetration is {1e3 * found.columns['penetration'].min():.3g} mm); wanted fingers that touch, "
                "or other --contact-distance, --min-contacts, --max-penetration"
            )
        few = int((touching < self.min_contacts).sum())
        deep = int((found.columns["penetration"] > self.max_penetration).sum())
        if not left.all():
            one_line(
                f"left out {int((~left).sum()):,} of {len(qpos):,} configurations: {few:,} with fewer than "
                f"{self.min_contacts} contacts, {deep:,} deeper than {1e3 * self.max_penetration:g} mm"
            )
        return found.take(np.flatnonzero(left))

    def _read(self, hand: "HandObject") -> tuple[np.ndarray, dict[str, np.ndarray]]:
        assert self.qpos is not None
        try:
            columns = {"qpos": read_array(self.qpos)} if self.qpos.suffix == ".npy" else read_archive(self.qpos)
        except FileError as error:
            raise CommandError(str(error)) from error
        qpos = columns.pop("qpos", None)
        wanted = f"(N, {hand.nq}), N configurations of the scene"
        if qpos is None:
            raise CommandError(f"{self.qpos}: got fields {', '.join(columns) or 'none'}; wanted qpos {wanted}")
        if qpos.ndim != 2 or qpos.shape[1] != hand.nq or qpos.dtype.kind not in "fiu" or not len(qpos):
            raise CommandError(f"{self.qpos}: qpos: got {qpos.dtype} {qpos.shape}; wanted {wanted}")
        for name, column in columns.items():
            if column.ndim == 0 or len(column) != len(qpos):
                raise CommandError(f"{self.qpos}: {name}: got shape {column.shape}; wanted ({len(qpos)}, ...)")
        return np.asarray(qpos, float), columns

    def draw(self, hand: "HandObject", ranking: "Ranking", unit: str, path: Path) -> None:
        """Renders the best configurations with their tightening forces.

        Raises:
            OSError: The picture cannot be made or written.
        """
        from jaxgrasp.viewer.scene import draw_scenes

        best = np.flatnonzero(np.isfinite(ranking.effort))[:_PICTURES]
        rows = ranking.order[best]
        qpos = ranking.candidates.columns["qpos"][rows]
        points, forces = hand.grasps(qpos).in_world_frame(ranking.forces[best])
        titles = [f"#{b + 1}: margin {ranking.margin[row]:.3g} {unit}" for b, row in zip(best, rows, strict=True)]
        try:
            draw_scenes(path, hand.model, qpos, np.asarray(points), np.asarray(forces), titles)
        except RuntimeError as error:
            raise OSError(str(error)) from error
