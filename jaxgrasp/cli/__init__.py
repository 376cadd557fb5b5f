"""The command `jaxgrasp`, one file a subcommand."""

from jaxgrasp.cli.main import main, program

__all__ = ["main", "program"]
