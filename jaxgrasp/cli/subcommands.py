"""The subcommands by name."""

from collections.abc import Sequence

import tyro

from jaxgrasp.cli.compare import Compare
from jaxgrasp.cli.convert import Convert
from jaxgrasp.cli.rank import Rank
from jaxgrasp.cli.synthesize import Synthesize


def parsed(arguments: Sequence[str] | None) -> Compare | Convert | Rank | Synthesize:
    """Parses a command line.

    Args:
        arguments: What follows the program's name; the process's own where None.

    Raises:
        SystemExit: Help was asked for and printed, or the options cannot be understood.
    """
    return tyro.extras.subcommand_cli_from_dict(
        {"rank": Rank, "synthesize": Synthesize, "compare": Compare, "convert": Convert},
        prog="jaxgrasp",
        description="Robustness of multi-fingered grasps, in batch.",
        args=arguments,
    )
