"""`jaxgrasp view`: grasps in a browser, or written for other programs."""

import importlib.util
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from jaxgrasp.cli import signals
from jaxgrasp.cli.candidate_options import CandidateOptions
from jaxgrasp.cli.checks import Skipped, check_options, check_output, warn_of_conventions
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.scene import Scene
from jaxgrasp.cli.setting import configure_jax, named_disturbances
from jaxgrasp.cli.streams import printing, tell_notices
from jaxgrasp.cli.view_exports import export
from jaxgrasp.cli.view_trials import films, protocols

if TYPE_CHECKING:
    from jaxgrasp.candidates import Candidates
    from jaxgrasp.disturbance import DisturbanceSet
    from jaxgrasp.hands import HandObject
    from jaxgrasp.viewer.browser import Viewed

# s between two looks at whether the command shall end.
_PATIENCE = 0.2


@dataclass(frozen=True, kw_only=True)
class View(CandidateOptions):
    """Look at grasps in a browser, each in 3D with sliders that change it.

    Takes files of candidates, the table of `jaxgrasp rank`, or a hand with an object and grasps as `rank` does; without
    any it samples 10,000 grasps on a built-in object. The page comes from this machine and loads nothing from others.
    Ctrl-C ends it. Needs the extra view. See docs/viewer.md.
    """

    files: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Files of candidates, .npz; or one table of `jaxgrasp rank`, .parquet, .csv or .npz, whose files of candidates are
    where they were. With --scene, a table with its configurations."""

    host: str = "127.0.0.1"
    """The address to listen at. Others than the default may let other machines in; nobody is asked for a password."""

    port: int = 8080
    """The port to listen at; 0 for any that is free."""

    export: tuple[Path, ...] = ()
    """Files to write in place of a page: .glb (glTF) or .usda (USD) with all that the page draws, .xml with MuJoCo's
    keyframes of configurations and squeezing commands."""

    top: int = 3
    """With --export: how many of the first grasps."""

    of_hand: Annotated[Scene, tyro.conf.arg(name="")] = field(default_factory=Scene)

    def run(self) -> int:
        """Serves the page until Ctrl-C, or writes files.

        Returns:
            The exit code: 0, or 2 where a file was passed over.

        Raises:
            CommandError: The options or the files cannot be used, or a file could not be written in the end.
        """
        self._check()
        configure_jax()
        from jaxgrasp.candidates import CandidateError

        skipped = Skipped()
        try:
            disturbances, unit = named_disturbances(self.disturbances)
            viewed, hands = self._viewed(disturbances, unit, skipped)
        except CandidateError as error:
            raise CommandError(str(error)) from error
        if self.export:
            export(viewed, hands, self.top, self.export)
        else:
            self._serve(viewed)
        return skipped.exit_code()

    def _check(self) -> None:
        self.check_candidates()
        check_options(
            ("--top", self.top, self.top >= 1, "at least 1"),
            ("--port", self.port, 0 <= self.port < 65536, "0 to 65535"),
        )
        for path in self.export:
            check_output(path, "--export", (".glb", ".usda", ".xml"), self.files)
        if not self.export:
            if importlib.util.find_spec("viser") is None:
                raise CommandError("view: viser is not installed; wanted pip install 'jaxgrasp[view]'")
            self._check_address()
        self.of_hand.check()
        if self.of_hand.given and self.gravity:
            raise CommandError("--gravity: got a hand, too; wanted the scene's own gravity alone")
        if self.of_hand.given and len(self.files) > 1:
            raise CommandError(f"{self.of_hand.name}: got {len(self.files)} files; wanted one table at most")
        if self.of_hand.scene and self.of_hand.qpos and self.files:
            raise CommandError("--qpos: got a table, too; wanted one of them")

    def _check_address(self) -> None:
        """Finds out whether there can be a server before any long work."""
        try:
            (kind, *_, address), *_ = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)
            with socket.socket(kind) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
        except OSError as error:
            raise CommandError(
                f"--host {self.host} --port {self.port}: cannot be listened at ({error.strerror or error}); wanted "
                "another port, 0 for any that is free"
            ) from error

    def _viewed(self, disturbances: "DisturbanceSet", unit: str, skipped: Skipped) -> "tuple[Viewed, list[HandObject]]":
        """Reads what there is to see, and finds the margins that are not known."""
        from jaxgrasp.cli.viewed_table import is_table, joined, read_table
        from jaxgrasp.viewer.browser import Viewed

        hands: list[HandObject] = []
        table: dict[str, np.ndarray] | None = None
        if self.of_hand.given:
            of_hand = self.of_hand
            if of_hand.scene and self.files:
                of_hand = replace(of_hand, qpos=self.files[0])
            candidates, hands = of_hand.candidates(self.friction, self.max_force, skipped)
            if of_hand.hand and self.files:
                candidates, table = joined(read_table(self.files[0]), candidates, self.files[0])
        elif len(self.files) == 1 and is_table(self.files[0]):
            table = read_table(self.files[0])
            candidates = self._of_table(table, self.files[0])
        else:
            candidates = self._of_files() if self.files else self.sampled()
        warn_of_conventions(candidates)
        if table is None:
            candidates, table = self._ranked(candidates, disturbances)
        viewed = Viewed(
            candidates=candidates,
            table=table,
            disturbances=disturbances,
            unit=unit,
            gravity=self.gravity,
            cone_edges=self.cone_edges,
            share=self.share,
            bodies=_bodies(candidates, hands) if hands else None,
            film=films(self.of_hand, candidates) if self.of_hand.hand else None,
            protocols=protocols() if self.of_hand.hand else (),
        )
        return viewed, hands

    def _of_files(self) -> "Candidates":
        from jaxgrasp.candidates import read_candidates

        return read_candidates(
            self.files, friction=self.friction, max_force=self.max_force, with_mass=bool(self.gravity)
        )

    def _of_table(self, table: dict[str, np.ndarray], path: Path) -> "Candidates":
        """The candidates of a ranking's table, in its order."""
        from jaxgrasp.candidates import concatenate, read_candidates
        from jaxgrasp.cli.viewed_table import source_of

        names, number = np.unique(table["source"], return_inverse=True)
        parts, rows = [], []
        for place, name in enumerate(names.tolist()):
            own = np.flatnonzero(number == place)
            file, index = source_of(path, name), table["index"][own]
            if file is not None:
                given = {"friction": self.friction, "max_force": self.max_force}
                part = read_candidates([file], **given, with_mass=bool(self.gravity))
            elif name == "superquadric":
                part = self.sampled(int(index.max()) + 1)
            else:
                raise CommandError(
                    f"{path}: source: got {name}, which is not there; wanted the files that were ranked, or the hand "
                    "and the object (--scene, or --hand, --object and --grasps)"
                )
            if index.min() < 0 or index.max() >= len(part):
                raise CommandError(f"{path}: index: got rows up to {index.max()} of {name}; wanted at most {len(part)}")
            parts.append(part.take(index))
            rows.append(own)
        return concatenate(parts).take(np.argsort(np.concatenate(rows), kind="stable"))

    def _ranked(
        self, candidates: "Candidates", disturbances: "DisturbanceSet"
    ) -> "tuple[Candidates, dict[str, np.ndarray]]":
        """The candidates, the best first, and their table."""
        from jaxgrasp.cli.report import Clock, progress_bar
        from jaxgrasp.ranking import RankingInterrupted, rank
        from jaxgrasp.ranking.table import ranking_table

        settings = {"gravity": self.gravity, "cone_edges": self.cone_edges}
        try:
            with progress_bar(len(candidates), Clock()) as progress:
                ranking = rank(candidates, disturbances, **settings, top=0, progress=progress)
        except RankingInterrupted as interruption:
            reason = interruption.__cause__
            if isinstance(reason, KeyboardInterrupt):
                raise CommandError(signals.word(), 130) from interruption
            raise CommandError(str(reason) or type(reason).__name__, 1) from interruption
        return candidates.take(ranking.order), ranking_table(ranking)

    def _serve(self, viewed: "Viewed") -> None:
        from jaxgrasp.viewer.browser.server import served

        with served(viewed, self.host, self.port) as address:
            with printing():
                print(f"{len(viewed):,} grasps at {address} (Ctrl-C ends)", flush=True)
            tell_notices()
            try:
                while True:
                    signals.checkpoint()
                    time.sleep(_PATIENCE)
            except KeyboardInterrupt:
                return


def _bodies(candidates: "Candidates", hands: "list[HandObject]") -> Callable:
    from jaxgrasp.viewer.bodies import bodies_along

    columns = candidates.columns

    def of_candidate(row: int):
        hand = hands[int(columns["scene"][row]) if "scene" in columns else 0]
        return bodies_along(hand, columns["qpos"][row][None])

    return of_candidate
