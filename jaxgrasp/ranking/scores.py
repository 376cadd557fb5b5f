"""Metrics of many candidates: in tiles where they take batches, else one grasp after the other."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxgrasp.candidates import Candidates
from jaxgrasp.contact import Contacts
from jaxgrasp.disturbance import DisturbanceSet
from jaxgrasp.metrics import METRICS, Setting
from jaxgrasp.ranking.tiles import columns_of, contacts_of, load_of, solve_in_tiles

# Dense programs of all candidates of a tile are solved at once, some tens of kilobytes each.
_TILE = 1024


def check_metrics(names: Sequence[str]) -> None:
    """Whether all names are those of metrics.

    Raises:
        ValueError: one is not.
    """
    for name in names:
        if name not in METRICS:
            raise ValueError(f"metric: got {name!r}; wanted one of {', '.join(METRICS)}")


def score(
    candidates: Candidates,
    name: str,
    disturbances: DisturbanceSet,
    *,
    gravity: float = 0.0,
    cone_edges: int = 8,
    progress: Callable[[int], None] | None = None,
) -> Float[np.ndarray, " batch"]:
    """One metric of all candidates.

    Args:
        candidates: What is measured.
        name: Of the metric, one of `METRICS`.
        disturbances: The set that the margin and the task wrenches scale.
        gravity: m/s^2 along the object's -z, for which the candidates' masses must be borne; of the margins alone.
        cone_edges: Edges of the friction pyramid.
        progress: Called with the number of candidates done.

    Returns:
        (N,), NaN where there is no answer.

    Raises:
        ValueError: There is no such metric, or it cannot take the disturbances.
        ImportError: It needs SciPy, which is missing.
    """
    check_metrics([name])
    report = progress or (lambda _: None)
    columns, values = columns_of(candidates), np.empty(len(candidates))
    if METRICS[name].under_jit(disturbances):
        settings = {"gravity": gravity, "cone_edges": cone_edges, "tile": None if name == "margin" else _TILE}
        for rows, value in solve_in_tiles(_scorer(name, cone_edges), columns, disturbances, **settings):
            values[rows] = value + 0.0  # minus zero is zero
            report(rows.stop)
        return values
    if METRICS[name].batched:
        for start in range(0, len(values), _TILE):
            some = {key: column[start : start + _TILE] for key, column in columns.items()}
            task = {"required_wrench": load_of(some, gravity)}
            setting = Setting(disturbances=disturbances, cone_edges=cone_edges, task=task)
            values[start : start + _TILE] = METRICS[name].value(contacts_of(some), setting)
            report(min(start + _TILE, len(values)))
        return values
    setting = Setting(disturbances=disturbances, cone_edges=cone_edges, task={})
    contacts = jax.tree.map(np.asarray, contacts_of(columns))
    # A grasp with more contacts than a metric can take is refused first, not after hours.
    for done, row in enumerate(np.argsort(-candidates.active.sum(1), kind="stable"), 1):
        values[row] = METRICS[name].value(jax.tree.map(lambda leaf, at=row: leaf[at], contacts), setting)
        report(done)
    return values


@functools.cache
def _scorer(name: str, cone_edges: int) -> Callable[..., Any]:
    # One function for a metric, so that its program is compiled once.
    def solve(contacts: Contacts, disturbances: DisturbanceSet, task: dict[str, Any], _: Any) -> jax.Array:
        rest = {key: value for key, value in task.items() if key != "cone_edges"}
        setting = Setting(disturbances=disturbances, cone_edges=cone_edges, task=rest)
        return METRICS[name].value(contacts, setting).astype(contacts.positions.dtype)

    return solve
