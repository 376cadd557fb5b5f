"""How margins are distributed, in a few kilobytes that add up: counts by status and a histogram of positive margins."""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxgrasp.solvers.status import Status

# A margin below this, in multiples of the disturbance set, is none: the solver's own tolerance.
NOTHING = 1e-6
# Bins of the logarithm, so many for each doubling, from the smallest margin on: 0.3 % wide.
_A_DOUBLING, _DOUBLINGS = 256, 64
_BINS = _A_DOUBLING * _DOUBLINGS


@dataclass(frozen=True, kw_only=True)
class Sketch:
    """Counts of candidates; sketches of parts add up to that of the whole."""

    statuses: Int[np.ndarray, " statuses"]
    """How many candidates have each `Status`."""

    margins: Int[np.ndarray, " bins"]
    """How many SOLVED candidates have a margin above `NOTHING` in each bin; the last bin has all that are larger."""

    @classmethod
    def of(cls, margin: Float[np.ndarray, " batch"], status: Int[np.ndarray, " batch"]) -> "Sketch":
        """The sketch of some candidates.

        Args:
            margin: lambda of (21).
            status: `Status` of (21).
        """
        positive = margin[(status == Status.SOLVED) & (margin > NOTHING)]
        places = (np.log2(positive / NOTHING) * _A_DOUBLING).astype(np.int64)
        return cls(
            statuses=np.bincount(status, minlength=len(Status)),
            margins=np.bincount(np.clip(places, 0, _BINS - 1), minlength=_BINS),
        )

    @classmethod
    def sum(cls, sketches: "Sequence[Sketch]") -> "Sketch":
        """The sketch of all candidates of several."""
        first = cls.of(np.empty(0), np.empty(0, dtype=int))
        return cls(
            statuses=sum((sketch.statuses for sketch in sketches), first.statuses),
            margins=sum((sketch.margins for sketch in sketches), first.margins),
        )

    @classmethod
    def from_json(cls, text: str | bytes) -> "Sketch":
        """Reads what `to_json` wrote."""
        found = json.loads(text)
        margins = np.zeros(_BINS, dtype=np.int64)
        margins[np.array(found["bins"], dtype=np.int64)] = found["counts"]
        return cls(statuses=np.array(found["statuses"], dtype=np.int64), margins=margins)

    def to_json(self) -> str:
        """The counts that are not zero."""
        bins = np.flatnonzero(self.margins)
        return json.dumps(
            {"statuses": self.statuses.tolist(), "bins": bins.tolist(), "counts": self.margins[bins].tolist()}
        )

    @property
    def count(self) -> int:
        """Number of candidates."""
        return int(self.statuses.sum())

    @property
    def positive(self) -> int:
        """Number of SOLVED candidates with a margin above `NOTHING`."""
        return int(self.margins.sum())

    @property
    def edges(self) -> Float[np.ndarray, " bins_and_one"]:
        """Where the bins begin and end."""
        return NOTHING * 2.0 ** (np.arange(_BINS + 1) / _A_DOUBLING)

    @property
    def median(self) -> float:
        """The median of the positive margins to 0.2 %; NaN without any."""
        if not self.positive:
            return float("nan")
        place = int(np.searchsorted(np.cumsum(self.margins), (self.positive + 1) / 2))
        return float(np.sqrt(self.edges[place] * self.edges[place + 1]))
