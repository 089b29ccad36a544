"""Requests to the processes of an active run, from the command line or the viewer."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from protocol.network.security import Security
from protocol.network.session import BusError, ask
from protocol.wire.keys import ROUTER

# Faults of processes that `transport run` causes on request.
FAULTS = ("kill", "stop", "continue", "restart")


class RefusedError(ValueError):
    """The run refuses the request; the text says what was expected."""


class UnansweredError(RuntimeError):
    """The process does not exist or does not answer."""


def request(
    run: str, endpoints: Sequence[str], name: str, what: str, given: Mapping[str, Any], keys: Path | None = None
) -> dict[str, Any]:
    """Send a request to a process of a run and return the answer.

    Args:
        run: Name of the run.
        endpoints: Endpoints of its processes; that of the receiver is enough.
        name: Receiver: "coordinator" for links and status, "recorder" for faults, any for health.
        what: Request; see docs/protocol.md.
        given: Its arguments.
        keys: Folder of keys, if the run has any.
    Raises: RefusedError, UnansweredError.
    """
    security = None if keys is None else Security(keys.resolve(), (name, ROUTER))
    try:
        answer = dict(ask(run, endpoints, name, what, given, security=security))
    except BusError as error:
        raise UnansweredError(str(error)) from error
    if "error" in answer:
        raise RefusedError(str(answer["error"]))
    return answer
