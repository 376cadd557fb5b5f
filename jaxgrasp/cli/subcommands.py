"""The subcommands by name."""

from collections.abc import Sequence

import tyro

from jaxgrasp.cli.compare import Compare
from jaxgrasp.cli.convert import Convert
from jaxgrasp.cli.evaluate import Evaluate
from jaxgrasp.cli.pieces import Pieces
from jaxgrasp.cli.rank import Rank
from jaxgrasp.cli.squeeze import Squeeze
from jaxgrasp.cli.synthesize import Synthesize
from jaxgrasp.cli.view import View


def parsed(
    arguments: Sequence[str] | None,
) -> Compare | Convert | Evaluate | Pieces | Rank | Squeeze | Synthesize | View:
    """Parses a command line.

    Args:
        arguments: What follows the program's name; the process's own where None.

    Raises:
        SystemExit: Help was asked for and printed, or the options cannot be understood.
    """
    return tyro.extras.subcommand_cli_from_dict(
        {
            "rank": Rank,
            "synthesize": Synthesize,
            "compare": Compare,
            "convert": Convert,
            "squeeze": Squeeze,
            "evaluate": Evaluate,
            "view": View,
            "pieces": Pieces,
        },
        prog="jaxgrasp",
        description="Robustness of multi-fingered grasps, in batch.",
        args=arguments,
    )
