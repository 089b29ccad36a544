"""Base of the errors that a user can solve."""


class TransportError(Exception):
    """Error that a user can solve; its text is one line, the same on the command line and in Python."""
