"""Errors that end an experiment."""

from protocol.wire.errors import TransportError
from protocol.wire.exit_codes import EXIT_USAGE


class ExperimentError(TransportError, RuntimeError):
    """An experiment that cannot be started or completed: one line for the user, and exit code of the process."""

    def __init__(self, text: str, exit_code: int = EXIT_USAGE) -> None:
        super().__init__(text)
        self.exit_code = exit_code


def refused(option: str, expected: str, got: object, exit_code: int = EXIT_USAGE) -> ExperimentError:
    """Return the error for a wrong option."""
    return ExperimentError(f"{option}: expected {expected}, got {got}", exit_code)
