"""Negotiation within a tick: an iteration waits for the proposals of all agents on the roster."""

import pytest
from msgspec.structs import replace

from protocol.wire.messages import Message, Plan, Presence
from tests.support.nodes import AgentNode
from tests.support.runs import measurement, plan, roster, setup

NEGOTIATION = ("controller.horizon=5", "controller.negotiation_iterations=3")
OTHERS = (2, 3, 4)


def proposal(agent: int, k: int, left: int, incarnation: int = 1) -> Plan:
    """Return a plan of tick k after which so many exchanges follow."""
    return replace(plan(setup(*NEGOTIATION), agent, k, incarnation=incarnation), negotiation=left)


def answers(node: AgentNode, *events: Message | Presence) -> list[str | int]:
    """Return the exchanges to come after each plan of the agent, and the kinds of its other messages."""
    sent = [message for event in events for message in node.receive(event, 0)]
    return [message.negotiation if isinstance(message, Plan) else message.kind for message in sent]


@pytest.fixture
def node() -> AgentNode:
    """Return agent 1, which has begun to negotiate tick 0."""
    node = AgentNode(setup(*NEGOTIATION), 1)
    assert answers(node, roster(), measurement(setup(*NEGOTIATION), 1, 0)) == [2]
    return node


@pytest.mark.parametrize("last", OTHERS)
def test_an_iteration_needs_all_proposals(node: AgentNode, last: int) -> None:
    """The next plan is made when the proposals of all agents are here, in any order."""
    others = [agent for agent in OTHERS if agent != last]
    assert answers(node, *[proposal(agent, 0, 2) for agent in others]) == []
    assert answers(node, proposal(last, 0, 2)) == [1]
    assert answers(node, *[proposal(agent, 0, 1) for agent in others]) == []
    assert answers(node, proposal(last, 0, 1)) == [0, "report"]


@pytest.mark.parametrize("left", [2, 1])
def test_an_agent_that_leaves_is_not_waited_for(node: AgentNode, left: int) -> None:
    """With the roster that takes an agent off, this and all further iterations go on without it."""
    alive = (2, 4)
    if left == 1:
        assert answers(node, *[proposal(agent, 0, 2) for agent in OTHERS]) == [1]
    assert answers(node, *[proposal(agent, 0, left) for agent in alive]) == []
    gone = roster({1: 1, 2: 1, 4: 1}, version=2)
    assert answers(node, gone) == ([1] if left == 2 else [0, "report"])
    if left == 2:
        assert answers(node, *[proposal(agent, 0, 1) for agent in alive]) == [0, "report"]
