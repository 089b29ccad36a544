"""A run in one process whose messages travel as bytes: each receiver reads them through its own admission."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from agent.node import AgentNode
from coordinator.node import CoordinatorNode
from plant.node import PlantNode
from protocol.admission.admission import Admission
from protocol.scenario.setup import Setup
from protocol.wire.codec import encode
from protocol.wire.keys import Keys, matches
from protocol.wire.messages import Control, Message, Presence
from protocol.wire.node import Node
from protocol.wire.rejections import Rejections
from tests.support.runs import INCARNATION
from transport.flight.recorder import Recorder

Before = Callable[["Wire", str, str, bytes], None]


class Receiver(Protocol):
    """A process that receives messages through its admission."""

    admission: Admission
    rejected: Rejections

    def hear(self, message: Any) -> Sequence[Message]:
        """Process an admitted message and return the answers."""


class NodeReceiver:
    """A node with its admission."""

    def __init__(self, node: Node, keys: Keys, setup: Setup) -> None:
        self._node, self.rejected = node, node.rejected
        self.admission = Admission(node.name, keys, setup, node.rejected)

    def hear(self, message: Any) -> Sequence[Message]:
        """Return the answers of the node."""
        return self._node.receive(message, 0)


class RecordingReceiver:
    """A recorder with its admission; it never answers."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder, self.admission, self.rejected = recorder, recorder.admission, recorder.rejected

    def hear(self, message: Any) -> Sequence[Message]:
        """Record the message and return no answers."""
        self._recorder.receive(message)
        return ()


class Wire:
    """One run of processes in incarnation `INCARNATION`; messages are delivered in the order sent.

    Args:
        setup: The run.
        recorder: Recorder of the run; its bus is never used.
        before: Called before each delivery with this object, the receiver's name, the key and the bytes.

    Attributes:
        keys: Keys of the run.
        receivers: Receivers by name.
        sent: Every message of the run, in order.
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
                receiver.admission.announce(name, INCARNATION)

    def simulate(self) -> Control:
        """Simulate to the end and return the coordinator's last message."""
        for name in self.receivers:
            if name not in ("coordinator", "recorder"):
                self._send(self._coordinator.receive(Presence(name, INCARNATION, alive=True), 0))
        while self._queue:
            sender, key, data = self._queue.popleft()
            for name in self.listeners(key):
                if name != sender:
                    self._before(self, name, key, data)
                    message = self.receivers[name].admission.take(key, data)
                    assert message is not None, f"{name} refuses {key}: {list(self.receivers[name].rejected)}"
                    self._send(self.receivers[name].hear(message))
        assert self._coordinator.finished is not None, f"the run stands still at tick {self._coordinator.tick}"
        return self._coordinator.finished

    def listeners(self, key: str) -> list[str]:
        """Return the names of the receivers subscribed to a key."""
        return [name for name in self.receivers if any(matches(e, key) for e in self.keys.subscriptions(name))]

    def disturb(self, name: str, key: str, data: bytes) -> Sequence[Message]:
        """Let a receiver read bytes that are no message of this run, and return its answers."""
        receiver = self.receivers[name]
        message = receiver.admission.take(key, data)
        return () if message is None else receiver.hear(message)

    def tell_rejected(self) -> None:
        """Send each receiver's rejections to the recorder, as at the end of a run; the recorder's own come last."""
        recorder = self.receivers["recorder"]
        for name, receiver in self.receivers.items():
            receiver.admission.close()
            for notice in receiver.admission.remaining_notices(INCARNATION):
                if name == "recorder":
                    recorder.hear(notice)
                    continue
                read = recorder.admission.read(self.keys.of(notice), encode(notice))
                assert read == notice
                recorder.hear(read)

    def _send(self, messages: Sequence[Message]) -> None:
        for message in messages:
            self.sent.append(message)
            self._queue.append((message.sender, self.keys.of(message), encode(message)))
