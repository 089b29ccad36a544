"""A run in one process whose messages travel as bytes: real buses and loops over a network that is a queue."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import pytest

from agent.node import AgentNode
from coordinator.node import CoordinatorNode
from plant.node import PlantNode
from protocol.admission.gate import Gate
from protocol.admission.gate import Sample as Unread
from protocol.network import bus as bus_module
from protocol.network import process
from protocol.network.bus import Bus, Interrupted, Place
from protocol.network.endpoints import Endpoints
from protocol.network.process import exchange_of
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode, encode
from protocol.wire.keys import Keys, matches
from protocol.wire.messages import Bundle, Control, Message, Presence, Rejected
from protocol.wire.node import Node
from tests.support.runs import INCARNATION
from transport.flight.recorder import Recorder

Before = Callable[["Wire", str, str, bytes], None]


class Payload(bytes):
    """Payload of a sample."""

    def to_bytes(self) -> bytes:
        """Return the bytes."""
        return bytes(self)


class Sample:
    """A message as it arrives from the network; tokens have a kind besides."""

    def __init__(self, key: str, data: bytes) -> None:
        self.key_expr, self.payload = key, Payload(data)


class Publisher:
    """A publisher of one key, without a network."""

    def __init__(self, key: str) -> None:
        self._key = key
        self.sent: list[tuple[str, bytes]] = []

    def put(self, data: bytes) -> None:
        """Keep a message."""
        self.sent.append((self._key, data))


class Session:
    """A session without a network: declares nothing, and keeps what is sent, by key."""

    def __init__(self, *_: object) -> None:
        self.sent: list[tuple[str, bytes]] = []

    def declare_publisher(self, key: str, **_: object) -> Publisher:
        """Return a publisher of a key."""
        publisher = Publisher(key)
        publisher.sent = self.sent
        return publisher

    def liveliness(self) -> "Session":
        """Return this session."""
        return self

    def declare(self, *_: object, **__: object) -> "Session":
        """Declare nothing."""
        return self

    declare_subscriber = declare_queryable = declare_token = undeclare = close = declare


def without_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every bus open a session without a network."""
    monkeypatch.setattr(bus_module, "open_session", Session)
    monkeypatch.setattr(bus_module, "log_errors", lambda **_: None)


def sent_by(bus: Bus) -> list[tuple[str, bytes]]:
    """Return keys and bytes that a bus without a network has sent since the last call."""
    session: Any = bus._session
    found = list(session.sent)
    session.sent.clear()
    return found


class Receiver(Protocol):
    """A process that receives messages over its bus."""

    bus: Bus
    gate: Gate

    def hear(self, key: str, data: bytes) -> list[tuple[str, bytes]]:
        """Process bytes that arrive under a key; return what is sent meanwhile."""


class SilentGate(Gate):
    """Gate whose notices wait for the end of the run: their times depend on the host."""

    def notices(self, incarnation: int, now_ns: int | None = None) -> list[Rejected]:
        """Return notices only at the end."""
        return [] if now_ns is not None else super().notices(incarnation)


class NodeReceiver:
    """A node with gate, bus, exchange and loop of its process."""

    def __init__(self, node: Node, keys: Keys, setup: Setup) -> None:
        self.node = node
        self.gate: Gate = SilentGate(node.name, keys, setup.shape, node.check_moment)
        place = Place(run=keys.run, incarnation=node.incarnation, endpoints=Endpoints(listen=[], connect=[]))
        self.bus = Bus(node.name, place, setup.scenario.digest(), self.gate)
        self.exchange = exchange_of(setup, node.name, node.incarnation, keys, self.bus.put)
        self.bus.before_wait = self.exchange.settle

    def hear(self, key: str, data: bytes) -> list[tuple[str, bytes]]:
        """Let bytes arrive under a key, and the loop run until it would wait; return what it sends."""
        self.bus._put(Sample(key, data))  # type: ignore[arg-type]
        self.bus.interrupt("nothing more arrives")
        process._drive(self.node, self.bus, self.exchange, ())
        if self.node.finished is not None:
            self.exchange.flush()
            while not isinstance(self.bus.next(None), Interrupted):
                pass
        return sent_by(self.bus)

    def meet(self, event: Presence) -> list[tuple[str, bytes]]:
        """Let the node see a process come or go; return what is sent meanwhile."""
        for message in self.node.receive(event, time.monotonic_ns()):
            self.exchange.send(message)
        return sent_by(self.bus)


class RecordingReceiver:
    """A recorder; it never answers."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder, self.bus = recorder, recorder._bus
        self.gate = recorder.gate

    def hear(self, key: str, data: bytes) -> list[tuple[str, bytes]]:
        """Record the messages that come with some bytes."""
        self.bus._put(Sample(key, data))  # type: ignore[arg-type]
        self.bus.interrupt("nothing more arrives")
        while not isinstance(event := self.bus.next(None), Interrupted):
            if isinstance(event, Message | Unread):
                self._recorder.receive(event)
        return sent_by(self.bus)


class Wire:
    """One run of processes in incarnation `INCARNATION`; messages are delivered in the order sent.

    Buses must open sessions without a network: see `without_network`.

    Args:
        setup: The run.
        recorder: Recorder of the run.
        before: Called before each delivery with this object, the receiver's name, the key and the bytes.

    Attributes:
        keys: Keys of the run.
        receivers: Receivers by name.
        sent: Every message of the run in order, those of bundles one by one.
    """

    def __init__(self, setup: Setup, recorder: Recorder, before: Before = lambda *_: None) -> None:
        self.keys = Keys(setup.scenario.name)
        self._before = before
        self._coordinator = CoordinatorNode(setup, INCARNATION)
        agents = [AgentNode(setup, agent, INCARNATION) for agent in setup.agents]
        nodes: list[Node] = [self._coordinator, PlantNode(setup, INCARNATION), *agents]
        self.receivers: dict[str, Receiver] = {node.name: NodeReceiver(node, self.keys, setup) for node in nodes}
        self.receivers["recorder"] = RecordingReceiver(recorder)
        self.sent: list[Message] = []
        self._queue: deque[tuple[str, str, bytes]] = deque()
        for receiver in self.receivers.values():
            for name in self.receivers:
                receiver.gate.announce(name, INCARNATION)

    def simulate(self) -> Control:
        """Simulate to the end and return the coordinator's last message."""
        coordinator = self.receivers["coordinator"]
        assert isinstance(coordinator, NodeReceiver)
        for name in self.receivers:
            if name not in ("coordinator", "recorder"):
                self._send("coordinator", coordinator.meet(Presence(name, INCARNATION, alive=True)))
        while self._queue:
            sender, key, data = self._queue.popleft()
            for name in self.listeners(key):
                if name != sender:
                    self._before(self, name, key, data)
                    rejected = self.receivers[name].gate.rejections
                    before = rejected.total
                    self._hear(name, key, data)
                    assert rejected.total == before, f"{name} refuses {key}: {list(rejected)}"
        assert self._coordinator.finished is not None, f"the run stands still at tick {self._coordinator.tick}"
        return self._coordinator.finished

    def listeners(self, key: str) -> list[str]:
        """Return the names of the receivers subscribed to a key."""
        return [name for name in self.receivers if any(matches(e, key) for e in self.subscriptions(name))]

    def subscriptions(self, name: str) -> list[str]:
        """Return the key expressions a process subscribes to."""
        return self.keys.subscriptions(name)

    def disturb(self, name: str, key: str, data: bytes) -> list[str]:
        """Let a receiver read bytes that are no message of this run; return the keys of its answers."""
        return self._hear(name, key, data)

    def tell_rejected(self) -> None:
        """Send each receiver's rejections to the recorder, as at the end of a run; the recorder's own come last."""
        recorder = self.receivers["recorder"]
        for name, receiver in self.receivers.items():
            for notice in receiver.gate.notices(INCARNATION):
                if name == "recorder":
                    assert isinstance(recorder, RecordingReceiver)
                    recorder._recorder.receive(notice)
                    continue
                recorder.hear(self.keys.of(notice), encode(notice))

    def _hear(self, name: str, key: str, data: bytes) -> list[str]:
        """Let a receiver read bytes, send what it sends, and return the keys of that."""
        answers = self.receivers[name].hear(key, data)
        self._send(name, answers)
        return [sent_key for sent_key, _ in answers]

    def _send(self, name: str, answers: Sequence[tuple[str, bytes]]) -> None:
        for key, data in answers:
            message = decode(data)
            self._queue.append((name, key, data))
            self.sent += map(decode, message.parts) if isinstance(message, Bundle) else [message]
