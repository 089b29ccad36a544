"""The in-memory runtime: all nodes of a run in one process, messages in one queue, a clock that nobody waits for.

Time stands still while messages are under way and then jumps to whatever a node waits for, so timeouts cost
nothing. Scripted faults happen here as they do to processes.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence

import threadpoolctl

from agent.node import AgentNode
from coordinator.node import CoordinatorNode
from plant.node import PlantNode
from protocol.scenario.faults import due
from protocol.scenario.setup import Setup
from protocol.wire.keys import Keys, matches
from protocol.wire.messages import Control, Message, Presence
from protocol.wire.node import Node


def simulate(
    setup: Setup,
    record: Callable[[Message], None] = lambda _: None,
    stopwatch: Callable[[], int] = time.perf_counter_ns,
) -> Control:
    """Fly a whole run in this process, as fast as it goes.

    Messages are delivered in the order they are sent, each to everybody who would receive it on the network.
    Lockstep makes the result independent of that order; the Zenoh runtime gives the same bits.

    Args:
        setup: The run.
        record: Called with every message, as the recorder would see it.
        stopwatch: Nanoseconds of a steady clock, for the step reports.
    Returns: How the run ended.
    Raises: RuntimeError: the nodes wait for each other, which is a bug.
    """
    with threadpoolctl.threadpool_limits(1):
        return _Flight(setup, record, stopwatch).run()


class _Flight:
    """One flight: the nodes that are up, the messages under way, the time."""

    def __init__(self, setup: Setup, record: Callable[[Message], None], stopwatch: Callable[[], int]) -> None:
        self._setup, self._record, self._stopwatch = setup, record, stopwatch
        self._keys = Keys(setup.scenario.name)
        self._coordinator = CoordinatorNode(setup)
        agents = [AgentNode(setup, agent, stopwatch=stopwatch) for agent in setup.agents]
        nodes: list[Node] = [self._coordinator, PlantNode(setup), *agents]
        self._nodes = {node.name: node for node in nodes}
        self._subscriptions = {name: self._keys.subscriptions(name) for name in self._nodes}
        self._listeners: dict[str, list[str]] = {}
        self._frozen: dict[str, Node] = {}
        self._queue: deque[Message] = deque()
        self._now_ns = 0
        self._incarnations: dict[str, int] = {}
        self._returns = [fault for fault in setup.faults if fault.do in ("continue", "start")]

    def run(self) -> Control:
        """Fly to the end."""
        for name in list(self._nodes):
            if name != self._coordinator.name:
                self._tell(Presence(name, 0, alive=True))
        while True:
            while self._queue:
                self._deliver(self._queue.popleft())
            # The coordinator's end is news that the others may still have to hear; a dead one tells nobody.
            if self._coordinator.finished is not None:
                return self._coordinator.finished
            if self._coordinator.name not in self._nodes:
                return self._without_coordinator()
            if not self._bring_back() and not self._wait():
                raise RuntimeError(f"the run stands still at tick {self._coordinator.tick}: every node waits")

    def _send(self, messages: Sequence[Message]) -> None:
        for message in messages:
            if message.sender == self._coordinator.name and self._fails(message.sender, message):
                return
            self._record(message)
            self._queue.append(message)

    def _tell(self, event: Presence) -> None:
        self._send(self._coordinator.receive(event, self._now_ns))

    def _heard_by(self, message: Message) -> list[str]:
        """Names of the processes a message is for."""
        key = self._keys.of(message)
        if key not in self._listeners:
            self._listeners[key] = [
                name
                for name, expressions in self._subscriptions.items()
                if name != message.sender and any(matches(expression, key) for expression in expressions)
            ]
        return self._listeners[key]

    def _deliver(self, message: Message) -> None:
        for name in self._heard_by(message):
            node = self._nodes.get(name)
            if node is not None and not self._fails(name, message):
                self._send(node.receive(message, self._now_ns))

    def _fails(self, name: str, message: Message) -> bool:
        """Whether a process ends or freezes on a message; then it is as if the message had never come."""
        fault = due(self._setup.faults, name, message)
        if fault is None or name not in self._nodes:
            return False
        node = self._nodes.pop(name)
        if fault == "stop":
            self._frozen[name] = node
        elif name != self._coordinator.name:
            self._tell(Presence(name, node.incarnation, alive=False))
        return True

    def _bring_back(self) -> bool:
        """Do what a script says brings an agent back at the next tick; whether anything was."""
        if not self._returns or self._returns[0].tick > self._coordinator.tick + 1:
            return False
        name = self._returns.pop(0).target
        old = self._frozen.pop(name, None)
        # Frozen or killed: it knows nothing that is not out of date, and comes back as a new one.
        incarnation = self._incarnations.get(name, 0) + 1
        self._incarnations[name] = incarnation
        if old is None or isinstance(old, AgentNode):
            agent = int(name.removeprefix("agent"))
            self._nodes[name] = AgentNode(self._setup, agent, incarnation, self._stopwatch)
            self._tell(Presence(name, incarnation, alive=True))
        return True

    def _wait(self) -> bool:
        """Let time pass until some node wants to be woken; whether any does."""
        wakes = [(node.wake_ns, node) for node in self._nodes.values()]
        waiting = [(wake_ns, node) for wake_ns, node in wakes if wake_ns is not None]
        if not waiting:
            return False
        wake_ns, node = min(waiting, key=lambda entry: entry[0])
        self._now_ns = max(self._now_ns, wake_ns)
        self._send(node.poll(self._now_ns))
        return True

    def _without_coordinator(self) -> Control:
        """How the others end when the coordinator is gone."""
        for node in self._nodes.values():
            node.receive(Presence(self._coordinator.name, self._coordinator.incarnation, alive=False), self._now_ns)
        ends = [node.finished for node in self._nodes.values() if node.finished is not None]
        self._record(ends[0])
        return ends[0]
