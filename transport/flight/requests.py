"""What people ask of a run in flight, from the command line or the viewer: one way, one wording of refusals."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

# Settings of a link that make it perfect.
PERFECT: Mapping[str, Any] = {
    "delay_s": 0.0,
    "jitter_s": 0.0,
    "distribution": "uniform",
    "loss": 0.0,
    "gilbert_elliott": {"enter": 0.0, "leave": 1.0},
    "duplicate": 0.0,
    "reorder": 0.0,
    "rate_hz": 1e9,
}


class RefusedError(ValueError):
    """The run will not do it; the text says what was expected."""


class UnansweredError(RuntimeError):
    """There is no such process, or it does not answer."""


def request(
    run: str, endpoints: Sequence[str], name: str, what: str, given: Mapping[str, Any], keys: Path | None = None
) -> dict[str, Any]:
    """Ask a process of a run for something.

    Args:
        run: Name of the run.
        endpoints: Of its processes; of the one that is asked is enough.
        name: Process: "coordinator" for links and status, "recorder" for faults, any for health.
        what: Request; see docs/protocol.md.
        given: Its arguments.
        keys: Folder of keys, if the run has any.
    Returns: The answer.
    Raises: RefusedError, UnansweredError.
    """
    from protocol.network.security import Security
    from protocol.network.session import BusError, ask
    from protocol.wire.keys import ROUTER

    security = None if keys is None else Security(keys.resolve(), (name, ROUTER))
    try:
        answer = dict(ask(run, endpoints, name, what, given, security=security))
    except BusError as error:
        raise UnansweredError(str(error)) from error
    if "error" in answer:
        raise RefusedError(str(answer["error"]))
    return answer
