"""In-memory runtime: all nodes of a run in one process, with one message queue and virtual time.

Time stands still while messages are in the queue and then jumps to the next wake-up of a node.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

import threadpoolctl

from transport.agent.node import AgentNode
from transport.flight.roles import coordinator_of, plant_run
from transport.flight.signals import check_interrupt
from transport.plant.node import PlantNode
from transport.protocol.scenario.faults.faults_by_tick import Fault, due
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.key_expressions import Keys, matches
from transport.protocol.wire.messages import Control, Message, Presence
from transport.protocol.wire.names import COORDINATOR, PLANT
from transport.protocol.wire.node_interface import Node

# Runs in several threads take turns: the number of BLAS threads, which decides the order of sums,
# is the process's.
_TURN = threading.RLock()


def simulate(
    setup: Setup,
    record: Callable[[Message], None] = lambda _: None,
    stopwatch: Callable[[], int] = time.perf_counter_ns,
) -> Control:
    """Simulate a run in this process, unpaced, and return how it ended.

    It is equal to one with processes bit for bit.

    `record` is called with every message; `stopwatch` is the steady clock of the step reports, ns.
    """
    with _TURN, threadpoolctl.threadpool_limits(1):
        return InMemoryRun(setup, record, stopwatch).run()


def _without_waits(faults: Sequence[Fault]) -> list[Fault]:
    """Return the faults without the stops of coordinator and plant that end.

    No scenario time passes while one of these is stopped, so such a stop changes nothing.
    """
    continued = {
        fault.target
        for fault in faults
        if fault.do == "continue" and fault.target in (COORDINATOR, PLANT)
    }
    return [fault for fault in faults if fault.target not in continued or fault.do == "kill"]


class InMemoryRun:
    """State of one run: running nodes, messages in the queue, virtual time."""

    def __init__(
        self,
        setup: Setup,
        record: Callable[[Message], None],
        stopwatch: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self._setup = setup
        self._record = record
        self._stopwatch = stopwatch
        self._keys = Keys(setup.scenario.name)

        self._coordinator = coordinator_of(setup)
        agents = [AgentNode(setup.run, agent, stopwatch=stopwatch) for agent in setup.agents]
        nodes: list[Node] = [self._coordinator, PlantNode(plant_run(setup)), *agents]
        self.nodes = {node.name: node for node in nodes}  # the running ones by name
        self._subscriptions = {name: self._keys.subscriptions(name) for name in self.nodes}
        self._subscribed: dict[tuple[str, str], list[str]] = {}  # names by key and sender
        self._queue: deque[Message] = deque()
        self._now_ns = 0

        self._incarnations = {node.name: 0 for node in agents}
        returns = [fault for fault in setup.faults if fault.do in ("continue", "start")]
        self._faults = _without_waits(setup.faults)
        self._returns = [fault for fault in returns if fault.target in self._incarnations]

    def run(self) -> Control:
        """Simulate to the end."""
        for name in [name for name in self.nodes if name != self._coordinator.name]:
            self._announce(Presence(name, 0, alive=True))
        while True:
            while self._queue:
                check_interrupt()
                self._deliver(self._queue.popleft())
            # The other nodes receive the end of the run before it is returned; a killed coordinator
            # sends none.
            if self._coordinator.finished is not None:
                return self._coordinator.finished
            if self._coordinator.name not in self.nodes:
                return self._without_coordinator()
            if not self._bring_back() and not self._wait():
                raise RuntimeError(f"deadlock at tick {self._coordinator.tick}: every node waits")

    def _send(self, messages: Sequence[Message]) -> None:
        """Record and queue messages, up to a fault of their sender."""
        for message in messages:
            if message.sender == self._coordinator.name and self._fails(message.sender, message):
                return
            self._record(message)
            self._queue.append(message)

    def _announce(self, event: Presence) -> None:
        """Tell the coordinator of a process."""
        self._send(self._coordinator.receive(event, self._now_ns))

    def _receivers(self, message: Message) -> list[str]:
        """Return the names of the processes that receive a message."""
        key = self._keys.of(message)
        sender = message.sender
        if (key, sender) not in self._subscribed:
            self._subscribed[key, sender] = [
                name
                for name, expressions in self._subscriptions.items()
                if name != sender and any(matches(expression, key) for expression in expressions)
            ]
        return self._subscribed[key, sender]

    def _deliver(self, message: Message) -> None:
        """Hand a message to its receivers, and queue their answers."""
        for name in self._receivers(message):
            node = self.nodes.get(name)
            if node is not None and not self._fails(name, message):
                self._send(node.receive(message, self._now_ns))

    def _fails(self, name: str, message: Message) -> bool:
        """Apply a scripted fault at a message; return whether the process ended or froze."""
        if not self._faults:
            return False
        fault = due(self._faults, name, message)
        if fault is None or name not in self.nodes:
            return False
        node = self.nodes.pop(name)
        if fault == "kill" and name != self._coordinator.name:
            self._announce(Presence(name, node.incarnation, alive=False))
        return True

    def _bring_back(self) -> bool:
        """Bring back the agent that the script returns at the next tick; return whether one did."""
        if not self._returns or self._returns[0].tick > self._coordinator.tick + 1:
            return False
        name = self._returns.pop(0).target
        # The state of a frozen agent is outdated, so it comes back as a new node, too.
        self._incarnations[name] += 1
        incarnation = self._incarnations[name]
        agent = int(name.removeprefix("agent"))
        self.nodes[name] = AgentNode(self._setup.run, agent, incarnation, self._stopwatch)
        self._announce(Presence(name, incarnation, alive=True))
        return True

    def _wait(self) -> bool:
        """Advance time to the next wake-up of a node; return whether there is one."""
        waiting = [(node.wake_ns, node) for node in self.nodes.values() if node.wake_ns is not None]
        if not waiting:
            return False
        wake_ns, node = min(waiting, key=lambda entry: entry[0])
        self._now_ns = max(self._now_ns, wake_ns)
        self._send(node.poll(self._now_ns))
        return True

    def _without_coordinator(self) -> Control:
        """Return how the others end without the coordinator."""
        gone = Presence(self._coordinator.name, self._coordinator.incarnation, alive=False)
        for node in self.nodes.values():
            node.receive(gone, self._now_ns)
        ends = [node.finished for node in self.nodes.values() if node.finished is not None]
        self._record(ends[0])
        return ends[0]
