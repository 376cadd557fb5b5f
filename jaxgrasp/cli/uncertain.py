"""The option --uncertainty: what is not known of candidates, and the columns that it makes."""

import math
from typing import TYPE_CHECKING

from jaxgrasp.cli.checks import check_options
from jaxgrasp.cli.errors import CommandError
from jaxgrasp.cli.rank_options import RankOptions

if TYPE_CHECKING:
    import numpy as np

    from jaxgrasp.candidates import Candidates
    from jaxgrasp.disturbance import DisturbanceSet
    from jaxgrasp.ranking import Uncertain


def uncertain_of(command: RankOptions) -> "Uncertain | None":
    """Reads the file of --uncertainty and checks its options; None without one.

    Raises:
        CommandError: An option cannot be used.
        FileError: The file cannot be used.
    """
    plain = RankOptions()
    names = ("by", "load", "quantile", "draws")
    if command.uncertainty is None:
        given = next((name for name in names if getattr(command, name) != getattr(plain, name)), None)
        if given:
            raise CommandError(f"--{given}: got no --uncertainty; wanted a file of distributions")
        return None
    if command.prune:
        raise CommandError("--prune: got --uncertainty, too; wanted a ranking by the margin alone")
    check_options(
        ("--load", command.load, 0.0 <= command.load < math.inf, "a number >= 0"),
        ("--quantile", command.quantile, 0.0 < command.quantile < 1.0, "a number in (0, 1)"),
        ("--draws", command.draws, command.draws is None or command.draws >= 1, "at least 1"),
    )
    from jaxgrasp.ranking import Uncertain
    from jaxgrasp.uncertainty import read_uncertainty

    uncertainty = read_uncertainty(command.uncertainty)
    count = uncertainty.sample_count()
    if count is not None and command.draws not in (None, count):
        raise CommandError(f"--draws: got {command.draws}; wanted {count}, as many as {command.uncertainty} gives")
    return Uncertain(
        uncertainty=uncertainty, by=command.by, load=command.load, quantile=command.quantile, samples=command.draws
    )


def uncertain_columns(
    candidates: "Candidates",
    uncertain: "Uncertain | None",
    disturbances: "DisturbanceSet",
    *,
    gravity: float,
    cone_edges: int,
) -> "dict[str, np.ndarray]":
    """The columns of all candidates, by name; none without an uncertainty.

    Raises:
        CommandError: The uncertainty does not fit the candidates.
    """
    if uncertain is None:
        return {}
    from jaxgrasp.cli.report import counting_bar
    from jaxgrasp.ranking import uncertain_scores

    with counting_bar("uncertainty", len(candidates)) as progress:
        try:
            return uncertain_scores(
                candidates, uncertain, disturbances, gravity=gravity, cone_edges=cone_edges, progress=progress
            )
        except ValueError as error:
            raise CommandError(f"--uncertainty: {' '.join(str(error).split())}") from error
