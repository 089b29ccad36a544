"""Agents that return at a scripted tick, which waits for them, and agents that fall behind in a negotiation."""

from collections.abc import Sequence

from msgspec.structs import replace

from tests.support.coordinator_clock import (
    CONTINUE,
    MS,
    START_NS,
    TIMEOUT_S,
    S,
    gone,
    kinds,
    ready,
    started,
    tell,
)
from tests.support.nodes import CoordinatorNode
from tests.support.runs import ALL, plan, plant_state, setup, ticks
from transport.protocol.wire.messages import Control, Message, Roster, Tick

BARRIER_NS = round(TIMEOUT_S * S)
JOIN_NS = 30 * S  # clock.join_timeout_s, the default
SIX = ticks(6)
ITERATIONS = "controller.negotiation_iterations=3"
LEFT = (1, 3, 4)


def answers(k: int, agents: Sequence[int] = ALL, incarnation: int = 1) -> list[Message]:
    """Plans of tick k."""
    return [plan(setup(SIX), agent, k, incarnation=incarnation) for agent in agents]


def held(*killed: int) -> CoordinatorNode:
    """Agents, by default agent 2, were killed when tick 1 opened.

    Tick 2 is answered by the others, and tick 3 is to have them back.
    """
    dead = killed or (2,)
    left = [agent for agent in ALL if agent not in dead]
    events = ",".join(
        f"{{at_s=0.05,do='kill',target='agent{agent}'}},"
        f"{{at_s=0.15,do='restart',target='agent{agent}'}}"
        for agent in dead
    )
    node = started(CoordinatorNode(setup(SIX, CONTINUE, f"faults.event=[{events}]")))
    tell(node, [*answers(0), *(gone(f"agent{agent}") for agent in dead)])
    for k in (1, 2):
        tell(node, [*answers(k, left), plant_state(setup(SIX), k - 1)])
    assert node.tick == 2
    return node


def test_a_tick_waits_for_agents_that_return_at_it() -> None:
    """The tick at which an agent is to return opens when the agent is ready, with its new incarnation."""
    node = held()
    assert node.wake_ns == START_NS + JOIN_NS
    assert node.poll(START_NS + JOIN_NS - 1) == ()
    joined, tick = tell(node, [ready("agent2", 2)], START_NS + 10 * MS)
    assert isinstance(joined, Roster)
    assert (joined.tick, joined.agents, joined.incarnations) == (3, ALL, (1, 2, 1, 1))
    assert isinstance(tick, Tick)
    assert (tick.tick, tick.members, tick.answered, tick.roster) == (3, ALL, LEFT, joined.version)


def test_a_tick_is_held_no_longer_than_the_join_timeout() -> None:
    """After `clock.join_timeout_s` the run continues without the agent, and a roster says so."""
    node = held()
    roster, tick = node.poll(START_NS + JOIN_NS)
    assert isinstance(roster, Roster)
    assert (roster.agents, roster.reason) == (LEFT, "agent2 did not return at t = 0.15 s")
    assert isinstance(tick, Tick)
    assert tick.members == LEFT
    assert kinds(tell(node, answers(3, LEFT))) == ["tick 4"]


def test_only_agents_that_are_not_back_are_given_up() -> None:
    """Of two that are to return at a tick one does; the record names the other alone."""
    node = held(2, 3)
    assert tell(node, [ready("agent3", 2)], START_NS + 10 * MS) == []
    rosters = [one for one in node.poll(START_NS + JOIN_NS) if isinstance(one, Roster)]
    assert [roster.reason for roster in rosters] == [
        "agent2 did not return at t = 0.15 s",
        "agent3 joined at t = 0.15 s",
    ]


def proposals(agents: Sequence[int], negotiation: int) -> list[Message]:
    """Plans of tick 0 that are still negotiated."""
    return [
        replace(plan(setup(SIX, ITERATIONS), agent, 0), negotiation=negotiation) for agent in agents
    ]


def test_all_agents_stuck_in_a_negotiation() -> None:
    """When all agents are equally far behind, the plant is the likely cause and the run ends."""
    node = started(CoordinatorNode(setup(SIX, ITERATIONS, CONTINUE)))
    tell(node, proposals(ALL, 2))
    (end,) = node.poll(START_NS + BARRIER_NS)
    assert isinstance(end, Control)
    assert end.reason == "no agent answered tick 0 in time: is the plant alive?"
