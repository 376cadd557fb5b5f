"""The option --metric: names of metrics, and their values with a bar for each."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from jaxgrasp.cli.errors import CommandError

if TYPE_CHECKING:
    import numpy as np

    from jaxgrasp.candidates import Candidates
    from jaxgrasp.disturbance import DisturbanceSet


def metric_names(given: Sequence[str]) -> list[str]:
    """The names in a repeated option with commas, each once, in their order.

    Raises:
        CommandError: One is no metric; the message lists them all.
    """
    if not given:
        return []
    from jaxgrasp.ranking import check_metrics

    names = list(dict.fromkeys(name.strip() for part in given for name in part.split(",")))
    try:
        check_metrics(names)
    except ValueError as error:
        raise CommandError(f"--{error}") from error
    return names


def scores_of(
    candidates: "Candidates",
    names: Sequence[str],
    disturbances: "DisturbanceSet",
    *,
    gravity: float,
    cone_edges: int,
) -> "dict[str, np.ndarray]":
    """Every metric of all candidates, by name.

    Raises:
        CommandError: One cannot take the disturbances or the candidates, or needs SciPy, which is missing.
    """
    from jaxgrasp.cli.report import counting_bar
    from jaxgrasp.ranking import score

    found = {}
    for name in names:
        with counting_bar(name, len(candidates)) as progress:
            try:
                found[name] = score(
                    candidates, name, disturbances, gravity=gravity, cone_edges=cone_edges, progress=progress
                )
            except (ValueError, ImportError) as error:
                raise CommandError(f"--metric {name}: {' '.join(str(error).split())}") from error
    return found
