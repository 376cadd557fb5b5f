"""What one browser shows: every browser has a page of its own."""

import threading
import time
from typing import Any

import numpy as np

from jaxgrasp.viewer.browser.comparison import Comparison
from jaxgrasp.viewer.browser.controls import Controls
from jaxgrasp.viewer.browser.grasp_list import GraspList
from jaxgrasp.viewer.browser.latest import Latest
from jaxgrasp.viewer.browser.report import report
from jaxgrasp.viewer.browser.shapes import (
    body_shapes,
    contact_shapes,
    disturbance_shapes,
    force_shapes,
    load_shape,
    newtons_per_metre,
)
from jaxgrasp.viewer.browser.stage import UNITS, Stage
from jaxgrasp.viewer.browser.trial import TrialPlayer
from jaxgrasp.viewer.browser.viewed import Viewed
from jaxgrasp.viewer.browser.what_if import Answer, Reasons, answer, reasons

# s of the disturbance played, and of a picture of it.
_SECONDS, _PICTURE = 4.0, 0.05
# Where the camera stands, in units of the farthest contact's distance from the centre of mass.
_CAMERA = np.array([3.2, 2.4, 2.0])
# Times as far where there is a hand.
_FARTHER = 1.6
_KINDS = ("hand", "object", "contacts", "forces", "disturbance", "numbers")


class Page:
    """A list, sliders, and one grasp in 3D or two."""

    def __init__(self, client: Any, viewed: Viewed):
        """Lays it out and shows the first grasp.

        Args:
            client: One browser, viser's `ClientHandle`.
            viewed: The grasps.
        """
        self._client, self._viewed = client, viewed
        self._closed = threading.Event()
        # Of its scene: grasps are drawn by whoever has chosen, solved or played something.
        self._drawing = threading.RLock()
        self._playing = threading.Lock()
        self._found: tuple[int, Answer, Reasons | None] | None = None
        gui = client.gui
        self._stage = Stage(client.scene, "grasp")
        self._follow = Latest(self._solve)
        self._list = GraspList(gui, viewed, self._choose)
        with gui.add_folder("This grasp"):
            self._said = gui.add_html("")
            self._play = gui.add_button("play the worst disturbance")
        self._controls = Controls(gui, viewed, self._follow)
        self._beside = Comparison(gui, client.scene, viewed, self._list.row_at, self._show_both)
        self._trial = None
        if viewed.film is not None:
            self._trial = TrialPlayer(gui, client.scene, viewed, lambda: self._list.row, self._stage, self._closed)
        with gui.add_folder("Show", expand_by_default=False):
            for kind in _KINDS:
                box = gui.add_checkbox(kind, True)
                box.on_update(lambda event, kind=kind: self._stage.show(kind, event.target.value))
        self._play.on_click(lambda _: self._play_worst())
        self._choose(self._list.row)

    def close(self) -> None:
        """Ends what plays."""
        self._closed.set()

    def _choose(self, row: int) -> None:
        """Shows a grasp as it is."""
        self._controls.start(row)
        viewed, reach = self._viewed, self._viewed.reach(row)
        with self._drawing, self._client.atomic():
            if viewed.bodies is None:
                self._stage.dots("object", viewed.surface(row), reach)
            else:
                shapes = body_shapes(viewed.bodies(row))
                for kind in ("hand", "object"):
                    self._stage.draw(kind, [shape for shape in shapes if shape.name.startswith(kind)])
        if self._found is None:
            self._look()
        self._follow()

    def _look(self) -> None:
        """Turns the camera to the grasp, or to two of them."""
        beside = self._beside.offset
        distance = self._viewed.reach(self._list.row) * (1.0 if self._viewed.bodies is None else _FARTHER)
        self._client.camera.position = (_CAMERA * distance * (1.0 if beside is None else _FARTHER)) * UNITS
        self._client.camera.look_at = np.zeros(3) if beside is None else 0.5 * beside * UNITS

    def _solve(self) -> None:
        row, change = self._list.row, self._controls.change
        found = answer(self._viewed, row, change)
        self._found = row, found, None
        self._tell(change.share)
        self._draw()
        if self._follow.overtaken() or self._closed.is_set():
            return
        self._found = row, found, reasons(self._viewed, row, change)
        self._tell(change.share)
        self._draw()

    def _tell(self, share: float) -> None:
        assert self._found is not None
        row, found, why = self._found
        self._said.content = report(self._viewed.name(row), found, why, self._viewed.unit, share)

    def _draw(self) -> None:
        """Draws what was found, and the grasp beside it, with one scale of forces."""
        if self._found is None:
            return
        row, found, why = self._found
        reach = self._viewed.reach(row)
        scale = max(newtons_per_metre(found.forces, reach), self._beside.scale())
        binding = None if why is None else why.binding
        load = load_shape(-found.load[:3], reach)
        with self._drawing, self._client.atomic():
            self._stage.draw("contacts", contact_shapes(found, reach, binding))
            self._stage.draw("forces", force_shapes(found, found.forces, reach, scale))
            worst = [] if why is None else list(disturbance_shapes(why, reach))
            self._stage.draw("disturbance", worst + ([] if load is None else [load]))
            places = found.positions + 0.25 * reach * found.normals
            here = np.flatnonzero(found.active & np.isfinite(places).all(-1)).tolist()
            ends = lambda number: f"{number} ends the margin" if number == binding else str(number)
            self._stage.label("numbers", [(ends(number), places[number]) for number in here])
            self._beside.draw(scale)

    def _show_both(self) -> None:
        self._look()
        self._draw()

    def _play_worst(self) -> None:
        """The disturbance grows to the share of the margin and ends again; the fingers answer it."""
        if self._found is None or self._found[2] is None or not self._playing.acquire(blocking=False):
            return
        try:
            self._play_through(self._found)
        finally:
            self._playing.release()
        self._draw()

    def _play_through(self, played: Any) -> None:
        row, found, why = played
        reach, change = self._viewed.reach(row), self._controls.change
        most = change.share * found.margin if np.isfinite(found.margin) else 0.0
        scale = newtons_per_metre(found.forces + np.nan_to_num(most * why.answers), reach)
        scale = max(newtons_per_metre(found.forces, reach), scale, self._beside.scale())
        begun = time.monotonic()
        while (passed := time.monotonic() - begun) < _SECONDS and self._found is played and not self._closed.is_set():
            size = 1.0 - abs(2.0 * passed / _SECONDS - 1.0)
            with self._drawing, self._client.atomic():
                forces = found.forces + size * most * np.nan_to_num(why.answers)
                self._stage.draw("forces", force_shapes(found, forces, reach, scale))
                self._stage.draw("disturbance", disturbance_shapes(why, reach, size))
            time.sleep(_PICTURE)
