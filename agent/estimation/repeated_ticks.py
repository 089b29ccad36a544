"""Estimates of the newest ticks, repeated from a tick on where a message came late."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

# Past ticks that can still be corrected; an older message is no better than the prediction.
WINDOW = 64

_NEVER = sys.maxsize

Entry = TypeVar("Entry")


@dataclass(frozen=True, slots=True, kw_only=True)
class TickRecursion(Generic[Entry]):
    """A recursion over ticks. Its steps are pure in the entry and in all that was told so far."""

    begin: Callable[[int], Entry]  # entry of the first tick, before its messages
    # Entry of a tick, and all messages of that tick, which may be in it already.
    corrected: Callable[[Entry, int], Entry]
    # Entry of the tick after a tick, with its messages, from that of the tick.
    following: Callable[[Entry, int], Entry]


class History(Generic[Entry]):
    """Entries of a recursion at the newest ticks.

    Invariants after `advance` to a tick k:
        - entries exist for the ticks first .. k, without a gap, and for at most `WINDOW` ticks;
        - each follows from the one before by `following`, with all that was told of its tick, so
          none depends on the order or time at which messages arrived;
        - nothing is outdated.

    Between two calls, entries of ticks after `_outdated_after` are outdated, because inputs,
    messages or the system have changed, and those of ticks from `_told_from` on lack a message.
    """

    def __init__(self) -> None:
        self.first = 0  # tick of the oldest entry; before the first `advance` no tick is too old
        self._entries: list[Entry] = []
        self._outdated_after = _NEVER
        self._told_from = _NEVER

    @property
    def newest(self) -> Entry | None:
        """The newest entry."""
        return self._entries[-1] if self._entries else None

    def entry(self, tick: int) -> Entry | None:
        """Return the entry of a tick; None where it is not kept."""
        index = tick - self.first
        return self._entries[index] if 0 <= index < len(self._entries) else None

    def keeps(self, tick: int) -> bool:
        """Return whether a message of a tick can still change an entry."""
        return tick >= self.first

    def outdate_after(self, tick: int) -> None:
        """Declare the steps from a tick on outdated."""
        if tick < self._outdated_after:
            self._outdated_after = tick

    def tell(self, tick: int) -> None:
        """Declare that a message of a tick is to be taken in."""
        if tick < self._told_from:
            self._told_from = tick
        self.outdate_after(tick)

    def advance(self, k: int, recursion: TickRecursion[Entry]) -> Entry:
        """Return the entry of tick k, not before the newest one; repeat what is outdated."""
        if not self._entries:
            self.first = k
            self._entries.append(recursion.begin(k))

        # Everything after this tick is computed anew.
        newest = self.first + len(self._entries) - 1
        last_valid = min(newest, max(self._outdated_after, self.first))
        del self._entries[last_valid - self.first + 1 :]
        if self._told_from <= last_valid:
            self._entries[-1] = recursion.corrected(self._entries[-1], last_valid)
        self._outdated_after = _NEVER
        self._told_from = _NEVER

        for tick in range(last_valid, k):
            self._entries.append(recursion.following(self._entries[-1], tick))

        forgotten = max(len(self._entries) - WINDOW, 0)
        del self._entries[:forgotten]
        self.first += forgotten
        return self._entries[-1]
