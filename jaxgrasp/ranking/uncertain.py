"""What candidates are worth whose friction, contacts or masses are not known exactly."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxgrasp.candidates import Candidates
from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.ranking.tiles import columns_of, solve_in_tiles
from jaxgrasp.uncertainty import Uncertainty, margin_distribution

P_HOLD, QUANTILE, TAIL_MEAN = "p_hold", "margin_quantile", "margin_tail_mean"
COLUMNS = (P_HOLD, QUANTILE, TAIL_MEAN, "margin_mean", "p_hold_error", "margin_quantile_error")
"""The names of all that is found, beside other metrics."""
BY = {"p_hold": P_HOLD, "quantile": QUANTILE, "tail_mean": TAIL_MEAN}
"""What can rank, by the names of the option."""
# Margins are solved by the thousand for each of them.
_TILE = 2048


@dataclass(frozen=True, kw_only=True)
class Uncertain:
    """What is not known of candidates, and what is asked about it."""

    uncertainty: Uncertainty
    """The distributions."""
    by: str = "p_hold"
    """What ranks, one of `BY`."""
    load: float = 1.0
    """p_hold is the probability that the margin is at least this."""
    quantile: float = 0.1
    """The level of `margin_quantile`, and the share of the draws whose mean margin is `margin_tail_mean`."""
    samples: int | None = None
    """How many draws; None is 1,000, or as many as are given."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all that is found; the first ranks."""
        return (BY[self.by], *(name for name in COLUMNS if name != BY[self.by]))

    def __call__(self, contacts: Contacts, disturbances: DisturbanceSet, task: dict[str, Any], _: Any) -> Any:
        """Solves a tile, see `solve_in_tiles`: arrays by name."""
        found = margin_distribution(
            contacts,
            disturbances,
            self.uncertainty,
            quantiles=(self.quantile,),
            at_least=(self.load,),
            tail=self.quantile,
            samples=self.samples,
            **task,
        )
        hold, quantile = (jax.tree.map(lambda x: x[..., 0], x) for x in (found.at_least, found.quantiles))
        means = found.tail_mean.value, found.mean.value
        values = hold.value, quantile.value, *means, hold.error, quantile.error
        return dict(zip(COLUMNS, values, strict=True))


def uncertain_scores(
    candidates: Candidates,
    uncertain: Uncertain,
    disturbances: DisturbanceSet,
    *,
    gravity: float = 0.0,
    cone_edges: int = 8,
    progress: Callable[[int], None] | None = None,
    stream: bool = False,
) -> dict[str, Float[np.ndarray, " batch"]]:
    """Finds how probably all candidates hold, and a quantile of their margins.

    Args:
        candidates: What is asked about.
        uncertain: What is not known of them.
        disturbances: The set that the margins scale.
        gravity: m/s^2 along the object's -z, for which the candidates' masses must be borne; zero for none.
        cone_edges: Edges of the friction pyramid.
        progress: Called with the number of candidates done.
        stream: Whether other batches of other lengths follow, see `solve_in_tiles`.

    Returns:
        Columns (N,) by name, that which ranks first; NaN where there is no answer.

    Raises:
        ValueError: The uncertainty does not fit the candidates.
    """
    values = {name: np.empty(len(candidates)) for name in uncertain.names}
    settings = {"gravity": gravity, "cone_edges": cone_edges, "tile": _TILE, "stream": stream}
    for rows, found in solve_in_tiles(uncertain, columns_of(candidates), disturbances, **settings):
        for name, value in found.items():
            values[name][rows] = value + 0.0  # minus zero is zero
        if progress is not None:
            progress(rows.stop)
    return values
