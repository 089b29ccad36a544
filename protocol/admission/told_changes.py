"""Targets and changes of links told in a run, as one process knows them: for processes that missed them.

A coordinator that is started again knows none of those that an earlier one told, and a vehicle that returns
meanwhile is not sent them again. So each vehicle says with its status how many it knows, and adds the
next ones that the least informed process lacks, as far as it has heard.
"""

import math

from transport.protocol.wire.codec import decode, encode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.message_form import MAX_CARRIED
from transport.protocol.wire.messages import LinkChange, Schedule, Target, VehicleStatus
from transport.protocol.wire.names import COORDINATOR

_RECENT_NS = 1_000_000_000
# Time after the end of the way down in which the payload comes to stand, and the ground takes its
# load (`model.path.target_and_stop.LOAD_S`), s.
_SETTLES_S = 2.0


class ToldChanges:
    """Targets and changes of links, each numbered from 1 without a gap.

    Attributes:
        targets, links: Those told so far, in the order of their numbers.
    """

    def __init__(self) -> None:
        self.targets: list[Target] = []
        self.links: list[LinkChange] = []
        self._known: dict[str, tuple[int, int, int]] = {}  # by process: numbers of both, and when

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of targets and of changes of links, as fields of `Schedule` and `VehicleStatus`."""
        return {"targets": len(self.targets), "links": len(self.links)}

    def add(self, change: Target | LinkChange) -> bool:
        """Add a change; return whether it is the next one of its kind, not a repeated one."""
        told: list[Target] | list[LinkChange]
        told = self.targets if isinstance(change, Target) else self.links
        if change.number != len(told) + 1:
            return False
        told.append(change)  # type: ignore[arg-type]
        return True

    def note(self, word: Schedule | VehicleStatus, now_ns: int) -> None:
        """Note how much the sender of a word knows."""
        self._known[word.sender] = word.targets, word.links, now_ns

    def lacks(self) -> bool:
        """Return whether another process knows more than this one."""
        mine = len(self.targets), len(self.links)
        return any(
            targets > mine[0] or links > mine[1] for targets, links, _ in self._known.values()
        )

    def lacking(self, now_ns: int) -> tuple[bytes, ...]:
        """Return the next changes, as bytes, that the least informed process lacks, of those heard lately."""
        recent = [
            (targets, links)
            for targets, links, at_ns in self._known.values()
            if now_ns <= at_ns + _RECENT_NS
        ]
        if not recent:
            return ()
        targets = self.targets[min(targets for targets, _ in recent) :]
        links = self.links[min(links for _, links in recent) :]
        return tuple(encode(change) for change in [*links, *targets][:MAX_CARRIED])


def rests_at(landing: Target, period_s: float) -> int:
    """Return the tick from which on a team that lands is at rest."""
    duration_s = landing.approach_s + landing.way_s + _SETTLES_S
    return landing.first_tick + math.ceil(duration_s / period_s)


def changes_in(status: VehicleStatus) -> list[Target | LinkChange]:
    """Return the changes that a status carries. Raises: MessageError: one is none of a coordinator."""
    changes = []
    for data in status.changes:
        change = decode(data)
        if not isinstance(change, Target | LinkChange) or change.sender != COORDINATOR:
            got = f"{change.kind} of {change.sender}"
            text = f"changes: expected targets and links of the coordinator, got {got}"
            raise MessageError("wrong_sender", text)
        changes.append(change)
    return changes
