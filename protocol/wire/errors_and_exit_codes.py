"""Errors that a user can solve, refused messages, and the exit codes of all commands and processes."""

from typing import Literal

# Exit codes of every command and process (docs/command-line.md).
EXIT_USAGE = 2  # an option or argument is refused
EXIT_SCENARIO = 3  # the scenario is refused
EXIT_UNREACHABLE = 4  # a peer is gone or was never reachable
EXIT_OVERRUN = 5  # deadlines missed, with clock.on_overrun = "abort"
EXIT_DIVERGED = 6  # the simulation diverged
EXIT_FAILED = 7  # steps of a controller failed, or a simulation of an experiment raised an error
EXIT_DIFFERENT = 8  # replayed plans differ from the recorded ones
EXIT_CHECK_FAILED = 9  # a check of `transport doctor` failed
EXIT_UNRECORDED = 10  # the log or the report cannot be written
EXIT_COLLIDED = 11  # two UAVs touched
EXIT_INTERRUPTED = 130  # Ctrl-C, SIGTERM or SIGHUP

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
