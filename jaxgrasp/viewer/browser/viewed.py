"""The grasps behind the page: what there is to list, and what each of them is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.candidates import Candidates
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.viewer.bodies import Bodies, Film

# Dots that hint at the surface of an object without a mesh.
_SURFACE_POINTS = 1500


@dataclass(frozen=True, kw_only=True)
class Viewed:
    """Grasps with a table of what is known of them, and the task that their margins are of."""

    candidates: Candidates
    """The grasps, in the order in which the page first lists them."""

    table: dict[str, np.ndarray]
    """What is listed: arrays with a leading axis of N by name, `margin` among them."""

    disturbances: DisturbanceSet
    """The set D that margins scale."""

    unit: str
    """Unit of the margin."""

    gravity: float = 0.0
    """Along the object's -z, m/s^2, under which masses must be borne; 0 for none."""

    cone_edges: int = 8
    """Edges of the friction pyramid."""

    share: float = 0.75
    """The part of the margin for which tightening forces are first shown."""

    bodies: Callable[[int], Bodies] | None = None
    """Hand and object of a grasp, by its row; None where there is no scene."""

    film: Callable[[int, str], Film] | None = None
    """The trial of a grasp, by its row and the name of a protocol with a course; None where nothing can be tried."""

    protocols: tuple[str, ...] = ()
    """The names that `film` knows."""

    def __len__(self) -> int:
        """Returns the number of grasps."""
        return len(self.candidates)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns with one number or text for each grasp, which the list can be sorted by."""
        fitting = [name for name, value in self.table.items() if value.ndim == 1 and value.dtype.kind in "biufU"]
        return tuple(sorted(fitting, key=lambda name: name != "margin"))

    def sorted_by(self, name: str, largest_first: bool) -> Int[np.ndarray, " batch"]:
        """The rows in the order of a column, equals by their row, NaN last.

        Args:
            name: One of `columns`.
            largest_first: Whether the largest come first; of texts the last in the alphabet.
        """
        column = self.table[name]
        if column.dtype.kind == "U":
            column = np.unique(column, return_inverse=True)[1]
        key = column.astype(float)
        return np.argsort(-key if largest_first else key, kind="stable")

    def name(self, row: int) -> str:
        """The file of a grasp, and its row there."""
        source = self.candidates.sources[self.candidates.source[row]]
        return f"{Path(source).name}:{self.candidates.index[row]}"

    def reach(self, row: int) -> float:
        """How far the farthest contact of a grasp is from the centre of mass, m."""
        points = self.candidates.positions[row][self.candidates.active[row]]
        longest = np.linalg.norm(points, axis=-1).max(initial=0.0)
        return float(longest) if 0.0 < longest < np.inf else 0.05

    def surface(self, row: int) -> Float[np.ndarray, "points 3"]:
        """The contacts of all grasps of the same object, m, object frame: they hint at its surface."""
        candidates = self.candidates
        same = candidates.source == candidates.source[row]
        if "object_name" in candidates.columns:
            same = candidates.columns["object_name"] == candidates.columns["object_name"][row]
        rows = np.flatnonzero(same)[: _SURFACE_POINTS // candidates.num_contacts]
        points = candidates.positions[rows][candidates.active[rows]]
        return points[np.isfinite(points).all(-1)]
