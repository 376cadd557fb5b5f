"""`python -m jaxgrasp.cli`."""

from jaxgrasp.cli import program

program()
