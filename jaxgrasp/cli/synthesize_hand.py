"""`jaxgrasp synthesize` with a hand and an object: a file of configurations, a figure and pictures out."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxgrasp.cli import signals
from jaxgrasp.cli.checks import check_options, conclude, write_files
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.hand_scene import HandScene
from jaxgrasp.cli.streams import notice, printing
from jaxgrasp.storage import atomic_write

if TYPE_CHECKING:
    from jaxgrasp.disturbance import DisturbanceSet
    from jaxgrasp.hands import HandObject, Scene
    from jaxgrasp.synthesis import HandSynthesis

_PICTURES = 4


@dataclass(frozen=True, kw_only=True)
class SceneSynthesis(HandScene):
    """Options of a synthesis with a hand."""

    links: tuple[str, ...] = ()
    """Bodies of the hand that shall touch the object; none for the outermost one of every finger."""

    contact_distance: float = 1e-3
    """Geoms no farther apart than this touch, m: fingers are closed until they do, so that no file's gaps count."""

    min_contacts: int = 3
    """With fewer contacts a grasp is not good."""

    torque_limits: bool = False
    """Let the limits of the actuators count on the way, too, at many times the cost; at the end they always do."""

    keep: int | None = None
    """How many of the good grasps to write, the best that differ; None for all of them."""

    diversity: float = 0.01
    """With --keep: grasps whose palms and links are closer than this to those of a better one are left out, m."""

    def check(self) -> None:
        """Finds what cannot be used before any long work.

        Raises:
            CommandError: An option cannot be used.
        """
        super().check()
        check_options(
            ("--min-contacts", self.min_contacts, self.min_contacts >= 1, "at least 1"),
            ("--keep", self.keep, self.keep is None or self.keep >= 1, "at least 1"),
            ("--diversity", self.diversity, 0.0 <= self.diversity < math.inf, "metres >= 0"),
        )

    def run(
        self,
        disturbances: "DisturbanceSet",
        unit: str,
        *,
        object: str,
        scale: float,
        friction: float | None,
        max_force: float,
        starts: int,
        steps: int,
        seed: int,
        output: Path,
        figure: Path | None,
    ) -> int:
        """Synthesises, writes and prints.

        Args:
            disturbances: What grasps shall withstand.
            unit: Of the margin then.
            object: With --hand.
            scale: Of its lengths.
            friction: Of every contact; None is the scene's.
            max_force: Of every contact, N.
            starts: How many.
            steps: Of each.
            seed: Of the random numbers.
            output: The file of candidates.
            figure: The figure; None for none.

        Returns:
            The exit code: 0.

        Raises:
            CommandError: The scene cannot be used, a file could not be written in the end, or Ctrl-C has ended the work
                early.
        """
        import jax

        from jaxgrasp.cli.report import hand_bar, print_hand_synthesis
        from jaxgrasp.synthesis import synthesize_hand_grasps

        built = self.built(object, scale, friction) if self.hand else None
        hand = self.hand_of(built.model, None, max_force) if built else self.hand_object(friction, max_force)
        try:
            with hand_bar(starts, steps) as progress:
                found = synthesize_hand_grasps(
                    hand,
                    jax.random.key(seed),
                    disturbances=disturbances,
                    links=self.links or None,
                    torque_limits=self.torque_limits,
                    starts=starts,
                    steps=steps,
                    min_contacts=self.min_contacts,
                    progress=progress,
                )
        except ValueError as error:
            raise CommandError(f"{self.name}: {error}") from error
        kept = np.flatnonzero(found.good) if self.keep is None else found.diverse(self.keep, self.diversity)
        name = f"{self.name} and {object}" if self.hand else self._name
        columns = partial(_as_grasps, built, scale) if built else _as_configurations
        written, unwritten = self._write(hand, found, found.take(kept), columns, name, unit, output, figure)
        with printing():
            print_hand_synthesis(found, len(kept), name, unit, written)
        early = f"{signals.word()}: grasps are those of fewer steps or starts" if found.interrupted else ""
        conclude(early, unwritten)
        return 0

    @property
    def _name(self) -> str:
        return f"{self.scene} and {self.object_shape}" if self.built_in else f"{self.scene}"

    def _write(
        self,
        hand: "HandObject",
        found: "HandSynthesis",
        kept: "HandSynthesis",
        columns: Callable[["HandSynthesis"], dict[str, np.ndarray]],
        name: str,
        unit: str,
        output: Path,
        figure: Path | None,
    ) -> tuple[list[Path], list[str]]:
        from jaxgrasp.viewer import figure_of_hand_synthesis, write_figure

        def write_candidates(path: Path) -> None:
            with atomic_write(path) as stream:
                np.savez(
                    stream,
                    **columns(kept),  # pyright: ignore[reportArgumentType]  # no column is called allow_pickle
                    squeeze_controls=kept.controls,
                    synthesis_margin=kept.margin,
                    self_penetration=kept.self_penetration,
                )

        def write_picture(path: Path) -> None:
            write_figure(figure_of_hand_synthesis(found, name=name, unit=unit), path)

        jobs: list[tuple[Path | None, Callable[[Path], None]]] = [(figure, write_picture)]
        if len(kept.qpos):
            jobs.insert(0, (output, write_candidates))
        else:
            notice(f"{output}: not written, no grasp is good")
        written, unwritten = write_files(*jobs)
        if len(kept.qpos):
            # Many machines have nothing to render with: that is told, and no failure.
            drawn, undrawn = write_files((self.picture, lambda path: self._draw(hand, kept, unit, path)))
            written += drawn
            for line in undrawn:
                notice(line)
        return written, unwritten

    def _draw(self, hand: "HandObject", kept: "HandSynthesis", unit: str, path: Path) -> None:
        from jaxgrasp.viewer.scene import draw_scenes

        best = kept.take(kept.diverse(_PICTURES, self.diversity))
        titles = [f"#{n + 1}: margin {margin:.3g} {unit}" for n, margin in enumerate(best.margin)]
        try:
            draw_scenes(path, hand.model, best.qpos, best.contact_points, best.forces, titles, hand.object_body)
        except RuntimeError as error:
            raise OSError(str(error)) from error


def _as_configurations(kept: "HandSynthesis") -> dict[str, np.ndarray]:
    """Columns that `jaxgrasp rank --scene --qpos` reads."""
    return {"qpos": kept.qpos, "pregrasp_qpos": kept.pregrasp, "squeeze_qpos": kept.squeeze}


def _as_grasps(built: "Scene", scale: float, kept: "HandSynthesis") -> dict[str, np.ndarray]:
    """Columns that `jaxgrasp rank --hand --grasps` reads: poses of the base and joints together."""
    stages = {"grasp_qpos": kept.qpos, "pregrasp_qpos": kept.pregrasp, "squeeze_qpos": kept.squeeze}
    parts = {name: built.parts(qpos) for name, qpos in stages.items()}
    columns = {name: np.concatenate([p.base, p.joints], -1) for name, p in parts.items()}
    return columns | {
        "obj_pose": parts["grasp_qpos"].object,
        "obj_scale": np.full(len(kept.qpos), scale),
        "joint_names": np.array(built.joint_names),
    }
