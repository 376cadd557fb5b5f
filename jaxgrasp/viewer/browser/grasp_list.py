"""The list of grasps on the page: sorted by any column, a page of rows at a time."""

import html
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxgrasp.viewer.browser.viewed import Viewed

ROWS = 10
# Characters of a cell.
_WIDEST = 26
_TABLE = "width:100%;font-size:12px;text-align:left;border-collapse:collapse"


class GraspList:
    """Some rows of the table, and what chooses one of them."""

    def __init__(self, gui: Any, viewed: Viewed, chosen: Callable[[int], None]):
        """Lays it out.

        Args:
            gui: Of one browser, viser's `GuiApi`.
            viewed: The grasps.
            chosen: Called with the row that was chosen.
        """
        self._viewed, self._chosen = viewed, chosen
        self.row, self._first = 0, 0
        with gui.add_folder(f"{len(viewed):,} grasps"):
            self._column = gui.add_dropdown("sorted by", options=viewed.columns, initial_value=viewed.columns[0])
            self._falling = gui.add_checkbox("largest first", True)
            self._table = gui.add_html("")
            self._turn = gui.add_button_group("page", ("first", "back", "next", "last"))
            self._rows = gui.add_button_group("show", ("1",))
            self._place = gui.add_number("place", 1, min=1, max=len(viewed), step=1)
        # As the table came: a ranking has its own order of equal ones, and of those without a margin.
        self._order = np.arange(len(viewed))
        self._column.on_update(lambda event: event.client and self._sort())
        self._falling.on_update(lambda event: event.client and self._sort())
        self._turn.on_click(lambda event: self._turn_to(self._turn.value))
        self._rows.on_click(lambda event: self.choose(int(self._rows.value) - 1))
        self._place.on_update(lambda event: event.client and self.choose(int(self._place.value) - 1))
        self._show()

    def choose(self, place: int) -> None:
        """Shows the grasp at a place of the present order, and its page of the list."""
        place = min(max(place, 0), len(self._order) - 1)
        self.row = int(self._order[place])
        self._place.value = place + 1
        self._first = place // ROWS * ROWS
        self._show()
        self._chosen(self.row)

    def row_at(self, place: int) -> int:
        """The row of the grasp at a place of the present order."""
        return int(self._order[place])

    def _sort(self) -> None:
        self._order = self._viewed.sorted_by(self._column.value, self._falling.value)
        self.choose(0)

    def _turn_to(self, where: str) -> None:
        last = (len(self._order) - 1) // ROWS * ROWS
        steps = {"first": 0, "back": self._first - ROWS, "next": self._first + ROWS, "last": last}
        self._first = min(max(steps[where], 0), last)
        self._show()

    def _show(self) -> None:
        places = range(self._first, min(self._first + ROWS, len(self._order)))
        names = [name for name in ("margin", self._column.value) if name in self._viewed.table]
        names = list(dict.fromkeys(names))
        head = "".join(f"<th>{_text(name)}</th>" for name in ("place", "grasp", *names))
        lines = []
        for place in places:
            row = int(self._order[place])
            cells = [str(place + 1), self._viewed.name(row), *(_cell(self._viewed.table[name][row]) for name in names)]
            style = " style='background:#cfe3f5'" if row == self.row else ""
            lines.append(f"<tr{style}>{''.join(f'<td>{_text(cell)}</td>' for cell in cells)}</tr>")
        table = f"<table style='{_TABLE}'><tr>{head}</tr>{''.join(lines)}</table>"
        self._table.content = f"<div style='padding:0 0.8em'>{table}</div>"
        self._rows.options = tuple(str(place + 1) for place in places)


def _text(cell: str) -> str:
    """A cell whose text is from a file, which is no HTML."""
    return html.escape(cell if len(cell) <= _WIDEST else f"...{cell[3 - _WIDEST :]}")


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, np.floating) else str(value)
