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

    def __init__(self, links: Mapping[str, Link], *, after: int, speed: float | None) -> None:
        self.links = links
        # In lockstep: ticks until one is used over a perfect link. Else: scenario seconds per
        # second.
        self._after, self._speed = after, speed
        self._sent: list[M] = []  # in lockstep, until their tick: link changes may precede it
        self._held: list[
            tuple[int, M]
        ] = []  # with the tick of their arrival, or in real time its instant (ns)
        self._lost = 0  # messages lost since the last `take`

    def put(self, message: M, now_ns: int) -> None:
        """Take in a message that has physically arrived."""
        if self._speed is None:
            self._sent.append(message)
            return
        delays = self.links[message.sender].delays(message.tick)
        self._held += [(now_ns + round(delay * 1e9 / self._speed), message) for delay in delays]
        self._lost += not delays

    def take(self, tick: int, now_ns: int) -> tuple[list[M], int]:
        """Return the messages that have become usable, sorted by tick and sender, and the number of newly lost ones."""
        for message in [message for message in self._sent if message.tick + self._after <= tick]:
            ticks = self.links[message.sender].usable_ticks(message.tick, self._after)
            self._held += [(usable, message) for usable in ticks]
            self._lost += not ticks
        self._sent = [message for message in self._sent if message.tick + self._after > tick]
        until = tick if self._speed is None else now_ns
        # In real time senders may be ahead: a message of a future tick waits for that tick.
        usable = [message for at, message in self._held if at <= until and message.tick <= tick]
        self._held = [
            (at, message) for at, message in self._held if at > until or message.tick > tick
        ]
        lost, self._lost = self._lost, 0
        return sorted(usable, key=lambda message: (message.tick, message.sender)), lost
