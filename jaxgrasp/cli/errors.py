"""The error of a command that its caller can mend."""


class CommandError(Exception):
    """Something that the caller can mend, in one line."""

    exit_code = 2
