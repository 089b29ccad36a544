"""Errors that a user can solve, and refused messages."""

from typing import Literal

from transport.protocol.wire.exit_codes import EXIT_USAGE

# Why a message is refused: docs/reference/protocol.md says what each means.
Reason = Literal[
    "oversized",
    "wrong_version",
    "malformed",
    "unknown_kind",
    "wrong_shape",
    "not_finite",
    "out_of_range",
    "wrong_sender",
    "unknown_agent",
    "wrong_incarnation",
    "replayed",
    "past",
    "future",
    "wrong_uavs",
    "outside_limits",
]


class TransportError(Exception):
    """Error that a user can solve: one line, the same on the command line and in Python."""

    exit_code = EXIT_USAGE  # of a command that it ends


class MessageError(ValueError):
    """A message that is refused; the sender is that of the message, where it could be read."""

    def __init__(self, reason: Reason, text: str, sender: str = "") -> None:
        super().__init__(text)
        self.reason = reason
        self.sender = sender
