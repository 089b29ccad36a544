"""Messages on their way to one receiver: delayed by ticks, in real time held back by the clock."""

from collections.abc import Mapping
from typing import Generic, TypeVar

from transport.protocol.scenario.links.delay_jitter_and_loss import Link
from transport.protocol.wire.messages import Message

M = TypeVar("M", bound=Message)


class Arrivals(Generic[M]):
    """Messages of one kind to one receiver, over the link from each sender, by process name.

    Args:
        links: Links by name of the sender.
        after: In lockstep, ticks until a message is used over a perfect link.
        speed: Scenario seconds per second in real time; None in lockstep.
    """

    def __init__(
        self, links: Mapping[str, Link], *, after: int, speed: float | None, aired: bool = False
    ) -> None:
        self.links = links
        self._after = after
        self._speed = speed
        self._sent: list[M] = []  # in lockstep, until their tick: link changes may precede it
        # With the tick from which each is usable, or in real time its instant, ns.
        self._held: list[tuple[int, M]] = []
        self._lost = 0  # messages lost since the last `take`
        # With a radio: when each message had come through the air, s after its tick, by sender and
        # tick; None: it was lost there.
        self._aired: dict[tuple[str, int], float | None] | None = {} if aired else None
        self._withdrawn: set[tuple[str, int]] = set()  # by sender and tick

    def put(self, message: M, now_ns: int) -> None:
        """Take in a message that has physically arrived."""
        if self._speed is None:
            self._sent.append(message)
            return
        delays_s = self.links[message.sender].delays(message.tick)
        for delay_s in delays_s:
            self._held.append((now_ns + round(delay_s * 1e9 / self._speed), message))
        self._lost += not delays_s

    def air(self, sender: str, tick: int, arrival_s: float | None) -> None:
        """Note when a message has come through the air, s after its tick; None: it was lost."""
        if self._aired is not None:
            self._aired[sender, tick] = arrival_s

    def withdraw(self, sender: str, tick: int) -> None:
        """Forget a message that its sender never put on the air; it does not count as lost."""
        self._withdrawn.add((sender, tick))

    def take(self, tick: int, now_ns: int) -> tuple[list[M], int]:
        """Return the messages that have become usable, and the number of newly lost ones.

        The messages are sorted by tick and sender.
        """
        self._pass_links(tick)
        now = tick if self._speed is None else now_ns
        usable: list[M] = []
        held: list[tuple[int, M]] = []
        for since, message in self._held:
            # In real time senders may be ahead: a message of a future tick waits for that tick.
            if since <= now and message.tick <= tick:
                usable.append(message)
            else:
                held.append((since, message))
        self._held = held

        lost = self._lost
        self._lost = 0
        usable.sort(key=lambda message: (message.tick, message.sender))
        return usable, lost

    def _pass_links(self, tick: int) -> None:
        """Let the links decide about the messages sent, in lockstep, until a tick."""
        waiting: list[M] = []
        for message in self._sent:
            sent = message.sender, message.tick
            if sent in self._withdrawn:
                self._withdrawn.remove(sent)
                continue
            if message.tick + self._after > tick or not self._is_through(message):
                waiting.append(message)
                continue
            ticks = self._usable_ticks(message)
            for usable in ticks:
                self._held.append((usable, message))
            self._lost += not ticks
        self._sent = waiting

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
