"""The error by which a command ends."""


class CommandError(Exception):
    """Why a command ends with another exit code than 0, in one line: mostly something that the caller can mend."""

    def __init__(self, message: str, exit_code: int = 2):
        """Takes the line and the exit code."""
        super().__init__(message)
        self.exit_code = exit_code
