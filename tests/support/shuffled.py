"""The in-memory runtime with connections of random speeds that differ by orders of magnitude."""

import time
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
from typing_extensions import override

from tests.support.runs import end
from transport.flight import memory
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Control, LinkChange, Message, Presence

# Placeholder in the runtime's queue for one more delivery; the message is drawn at random.
_SOMETHING = end()

# Replaces the key for presence events.
_PRESENCE = "alive"

# Speed of a channel that delivers only when no other channel has messages.
_SLOWEST = 1e-9


class _Shuffled(memory.InMemoryRun):
    """A run whose messages arrive in random order; Zenoh's order per sender and key is kept."""

    def __init__(self, setup: Setup, record: Callable[[Message], None], seed: int) -> None:
        super().__init__(setup, record, time.perf_counter_ns)
        self._rng = np.random.default_rng(seed)
        self._channels: dict[tuple[str, str, str], deque[Message | Presence]] = {}
        self._speeds: dict[tuple[str, str, str], float] = {}

    @override
    def _send(self, messages: Sequence[Message]) -> None:
        for message in messages:
            if message.sender == self._coordinator.name and self._fails(message.sender, message):
                return
            self._record(message)
            for name in self._receivers(message):
                self._put(message.sender, name, message)

    @override
    def _announce(self, event: Presence) -> None:
        self._put(event.name, self._coordinator.name, event)
        if not event.alive:  # each process sees the connection close, at its own time
            for name in self.nodes.keys() - {self._coordinator.name, event.name}:
                self._put(event.name, name, event)

    @override
    def _fails(self, name: str, message: Message) -> bool:
        failed = super()._fails(name, message)
        if failed:
            for (_, receiver, _), waiting in self._channels.items():
                if receiver == name:
                    waiting.clear()  # the failed process no longer receives them
        return failed

    def _put(self, sender: str, receiver: str, event: Message | Presence) -> None:
        if receiver not in self.nodes:
            return
        channel = (
            sender,
            receiver,
            self._keys.of(event) if isinstance(event, Message) else _PRESENCE,
        )
        if channel not in self._channels:
            self._channels[channel], self._speeds[channel] = (
                deque(),
                10.0 ** self._rng.uniform(-3.0, 0.0),
            )
        if isinstance(event, LinkChange):
            self._speeds[channel] = _SLOWEST  # so that every message that can overtake it does
        self._channels[channel].append(event)
        self._queue.append(_SOMETHING)

    @override
    def _deliver(self, message: Message) -> None:
        assert message is _SOMETHING
        waiting = [channel for channel, events in self._channels.items() if events]
        talking = {(sender, receiver) for sender, receiver, key in waiting if key != _PRESENCE}
        # The end of a process arrives after all its messages.
        busy = [
            channel for channel in waiting if channel[2] != _PRESENCE or channel[:2] not in talking
        ]
        if not busy:
            return
        speeds = np.array([self._speeds[channel] for channel in busy])
        channel = busy[self._rng.choice(len(busy), p=speeds / speeds.sum())]
        event, name = self._channels[channel].popleft(), channel[1]
        node = self.nodes.get(name)
        if node is not None and not (isinstance(event, Message) and self._fails(name, event)):
            self._send(node.receive(event, self._now_ns))


def fly_shuffled(setup: Setup, record: Callable[[Message], None], seed: int) -> Control:
    """Simulate with messages delivered in random order, except that the order per sender and key is kept.

    Args:
        setup: The run.
        record: Called with every message as it is sent.
        seed: Random seed of the order.
    """
    return _Shuffled(setup, record, seed).run()
