"""Messages on their way to one receiver.

In lockstep delayed by ticks, in real time held back by the clock.
"""

from collections.abc import Mapping
from typing import Generic, TypeVar

from transport.protocol.scenario.links import Link
from transport.protocol.wire.messages import Message

M = TypeVar("M", bound=Message)


class Arrivals(Generic[M]):
    """Messages of one kind to one receiver, over the link from each sender, by process name."""

    def __init__(
        self, links: Mapping[str, Link], *, after: int, speed: float | None, aired: bool = False
    ) -> None:
        self.links = links
        # In lockstep: ticks until one is used over a perfect link. Else: scenario seconds per
        # second.
        self._after, self._speed = after, speed
        self._sent: list[M] = []  # in lockstep, until their tick: link changes may precede it
        self._held: list[
            tuple[int, M]
        ] = []  # with the tick of their arrival, or in real time its instant (ns)
        self._lost = 0  # messages lost since the last `take`
        # With a radio: when each message had come through the air, s after its tick, by sender and
        # tick; None: it was lost there.
        self._aired: dict[tuple[str, int], float | None] | None = {} if aired else None

    def put(self, message: M, now_ns: int) -> None:
        """Take in a message that has physically arrived."""
        if self._speed is None:
            self._sent.append(message)
            return
        delays = self.links[message.sender].delays(message.tick)
        self._held += [(now_ns + round(delay * 1e9 / self._speed), message) for delay in delays]
        self._lost += not delays

    def air(self, sender: str, tick: int, arrival_s: float | None) -> None:
        """Note when a message has come through the air, s after its tick; None: it was lost."""
        if self._aired is not None:
            self._aired[sender, tick] = arrival_s

    def take(self, tick: int, now_ns: int) -> tuple[list[M], int]:
        """Return the messages that have become usable, sorted by tick and sender, and the number of newly lost ones."""
        waiting = []
        for message in self._sent:
            if message.tick + self._after > tick or not self._is_through(message):
                waiting.append(message)
                continue
            ticks = self._usable_ticks(message)
            self._held += [(usable, message) for usable in ticks]
            self._lost += not ticks
        self._sent = waiting
        until = tick if self._speed is None else now_ns
        # In real time senders may be ahead: a message of a future tick waits for that tick.
        usable = [message for at, message in self._held if at <= until and message.tick <= tick]
        self._held = [
            (at, message) for at, message in self._held if at > until or message.tick > tick
        ]
        lost, self._lost = self._lost, 0
        return sorted(usable, key=lambda message: (message.tick, message.sender)), lost

    def _is_through(self, message: M) -> bool:
        """Return whether the fate of a message on the air is known."""
        return self._aired is None or (message.sender, message.tick) in self._aired

    def _usable_ticks(self, message: M) -> list[int]:
        """Return the ticks from which a message can be used; none if it is lost."""
        air_s: float | None = 0.0
        if self._aired is not None:
            air_s = self._aired.pop((message.sender, message.tick))
        if air_s is None:
            return []
        return self.links[message.sender].usable_ticks(message.tick, self._after, air_s)
