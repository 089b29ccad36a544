"""An agent that negotiates within a tick: whom it waits for, and for how long."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from agent.node import AgentNode
from protocol.wire.messages import Message, Plan, Presence
from tests.support.runs import measurement, plan, roster, setup

ROUNDS = ("controller.horizon=5", "controller.negotiation_iterations=3")
OTHERS = (2, 3, 4)


def proposal(agent: int, k: int, left: int, incarnation: int = 1) -> Plan:
    """A plan of tick k after which so many exchanges follow."""
    return replace(plan(setup(*ROUNDS), agent, k, incarnation=incarnation), negotiation=left)


def said(node: AgentNode, *events: Message | Presence) -> list[str | int]:
    """Exchanges to come after each plan that comes back, and whatever else does, by kind."""
    sent = [message for event in events for message in node.receive(event, 0)]
    return [message.negotiation if isinstance(message, Plan) else message.kind for message in sent]


@pytest.fixture
def node() -> AgentNode:
    """Agent 1, which has begun to negotiate tick 0."""
    node = AgentNode(setup(*ROUNDS), 1)
    assert said(node, roster(), measurement(setup(*ROUNDS), 1, 0)) == [2]
    return node


@pytest.mark.parametrize("last", OTHERS)
def test_a_round_needs_everybody(node: AgentNode, last: int) -> None:
    """The next plan is made when everybody's of the round before is here, whoever is last."""
    others = [agent for agent in OTHERS if agent != last]
    assert said(node, *[proposal(agent, 0, 2) for agent in others]) == []
    assert said(node, proposal(last, 0, 2)) == [1]
    assert said(node, *[proposal(agent, 0, 1) for agent in others]) == []
    assert said(node, proposal(last, 0, 1)) == [0, "report"]


def test_others_may_be_a_round_ahead(node: AgentNode) -> None:
    """Plans of the round to come that overtake somebody's of this one are kept."""
    assert said(node, proposal(2, 0, 2), proposal(3, 0, 2), proposal(2, 0, 1), proposal(3, 0, 1)) == []
    assert said(node, proposal(4, 0, 2)) == [1]
    assert said(node, proposal(4, 0, 1)) == [0, "report"]


def test_proposals_before_the_measurement() -> None:
    """Whoever was measured first proposes first: that is kept until the own tick opens."""
    run = setup(*ROUNDS)
    node = AgentNode(run, 1)
    assert said(node, roster(), *[proposal(agent, 0, 2) for agent in OTHERS]) == []
    assert said(node, measurement(run, 1, 0)) == [2, 1]


@pytest.mark.parametrize("left", [2, 1])
def test_who_dies_in_the_middle_is_not_waited_for(node: AgentNode, left: int) -> None:
    """With the roster that takes an agent off, the round it owes goes on without it, and so do all further ones."""
    alive = (2, 4)
    if left == 1:
        assert said(node, *[proposal(agent, 0, 2) for agent in OTHERS]) == [1]
    assert said(node, *[proposal(agent, 0, left) for agent in alive]) == []
    gone = roster({1: 1, 2: 1, 4: 1}, version=2)
    assert said(node, gone) == ([1] if left == 2 else [0, "report"])
    if left == 2:
        assert said(node, *[proposal(agent, 0, 1) for agent in alive]) == [0, "report"]


def test_the_last_one_left(node: AgentNode) -> None:
    """An agent that is alone on the roster has all its rounds to itself."""
    assert said(node, roster({1: 1}, version=2)) == [1, 0, "report"]


def test_proposals_do_not_stand_for_answers(node: AgentNode) -> None:
    """The next tick needs the others' last plans of this one: what they proposed before does not do."""
    run = setup(*ROUNDS)
    for left in (2, 1):
        said(node, *[proposal(agent, 0, left) for agent in OTHERS])
    assert said(node, measurement(run, 1, 1)) == []
    assert said(node, *[plan(run, agent, 0) for agent in OTHERS[:2]]) == []
    assert said(node, plan(run, 4, 0)) == [2]


def test_proposals_of_strangers_do_not_count(node: AgentNode) -> None:
    """A proposal of another incarnation, or of more rounds than there are, is refused."""
    wrong: Sequence[Plan] = [proposal(4, 0, 2, incarnation=0), proposal(4, 0, 3)]
    assert said(node, proposal(2, 0, 2), proposal(3, 0, 2), *wrong) == []
    assert node.rejected.total == 2
    assert said(node, proposal(4, 0, 2)) == [1]
