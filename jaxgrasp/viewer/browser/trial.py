"""A trial of the chosen grasp in MuJoCo, played back on the page."""

import html
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxgrasp.viewer.bodies import Film
from jaxgrasp.viewer.browser.shapes import load_shape
from jaxgrasp.viewer.browser.stage import Stage
from jaxgrasp.viewer.browser.viewed import Viewed

# s between two pictures.
_PICTURE = 0.05
_STILL = ("hand", "object", "contacts", "forces", "disturbance", "numbers")


class TrialPlayer:
    """Tries the grasp that the page shows, and plays what happened."""

    def __init__(
        self,
        gui: Any,
        scene: Any,
        viewed: Viewed,
        row: Callable[[], int],
        still: Stage,
        closed: threading.Event,
    ):
        """Lays it out.

        Args:
            gui: Of one browser, viser's `GuiApi`.
            scene: Likewise, viser's `SceneApi`.
            viewed: The grasps.
            row: The grasp that the page shows.
            still: Where that is drawn: it is hidden while a trial is shown.
            closed: Set once the browser has gone.
        """
        self._viewed, self._row, self._still, self._closed = viewed, row, still, closed
        self._film: Film | None = None
        self._stage = Stage(scene, "trial")
        self._busy = threading.Lock()
        with gui.add_folder("Trial in MuJoCo", expand_by_default=False):
            self._protocol = gui.add_dropdown("protocol", options=viewed.protocols, initial_value=viewed.protocols[0])
            self._try = gui.add_button("try this grasp")
            self._said = gui.add_html("")
            self._time = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0, disabled=True)
            self._play = gui.add_button("play", disabled=True)
            self._leave = gui.add_button("back to the grasp", disabled=True)
        self._try.on_click(lambda _: self._alone(self._run))
        self._play.on_click(lambda _: self._alone(self._run_through))
        self._time.on_update(lambda event: event.client and self._show_moment())
        self._leave.on_click(lambda _: self._end())

    def _alone(self, work: Callable[[], None]) -> None:
        """One thing at a time: who presses a button again is passed over."""
        if self._busy.acquire(blocking=False):
            try:
                work()
            finally:
                self._busy.release()

    def _run(self) -> None:
        assert self._viewed.film is not None
        row = self._row()
        self._tell("trying ...")
        try:
            film = self._viewed.film(row, self._protocol.value)
        except ValueError as error:
            self._tell(f"not tried: {error}")
            return
        self._tell(f"{self._viewed.name(row)}: {film.outcome}")
        self._film = film
        self._stage.bodies("bodies", film.bodies)
        self._time.max, self._time.value = max(float(film.time[-1]), 0.01), 0.0
        for handle in (self._time, self._play, self._leave):
            handle.disabled = False
        self._run_through()

    def _run_through(self) -> None:
        film, begun = self._film, time.monotonic()
        while film is not None and film is self._film and not self._closed.is_set():
            passed = time.monotonic() - begun
            self._time.value = round(min(passed, float(film.time[-1])), 2)
            self._show_moment()
            if passed >= film.time[-1]:
                return
            time.sleep(_PICTURE)

    def _show_moment(self) -> None:
        if self._film is None:
            return
        for kind in _STILL:
            self._still.show(kind, False)
        self._stage.show("bodies", True)
        frame = min(int(np.searchsorted(self._film.time, self._time.value - 1e-9)), len(self._film.time) - 1)
        self._stage.move(self._film.bodies, frame)
        arrow = load_shape(self._film.load[frame], self._viewed.reach(self._row()))
        self._stage.draw("load", [] if arrow is None else [arrow])

    def _end(self) -> None:
        self._film = None
        for handle in (self._time, self._play, self._leave):
            handle.disabled = True
        for kind in _STILL:
            self._still.show(kind, True)
        self._stage.show("bodies", False)
        self._stage.draw("load", [])

    def _tell(self, text: str) -> None:
        self._said.content = f"<div style='padding:0 0.8em;font-size:12px'>{html.escape(text)}</div>"
