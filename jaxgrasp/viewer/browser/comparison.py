"""A second grasp on the page, beside the first."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxgrasp.viewer.browser.latest import Latest
from jaxgrasp.viewer.browser.report import report
from jaxgrasp.viewer.browser.shapes import body_shapes, contact_shapes, force_shapes, newtons_per_metre
from jaxgrasp.viewer.browser.stage import Stage
from jaxgrasp.viewer.browser.viewed import Viewed
from jaxgrasp.viewer.browser.what_if import Answer, Change, Reasons, answer, reasons

# How far it stands from the first, in units of the farthest contact's distance from the centre of mass.
_APART = 3.5
# To the right as one first looks at it.
_ASIDE = np.array([-0.6, 0.8, 0.0])


class Comparison:
    """Another grasp of the list as it is by itself."""

    def __init__(self, gui: Any, scene: Any, viewed: Viewed, row_at: Callable[[int], int], changed: Callable[[], None]):
        """Lays it out.

        Args:
            gui: Of one browser, viser's `GuiApi`.
            scene: Likewise, viser's `SceneApi`.
            viewed: The grasps.
            row_at: The row of the grasp at a place of the list.
            changed: Called when another grasp, or none, stands there.
        """
        self._scene, self._viewed, self._row_at, self._changed = scene, viewed, row_at, changed
        self._stage: Stage | None = None
        self._found: tuple[int, Answer, Reasons] | None = None
        follow = Latest(self._solve)
        with gui.add_folder("Beside it", expand_by_default=False):
            self._shown = gui.add_checkbox("another grasp", False)
            self._place = gui.add_number("its place", min(2, len(viewed)), min=1, max=len(viewed), step=1)
            self._said = gui.add_html("")
        for handle in (self._shown, self._place):
            handle.on_update(lambda event: event.client and follow())

    @property
    def offset(self) -> Float[np.ndarray, "3"] | None:
        """Where its centre of mass stands, m; None where there is none."""
        return None if self._found is None else _ASIDE * _APART * self._viewed.reach(self._found[0])

    def scale(self) -> float:
        """N for each m with which its forces are drawn; 0 without any."""
        if self._found is None:
            return 0.0
        row, found, _ = self._found
        return newtons_per_metre(found.forces, self._viewed.reach(row))

    def draw(self, scale: float) -> None:
        """Draws its forces with another scale, N for each m of the drawing."""
        if self._found is not None and self._stage is not None:
            row, found, _ = self._found
            self._stage.draw("forces", force_shapes(found, found.forces, self._viewed.reach(row), scale))

    def _solve(self) -> None:
        self._found = None
        self._said.content = ""
        if self._stage is not None:
            self._stage.remove()
            self._stage = None
        if self._shown.value:
            row, change = self._row_at(int(self._place.value) - 1), Change(share=self._viewed.share)
            found, why = answer(self._viewed, row, change), reasons(self._viewed, row, change)
            self._said.content = report(self._viewed.name(row), found, why, self._viewed.unit, change.share)
            self._stage = self._set_up(row, found, why)
            self._found = row, found, why
        self._changed()

    def _set_up(self, row: int, found: Answer, why: Reasons) -> Stage:
        """Draws all but the forces."""
        reach = self._viewed.reach(row)
        stage = Stage(self._scene, "beside", _ASIDE * _APART * reach)
        if self._viewed.bodies is None:
            stage.dots("object", self._viewed.surface(row), reach)
        else:
            stage.draw("bodies", body_shapes(self._viewed.bodies(row)))
        stage.draw("contacts", contact_shapes(found, reach, why.binding))
        return stage
