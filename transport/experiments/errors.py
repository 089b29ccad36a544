"""Errors that end an experiment."""

from protocol.wire.exit_codes import EXIT_USAGE


class ExperimentError(RuntimeError):
    """An experiment that cannot be started or completed.

    Args:
        text: One line for the user.
        exit_code: Exit code of the process (docs/command-line.md).
    """

    def __init__(self, text: str, exit_code: int = EXIT_USAGE) -> None:
        super().__init__(text)
        self.exit_code = exit_code


def refused(option: str, expected: str, got: object, exit_code: int = EXIT_USAGE) -> ExperimentError:
    """Return the error for a wrong option."""
    return ExperimentError(f"{option}: expected {expected}, got {got}", exit_code)
