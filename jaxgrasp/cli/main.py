"""Parses the command line and answers with an exit code."""

import sys
from collections.abc import Sequence

import tyro

from jaxgrasp.cli.compare import Compare
from jaxgrasp.cli.problems import CommandError
from jaxgrasp.cli.rank import Rank
from jaxgrasp.cli.synthesize import Synthesize


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command `jaxgrasp`.

    Args:
        arguments: What follows the program's name; the process's own where None.

    Returns:
        The exit code: 0, 2 for what the caller can mend (one line on standard error says what), 130 after Ctrl-C,
        1 where the computation itself failed.
    """
    command = tyro.extras.subcommand_cli_from_dict(
        {"rank": Rank, "synthesize": Synthesize, "compare": Compare},
        prog="jaxgrasp",
        description="Robustness of multi-fingered grasps, in batch.",
        args=arguments,
    )
    try:
        return command.run()
    except CommandError as error:
        print(f"jaxgrasp: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("jaxgrasp: interrupted, nothing was written", file=sys.stderr)
        return 130
