"""The command `jaxgrasp`, one file a subcommand."""

from jaxgrasp.cli.main import main

__all__ = ["main"]
