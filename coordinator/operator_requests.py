"""Requests of clients to the coordinator: the status of the run, changes of links, targets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from transport.coordinator.link_and_target_changes import Changes
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.wire.messages import Message, Request, Target


@dataclass(frozen=True, slots=True, kw_only=True)
class RunStatus:
    """Progress of a run.

    Attributes:
        tick: The open tick, -1 before the first.
        ticks: Number of ticks of the run.
        members: Agents on the roster, ascending.
        observers: Names of the observers, such as "recorder", ascending.
        takes_changes: Whether a tick follows, from which on a change can hold.
        period_ns: Sampling period, ns.
    """

    tick: int
    ticks: int
    members: Sequence[int]
    observers: Sequence[str]
    takes_changes: bool
    period_ns: int


def answer_request(request: Request, status: RunStatus, changes: Changes) -> Sequence[Message]:
    """Answer a request, and return the messages of a change, which holds from the next tick on."""
    if request.what == "status":
        shown = ("tick", "ticks", "members", "observers")
        request.reply({key: getattr(status, key) for key in shown})
        return ()
    try:
        messages = _changed(request, status, changes)
    except RequestError as error:
        request.reply({"error": str(error)})
        return ()
    request.reply(_reply(messages[0], status))
    return messages


def _changed(request: Request, status: RunStatus, changes: Changes) -> Sequence[Message]:
    """Return the messages of a change of links or a target. Raises: RequestError."""
    if request.what not in ("link", "target"):
        raise RequestError(f"what: expected status, link or target, got {request.what!r}")
    if not status.takes_changes:
        raise RequestError("expected a running simulation")

    if request.what == "link":
        return changes.link(request.given, status.tick + 1)
    return changes.target(request.given, status.tick + 1)


def _reply(change: Message, status: RunStatus) -> Mapping[str, Any]:
    """Return the answer to an accepted change: when it begins, and when a target is reached."""
    since_s = (status.tick + 1) * status.period_ns / 1e9
    reply: dict[str, Any] = {"tick": status.tick + 1, "t_s": since_s}
    if isinstance(change, Target):
        reply["reached_s"] = since_s + change.approach_s
        reply["ends_s"] = reply["reached_s"] + change.way_s
        reply["point_m"] = change.points[-1].tolist()
    return reply
