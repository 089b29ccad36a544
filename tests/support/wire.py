"""A flight in one process whose messages travel as bytes: each receiver reads them through its own gate."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

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
    """Whatever has a gate and something behind it."""

    admission: Admission
    rejected: Rejections

    def hear(self, message: Message) -> Sequence[Message]:
        """Take in a message that was let in and return the answers."""


class NodeReceiver:
    """A node behind its gate."""

    def __init__(self, node: Node, keys: Keys, setup: Setup) -> None:
        self._node, self.rejected = node, node.rejected
        self.admission = Admission(node.name, keys, setup, node.rejected)

    def hear(self, message: Message) -> Sequence[Message]:
        """What the node answers."""
        return self._node.receive(message, 0)


class RecordingReceiver:
    """A recorder behind its gate: it never answers."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder, self.admission, self.rejected = recorder, recorder.admission, recorder.rejected

    def hear(self, message: Message) -> Sequence[Message]:
        """Nothing, but the recorder has heard it."""
        self._recorder.receive(message)
        return ()


class Wire:
    """One flight, every process in its `INCARNATION`, delivered in the order sent.

    Args:
        setup: The run.
        recorder: Records it; its bus is never used.
        before: Called before each delivery with the flight, the receiver's name, the key and the bytes.

    Attributes:
        keys: Of the run.
        receivers: By name.
        sent: Every message of the flight, in order.
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
        """Fly to the end."""
        for name in self.receivers:
            if name not in ("coordinator", "recorder"):
                self._send(self._coordinator.receive(Presence(name, INCARNATION, alive=True), 0))
        while self._queue:
            sender, key, data = self._queue.popleft()
            for name in self.listeners(key):
                if name != sender:
                    self._before(self, name, key, data)
                    message = self.receivers[name].admission.read(key, data)
                    assert message is not None, f"{name} refuses {key}: {list(self.receivers[name].rejected)}"
                    self._send(self.receivers[name].hear(message))
        assert self._coordinator.finished is not None, f"the run stands still at tick {self._coordinator.tick}"
        return self._coordinator.finished

    def listeners(self, key: str) -> list[str]:
        """Who would get a message under a key."""
        return [name for name in self.receivers if any(matches(e, key) for e in self.keys.subscriptions(name))]

    def disturb(self, name: str, key: str, data: bytes) -> Sequence[Message]:
        """Let a receiver read something that is no message of this flight; what it answers."""
        receiver = self.receivers[name]
        message = receiver.admission.read(key, data)
        return () if message is None else receiver.hear(message)

    def tell_rejected(self) -> None:
        """Everybody tells the recorder what it has refused, as at the end of a run; the recorder comes last."""
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
