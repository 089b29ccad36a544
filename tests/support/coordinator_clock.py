"""Coordinators at several points of a run of three ticks with four agents, all in incarnation 1."""

from collections.abc import Iterable, Sequence

from tests.support.nodes import CoordinatorNode
from tests.support.runs import ALL, INCARNATION, plan, plant_state, setup, ticks
from transport.protocol.wire.messages import Message, Presence, agent_name

THREE = ticks(3)
CONTINUE = "clock.on_agent_loss=continue"
TIMEOUT_S = 5.0  # clock.barrier_timeout_s, the default
S, MS = 10**9, 10**6  # ns
START_NS = 7 * S  # a steady clock starts at an arbitrary time


def coordinator(*settings: str, observers: Sequence[str] = ()) -> CoordinatorNode:
    """Return a coordinator that waits for all processes of a run of three ticks."""
    return CoordinatorNode(setup(THREE, *settings), observers=observers)


def ready(name: str, incarnation: int = INCARNATION) -> Presence:
    """Return the event that a process is ready."""
    return Presence(name, incarnation, alive=True)


def gone(name: str, incarnation: int = INCARNATION) -> Presence:
    """Return the event that a process's token has disappeared."""
    return Presence(name, incarnation, alive=False)


def tell(
    node: CoordinatorNode, events: Iterable[Message | Presence], now_ns: int = START_NS
) -> list[Message]:
    """Deliver events at one time and return all messages."""
    return [message for event in events for message in node.receive(event, now_ns)]


def started(node: CoordinatorNode, now_ns: int = START_NS) -> CoordinatorNode:
    """Return the coordinator with all processes ready and tick 0 open."""
    tell(node, [ready(name) for name in ("plant", *map(agent_name, ALL))], now_ns)
    assert node.tick == 0
    return node


def answers(k: int, agents: Sequence[int] = ALL) -> list[Message]:
    """Return the plans of tick k."""
    return [plan(setup(THREE), agent, k) for agent in agents]


def at_last_tick(node: CoordinatorNode, now_ns: int = START_NS) -> CoordinatorNode:
    """Return the coordinator with its last tick open and unanswered."""
    started(node, now_ns)
    for k in (0, 1):
        tell(node, [*answers(k), plant_state(setup(THREE), k)], now_ns)
    assert node.tick == 2
    return node


def kinds(messages: Sequence[Message]) -> list[str]:
    """Return kinds and ticks of messages, in order."""
    return [f"{message.kind} {message.tick}" for message in messages]
