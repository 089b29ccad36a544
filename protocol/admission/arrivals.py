"""Messages on their way to one receiver: held back until the links let them through.

In lockstep the links work in scenario time: what a tick may use depends on nothing but the scenario. In real
time a message is really held back: it counts from the instant its delay is over on this process's clock.
"""

from collections.abc import Mapping
from typing import Generic, TypeVar

from protocol.scenario.links import Link
from protocol.wire.messages import Message

M = TypeVar("M", bound=Message)


class Arrivals(Generic[M]):
    """Messages of one kind, from several senders to one receiver.

    Args:
        links: The link from each sender, by process name.
        after: Ticks a message needs over a perfect link in lockstep: 1 for what is used at the next tick.
        speed: Scenario seconds per second in real time, or None in lockstep.
    """

    def __init__(self, links: Mapping[str, Link], *, after: int, speed: float | None) -> None:
        self.links = links
        self._after, self._speed = after, speed
        self._sent: list[M] = []  # in lockstep, until the link's state at their tick is known for sure
        self._held: list[tuple[int, M]] = []  # with the tick, or in real time the instant (ns), of their arrival
        self._lost: list[int] = []  # ticks of messages that do not come

    def put(self, message: M, now_ns: int) -> None:
        """A message is physically here."""
        if self._speed is None:
            self._sent.append(message)
            return
        delays = self.links[message.sender].delays(message.tick)
        self._held += [(now_ns + round(delay * 1e9 / self._speed), message) for delay in delays]
        if not delays:
            self._lost.append(message.tick)

    def take(self, tick: int, now_ns: int) -> tuple[list[M], int]:
        """What can be used from now on.

        Args:
            tick: The present one.
            now_ns: Now, on the clock that `put` was told.
        Returns: Messages that have become usable, by tick and sender, whatever the order they came in; how many
            are known from now on not to come.
        """
        # The link's state at a tick is known for sure once that tick is reached, not when a message happens to come.
        for message in [message for message in self._sent if message.tick + self._after <= tick]:
            ticks = self.links[message.sender].usable_ticks(message.tick, self._after)
            self._held += [(usable, message) for usable in ticks]
            if not ticks:
                self._lost.append(message.tick)
        self._sent = [message for message in self._sent if message.tick + self._after > tick]
        until = tick if self._speed is None else now_ns
        # In real time others may be ahead: what they say of a tick that is still to come waits for it.
        usable = [message for at, message in self._held if at <= until and message.tick <= tick]
        self._held = [(at, message) for at, message in self._held if at > until or message.tick > tick]
        lost, self._lost = len(self._lost), []
        return sorted(usable, key=lambda message: (message.tick, message.sender)), lost
