"""The options by which `jaxgrasp rank` and `compare` take candidates from configurations of a hand."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli.checks import Skipped, check_options
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.hand_scene import HandScene
from jaxgrasp.cli.streams import notice
from jaxgrasp.storage import FileError, read_archive, read_array

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.hands import HandObject
    from jaxgrasp.ranking import Ranking
    from jaxgrasp.viewer.held import Held

SAMPLED = 2_000
_PICTURES = 4


@dataclass(frozen=True, kw_only=True)
class GivenScene(HandScene):
    """A hand and an object, whose candidates are configurations of files."""

    scene: str | None = None
    """Rank configurations of a hand: an MJCF file with a hand and an object, or shadow_hand or four_fingers, which come
    with the package. The weight in the scene's gravity must be borne."""

    object: str | None = None
    """With --hand: a folder of convex pieces, a mesh, an MJCF or URDF file, or sphere, capsule, box, cylinder or
    ellipsoid, 1 m wide along x."""

    scale: float | None = None
    """With --hand: of the object's lengths; None is the grasps' own obj_scale, or 1."""

    grasps: tuple[Path, ...] = ()
    """With --hand: files, folders and patterns of grasps in any format of docs/grasp_files.md; our own is .npz with
    grasp_qpos (N, 7 + n), pose of the base and joints, and where present obj_pose (N, 7), obj_scale (N,) and
    joint_names; other columns travel along."""

    grasp_format: str | None = None
    """The format of --grasps; None looks at the content of each file. A wrong name is answered with all names."""

    keep_going: bool = False
    """With --grasps: pass over files that cannot be used, with a line for each; the exit code is 2 then."""

    qpos: Path | None = None
    """With --scene: configurations, .npy (N, nq), or .npz with the field qpos; other columns travel along."""

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
        if not self.given:
            if self.qpos is not None:
                raise CommandError("--qpos: got a file without --scene; wanted the scene that it is for, too")
            if self.grasps or self.object:
                raise CommandError("--grasps or --object: got no --hand; wanted the hand that they are for, too")
            return
        super().check()
        if self.hand and (self.object is None or not self.grasps):
            raise CommandError("--hand: got no --object or no --grasps; wanted both")
        if self.scene and (self.grasps or self.object or self.scale is not None):
            raise CommandError("--scene: got --grasps, --object or --scale, too; wanted --hand for these")
        if self.hand and self.qpos is not None:
            raise CommandError("--qpos: got --hand, too; wanted --grasps")
        check_options(
            ("--scale", self.scale, self.scale is None or 0.0 < self.scale < math.inf, "a number > 0"),
            ("--min-contacts", self.min_contacts, self.min_contacts >= 0, "a number >= 0"),
            ("--max-penetration", self.max_penetration, self.max_penetration >= 0.0, "metres >= 0"),
        )

    def candidates(
        self, friction: float | None, max_force: float | None, skipped: Skipped | None = None
    ) -> "tuple[Candidates, list[HandObject]]":
        """Reads or samples the configurations, finds their contacts and leaves out what the options say.

        Args:
            friction: Of every contact; None is the models'.
            max_force: Of every contact, N.
            skipped: Told of files that cannot be used, with --keep-going.

        Returns:
            The candidates, and the scenes that they are of: the column `scene` says which.

        Raises:
            CommandError: The files or the scene cannot be used, or no configuration is left.
        """
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.ranking.configurations import candidates_of, kept, trimmed

        if self.hand:
            found, hands = self._of_files(friction, max_force, skipped if self.keep_going else None)
        else:
            hands = [self.hand_object(friction, max_force)]
            columns: dict[str, np.ndarray] = {}
            qpos, columns = (self._sampled(hands[0]), columns) if self.qpos is None else self._read(hands[0])
            with counting_bar("finding contacts", len(qpos)) as progress:
                found = candidates_of(
                    hands[0],
                    qpos,
                    source=self.name if self.qpos is None else str(self.qpos),
                    limited=self.actuators,
                    columns=columns,
                    engine=self.engine,
                    progress=progress,
                )
        self._tell(found)
        left = kept(found, self.min_contacts, self.max_penetration)
        touching = found.columns["touching"]
        if not left.any():
            raise CommandError(
                f"{self.name}: none of {len(found):,} configurations has {self.min_contacts} contacts and less "
                f"than {1e3 * self.max_penetration:g} mm of penetration (the most contacts are {touching.max()}, the "
                f"least penetration is {1e3 * found.columns['penetration'].min():.3g} mm); wanted fingers that touch, "
                "or other --contact-distance, --min-contacts, --max-penetration"
            )
        few = int((touching < self.min_contacts).sum())
        deep = int((found.columns["penetration"] > self.max_penetration).sum())
        if not left.all():
            notice(
                f"left out {int((~left).sum()):,} of {len(found):,} configurations: {few:,} with fewer than "
                f"{self.min_contacts} contacts, {deep:,} deeper than {1e3 * self.max_penetration:g} mm"
            )
        return trimmed(found.take(np.flatnonzero(left))), hands

    def _of_files(
        self, friction: float | None, max_force: float | None, skipped: Skipped | None
    ) -> "tuple[Candidates, list[HandObject]]":
        """The candidates of all files of grasps, in their order, and the scenes that they are of, one a scale."""
        from jaxgrasp.candidates import concatenate
        from jaxgrasp.cli.hand_grasps import configurations, grasps_of_files, sources_of, travelling_columns
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.ranking.configurations import candidates_of

        assert self.object is not None
        grasps = grasps_of_files(self.grasps, self.grasp_format, hand=self.hand, scale=self.scale, skipped=skipped)
        hands: list[HandObject] = []
        parts, order = [], []
        with counting_bar("finding contacts", len(grasps)) as progress:
            done = 0
            for scale in np.unique(grasps.object_scale):
                built = self.built(self.object, float(scale), friction)
                rows = np.flatnonzero(grasps.object_scale == scale)
                chosen = grasps.take(rows)
                qpos = configurations(built, chosen)
                # Tables have no names of joints: theirs are in the hand's order.
                chosen = chosen.for_hand(built.joint_names)
                hands.append(self.hand_of(built.model, None, max_force))
                parts.append(
                    candidates_of(
                        hands[-1],
                        qpos,
                        source="",
                        limited=self.actuators,
                        columns=travelling_columns(chosen) | {"scene": np.full(len(rows), len(hands) - 1)},
                        engine=self.engine,
                    )
                )
                order.append(rows)
                done += len(rows)
                progress(done)
        found = concatenate(parts).take(np.argsort(np.concatenate(order)))
        files, source, index = sources_of(grasps)
        return replace(found, sources=files, source=source, index=index), hands

    def _sampled(self, hand: "HandObject") -> np.ndarray:
        raise CommandError("--scene: got no --qpos; wanted configurations of it")

    def _tell(self, found: "Candidates") -> None:
        """Says how contacts were made, and what --max-contacts left out."""
        points = "one contact" if self.points_per_link == 1 else f"up to {self.points_per_link} contacts"
        notice(f"{points} for each link within {1e3 * self.contact_distance:g} mm of the object")
        out = found.columns["left_out"]
        if out.any():
            notice(
                f"--max-contacts {self.max_contacts} leaves out links of {int((out > 0).sum()):,} configurations, "
                f"{int(out.max())} at most"
            )

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

    def held(self, hands: "list[HandObject]", ranking: "Ranking") -> "Callable[[int], Held]":
        """Returns a function that gives the hand and the object around a candidate's contacts, by its number."""
        from jaxgrasp.viewer.solids import held_by

        columns = ranking.candidates.columns

        def of_candidate(row: int) -> "Held":
            return held_by(
                hands[int(columns["scene"][row]) if "scene" in columns else 0], columns["qpos"][row], self.engine
            )

        return of_candidate

    def draw(self, hands: "list[HandObject]", ranking: "Ranking", unit: str, path: Path) -> None:
        """Renders the best configurations with their tightening forces.

        Raises:
            OSError: The picture cannot be made or written.
        """
        import jax.numpy as jnp

        from jaxgrasp.viewer.scene import draw_scenes

        columns = ranking.candidates.columns
        best = np.flatnonzero(np.isfinite(ranking.effort))
        # A picture shows one scene: that of the best grasp.
        scenes = columns["scene"][ranking.order[best]] if "scene" in columns else np.zeros(len(best), int)
        best = best[scenes == scenes[0]][:_PICTURES]
        hand, rows = hands[int(scenes[0])], ranking.order[best]
        qpos = columns["qpos"][rows]
        grasps = hand.grasps(qpos, self.engine)
        kept = ranking.forces.shape[1]
        forces = np.zeros((len(best), *grasps.contacts.positions.shape[1:]))
        forces[:, :kept] = ranking.forces[best][:, : forces.shape[1]]
        points, forces = (np.asarray(x) for x in grasps.in_world_frame(jnp.asarray(forces)))
        titles = [f"#{b + 1}: margin {ranking.margin[row]:.3g} {unit}" for b, row in zip(best, rows, strict=True)]
        try:
            draw_scenes(path, hand.model, qpos, points, forces, titles, hand.object_body)
        except RuntimeError as error:
            raise OSError(str(error)) from error


@dataclass(frozen=True, kw_only=True)
class Scene(GivenScene):
    """A hand and an object, whose candidates are configurations of files, or sampled."""

    qpos: Path | None = None
    """With --scene: configurations, .npy (N, nq), or .npz with the field qpos; other columns travel along. None samples
    them around the scene's own: the object turned and moved, the fingers closed until they touch."""

    samples: int = SAMPLED
    """How many configurations to sample."""

    seed: int = 0
    """Of the samples."""

    def check(self) -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        super().check()
        check_options(("--samples", self.samples, self.samples >= 1, "at least 1"))

    def _sampled(self, hand: "HandObject") -> np.ndarray:
        from jaxgrasp.cli.report import counting_bar
        from jaxgrasp.hands import sample_configurations

        with counting_bar("closing fingers", self.samples) as progress:
            return sample_configurations(hand, self.samples, self.seed, progress)


@dataclass(frozen=True, kw_only=True)
class ComparedScene(GivenScene):
    """A hand and an object, of whose configurations none is left out."""

    min_contacts: int = 0
    """Leave out configurations with fewer contacts."""

    max_penetration: float = math.inf
    """Leave out configurations in which hand and object are deeper in each other, m."""
