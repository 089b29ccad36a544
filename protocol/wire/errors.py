"""Base of the errors that a user can solve."""

from protocol.wire.exit_codes import EXIT_USAGE


class TransportError(Exception):
    """Error that a user can solve; its text is one line, the same on the command line and in Python."""

    exit_code = EXIT_USAGE  # of a command that it ends
