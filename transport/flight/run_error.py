"""The error of a run that could not be started or recorded."""

from protocol.wire.errors import TransportError


class RunError(TransportError, RuntimeError):
    """A run that could not be started or recorded: one line for the user, and the exit code of the command."""

    def __init__(self, text: str, exit_code: int) -> None:
        super().__init__(text)
        self.exit_code = exit_code
