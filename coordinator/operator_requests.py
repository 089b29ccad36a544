"""Requests of clients to the coordinator: the status of the run, changes of links, targets, the way down."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from transport.coordinator.coming_down import ComingDown
from transport.coordinator.link_and_target_changes import Changes
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.wire.messages import Message, Request, Target

_NO_VEHICLES = "expected a run with vehicles (docs/flight.md), got one without"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunStatus:
    """Progress of a run.

    Attributes:
        tick: The open tick, -1 before the first.
        ticks: Number of ticks of the run.
        members: Agents on the roster, ascending.
        observers: Names of the observers, such as "recorder", ascending.
        is_before: Whether no tick of the team has come, by this or an earlier coordinator.
        takes_changes: Whether a tick follows, from which on a change can hold.
        period_ns: Sampling period, ns.
    """

    tick: int
    ticks: int
    members: Sequence[int]
    observers: Sequence[str]
    is_before: bool
    takes_changes: bool
    period_ns: int


def answer_request(
    request: Request, status: RunStatus, changes: Changes, coming_down: ComingDown | None = None
) -> Sequence[Message] | None:
    """Answer a request, and return the messages of a change, which holds from the next tick on.

    None: the run ends, as a team that has landed is released, or aborted before its first tick.
    """
    if request.what == "status":
        shown = ("tick", "ticks", "members", "observers")
        request.reply({key: getattr(status, key) for key in shown})
        return ()
    try:
        if request.what == "release":
            _check_release(status, coming_down)
            request.reply({"tick": status.tick, "t_s": status.tick * status.period_ns / 1e9})
            return None
        if request.what == "abort" and coming_down is not None and status.is_before:
            coming_down.aborted = "aborted by a person before the first tick"
            request.reply({"tick": status.tick, "t_s": 0.0})
            return None
        messages = _changed(request, status, changes, coming_down)
    except RequestError as error:
        request.reply({"error": str(error)})
        return ()
    request.reply(_reply(messages[0], status))
    return messages


def _check_release(status: RunStatus, coming_down: ComingDown | None) -> None:
    """Raise RequestError unless a team of vehicles has landed."""
    if coming_down is None:
        raise RequestError(_NO_VEHICLES)
    coming_down.check_release(status.tick)


def _changed(
    request: Request, status: RunStatus, changes: Changes, coming_down: ComingDown | None
) -> Sequence[Message]:
    """Return the messages of a change of links or a target. Raises: RequestError."""
    if request.what not in ("link", "target", "abort"):
        expected = "expected status, link, target, abort or release"
        raise RequestError(f"what: {expected}, got {request.what[:40]!r}")
    if not status.takes_changes:
        is_back = status.tick < 0 and not status.is_before
        waits = (
            "expected a coordinator that has taken over, got one that has just returned: ask again"
        )
        raise RequestError(waits if is_back else "expected a running simulation")

    if request.what == "abort":
        if coming_down is None:
            raise RequestError(_NO_VEHICLES)
        return coming_down.abort(status.tick + 1)
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
