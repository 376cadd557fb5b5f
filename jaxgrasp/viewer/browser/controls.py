"""The sliders on the page: friction, load, share, and where contacts are."""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxgrasp.viewer.browser.viewed import Viewed
from jaxgrasp.viewer.browser.what_if import Change, load_size

_MILLIMETRES = 1e3
# Times its own, the most friction; N, where nothing has a limit; mm, the farthest that a contact can be moved.
_MOST_FRICTION, _MOST_LOAD, _FARTHEST = 2.0, 100.0, 20.0
_LOAD_HINT = "What the grasp must supply: against its own load, or against a weight along -z where it has none"
_MOVE_HINT = "Along the tangent plane; its normal, and what the hand can do there, stay"


class Controls:
    """What of a grasp is changed."""

    def __init__(self, gui: Any, viewed: Viewed, changed: Callable[[], None]):
        """Lays them out.

        Args:
            gui: Of one browser, viser's `GuiApi`.
            viewed: The grasps.
            changed: Called whenever somebody has moved a slider.
        """
        self._viewed, self._changed = viewed, changed
        self._row, self._own_load, self._contact = 0, 0.0, 0
        self._shifts = np.zeros((viewed.candidates.num_contacts, 2))
        contacts = tuple(map(str, range(viewed.candidates.num_contacts)))
        with gui.add_folder("What if"):
            self._friction = gui.add_slider("friction, times its own", 0.0, _MOST_FRICTION, 0.01, 1.0)
            self._load = gui.add_slider("load [N]", 0.0, _MOST_LOAD, 0.01, 0.0, hint=_LOAD_HINT)
            self._share = gui.add_slider("share of the margin", 0.01, 1.0, 0.01, min(max(viewed.share, 0.01), 1.0))
            self._number = gui.add_dropdown("contact to move", options=contacts, initial_value=contacts[0])
            self._moves = [
                gui.add_slider(f"along {name} [mm]", -_FARTHEST, _FARTHEST, 0.1, 0.0, hint=_MOVE_HINT)
                for name in ("t1", "t2")
            ]
            self._reset = gui.add_button("as it was")
        for slider in (self._friction, self._load, self._share, *self._moves):
            slider.on_update(lambda event: event.client and self._follow())
        self._number.on_update(lambda event: event.client and self._take_contact())
        self._reset.on_click(lambda _: self._undo())

    @property
    def change(self) -> Change:
        """What the sliders say."""
        load = float(self._load.value)
        return Change(
            friction=float(self._friction.value),
            load=None if load == self._load_step(self._own_load) else load,
            share=float(self._share.value),
            shifts=self._shifts.copy() if self._shifts.any() else None,
        )

    def start(self, row: int) -> None:
        """Sets all but the share to what a grasp is by itself."""
        self._row, self._own_load = row, load_size(self._viewed, row)
        self._shifts[:] = 0.0
        most = max(3.0 * self._own_load, float(self._viewed.candidates.max_force[row].sum()), 0.1)
        self._load.max = most if np.isfinite(most) else _MOST_LOAD
        self._friction.value, self._load.value = 1.0, self._load_step(self._own_load)
        for slider in self._moves:
            slider.value = 0.0

    def _load_step(self, load: float) -> float:
        return round(load, 2) if np.isfinite(load) else 0.0

    def _follow(self) -> None:
        self._shifts[self._contact] = [slider.value / _MILLIMETRES for slider in self._moves]
        self._changed()

    def _take_contact(self) -> None:
        self._contact = int(self._number.value)
        for slider, shift in zip(self._moves, self._shifts[self._contact], strict=True):
            slider.value = float(shift * _MILLIMETRES)

    def _undo(self) -> None:
        self.start(self._row)
        self._changed()
