"""The in-memory runtime: all nodes of a run in one process, messages in one queue, no clock."""

import time
from collections import deque
from collections.abc import Callable, Sequence

import threadpoolctl

from agent.node import AgentNode
from coordinator.node import CoordinatorNode
from plant.node import PlantNode
from protocol.keys import Keys, matches
from protocol.messages import Control, Message, Presence
from protocol.node import Node
from protocol.setup import Setup


def fly(
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
        return _fly(setup, record, stopwatch)


def _fly(setup: Setup, record: Callable[[Message], None], stopwatch: Callable[[], int]) -> Control:
    coordinator = CoordinatorNode(setup)
    plant = PlantNode(setup)
    agents = [AgentNode(setup, agent, stopwatch=stopwatch) for agent in setup.agents]
    nodes: Sequence[Node] = [coordinator, plant, *agents]
    keys = Keys(setup.scenario.name)
    subscriptions = {node.name: keys.subscriptions(node.name) for node in nodes}
    listeners: dict[str, list[Node]] = {}
    queue: deque[Message] = deque()

    def send(messages: Sequence[Message]) -> None:
        for message in messages:
            record(message)
            queue.append(message)

    for node in nodes:
        if node is not coordinator:
            send(coordinator.receive(Presence(node.name, 0, alive=True), 0))
    while queue:
        message = queue.popleft()
        key = keys.of(message)
        if key not in listeners:
            listeners[key] = [node for node in nodes if any(matches(e, key) for e in subscriptions[node.name])]
        for node in listeners[key]:
            if node.name != message.sender:
                send(node.receive(message, 0))
    if coordinator.finished is None:
        raise RuntimeError(f"the run stands still at tick {coordinator.tick}: every node waits for another")
    return coordinator.finished
