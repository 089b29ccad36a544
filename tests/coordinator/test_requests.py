"""Requests to the coordinator: status of the run, and changes of links."""

import json
from collections.abc import Mapping
from typing import Any

import pytest

from tests.support.coordinator_clock import (
    CONTINUE,
    START_NS,
    answers,
    at_last_tick,
    coordinator,
    gone,
    kinds,
    started,
    tell,
)
from tests.support.coordinator_clock import ready as is_ready
from tests.support.nodes import CoordinatorNode
from transport.protocol.scenario.links.link_changes import PERFECT
from transport.protocol.wire.messages import LinkChange, Message, Request, Roster


def answer_to(
    node: CoordinatorNode, what: str, **given: Any
) -> tuple[Mapping[str, Any], list[Message]]:
    """The one answer to a request, and what is sent because of it."""
    replies: list[Mapping[str, Any]] = []
    sent = list(node.receive(Request(what, given, replies.append), START_NS))
    (reply,) = replies
    json.dumps(reply)  # it travels as JSON
    return reply, sent


def change(node: CoordinatorNode, **settings: Any) -> tuple[Mapping[str, Any], list[Message]]:
    """A change of the links from agent 1."""
    return answer_to(node, "link", **{"from": "agent1"}, settings=settings)


def test_status() -> None:
    """Status is tick, length, members and observers, before the first tick, later, and after the loss of an agent."""
    node = coordinator(CONTINUE, observers=["recorder"])
    assert answer_to(node, "status")[0]["tick"] == -1
    tell(
        node,
        [is_ready(name) for name in ("recorder", "plant", "agent1", "agent2", "agent3", "agent4")],
    )
    expected = {"tick": 0, "ticks": 3, "members": [1, 2, 3, 4], "observers": ["recorder"]}
    assert answer_to(node, "status") == (expected, [])
    tell(node, [gone("agent2"), gone("recorder"), *answers(0, (1, 3, 4))])
    assert answer_to(node, "status") == (
        {"tick": 1, "ticks": 3, "members": [1, 3, 4], "observers": []},
        [],
    )


def test_a_change_of_links() -> None:
    """A change holds from the next tick on, is numbered, and comes with a roster that the ticks name."""
    node = started(coordinator())
    reply, sent = change(node, delay_s=0.1)
    assert reply == {"tick": 1, "t_s": 0.05}
    first, roster = sent
    assert isinstance(first, LinkChange)
    assert (first.tick, first.number, first.source, first.target) == (1, 1, "agent1", "")
    assert json.loads(first.settings) == {"delay_s": 0.1}
    assert isinstance(roster, Roster)
    assert (roster.version, roster.agents) == (2, (1, 2, 3, 4))
    assert roster.reason == "links from agent1: delay_s 0.1, from t = 0.05 s on"
    (second, _) = change(node, loss=0.5)[1]
    assert isinstance(second, LinkChange)
    assert second.number == 2
    assert kinds(tell(node, answers(0))) == ["tick 1"]


def test_all_changes_are_repeated_for_joining_agents() -> None:
    """All changes so far are sent again, in order, before the roster of the agent that joins."""
    node = started(coordinator(CONTINUE))
    changes = [change(node, delay_s=0.1)[1][0], change(node, loss=0.2)[1][0]]
    tell(node, [gone("agent2"), is_ready("agent2", 2)])
    sent = tell(node, answers(0, (1, 3, 4)))
    assert kinds(sent) == ["link 1", "link 1", "roster 1", "tick 1"]
    for repeated, message in zip(sent, changes, strict=False):
        assert isinstance(repeated, LinkChange)
        assert isinstance(message, LinkChange)
        assert (repeated.number, repeated.tick, repeated.settings) == (
            message.number,
            message.tick,
            message.settings,
        )
    assert len({message.sequence for message in [*changes, *sent]}) == 6  # numbered anew


def test_a_cut_between_groups() -> None:
    """All links from one group of agents to another change at the same tick, in both directions."""
    node = started(coordinator())
    groups = [["agent1"], ["agent2", "agent3"]]
    reply, sent = answer_to(node, "link", groups=groups, settings={"loss": 1.0})
    assert reply == {"tick": 1, "t_s": 0.05}
    *changes, roster = sent
    ends = []
    for number, one in enumerate(changes, start=1):
        assert isinstance(one, LinkChange)
        assert (one.tick, one.number, json.loads(one.settings)) == (1, number, {"loss": 1.0})
        ends.append((one.source, one.target))
    assert sorted(ends) == [
        ("agent1", "agent2"),
        ("agent1", "agent3"),
        ("agent2", "agent1"),
        ("agent3", "agent1"),
    ]
    assert isinstance(roster, Roster)
    assert roster.reason.startswith("links between agent1 | agent2, agent3")


def test_all_links_are_cleared_at_one_tick() -> None:
    """Those between agents, from the plant and to it."""
    node = started(coordinator())
    _, sent = answer_to(node, "link", all=True, settings=dict(PERFECT))
    *changes, roster = sent
    ends = [(one.source, one.target) for one in changes if isinstance(one, LinkChange)]
    assert ends == [("", ""), ("plant", ""), ("", "plant")]
    assert isinstance(roster, Roster)
    assert roster.reason == "all links cleared, from t = 0.05 s on"


@pytest.mark.parametrize("end", ["agent1", "plant"])
def test_a_link_from_a_process_to_itself_is_refused(end: str) -> None:
    """Agents would refuse the change, and with it all later ones: none is sent."""
    node = started(coordinator())
    named = {"from": end, "to": end, "settings": {"loss": 1.0}}
    reply, sent = answer_to(node, "link", **named)
    assert "error" in reply
    assert sent == []
    reply, _ = answer_to(node, "link", settings={"loss": 1.0})
    assert reply == {"tick": 1, "t_s": 0.05}


@pytest.mark.parametrize(
    "groups",
    [[], [["agent1"]], [["agent1"], []], [["agent1"], ["agent1"]], [["agent1"], ["plant"]], "x", 3],
)
def test_other_groups_are_refused(groups: Any) -> None:
    """Fewer than two groups, empty ones, an agent twice, and other processes are refused."""
    reply, sent = answer_to(started(coordinator()), "link", groups=groups, settings={"loss": 1.0})
    assert reply["error"].startswith("groups: expected two or more lists of agents, each once")
    assert sent == []


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"settings": {}}, "expected at least one key of a link, got none"),
        ({}, "expected a JSON object of a link's keys"),
        ({"settings": {"lag": 2.0}}, "lag"),
        (
            {"from": "agent9", "settings": {"loss": 0.1}},
            "from: expected one of plant, agent1, agent2",
        ),
        (
            {"to": "coordinator", "settings": {"loss": 0.1}},
            "to: expected one of plant, agent1, agent2",
        ),
        (
            {"groups": [["agent1"], ["agent2"]], "to": "agent1", "settings": {"loss": 1.0}},
            "groups: expected no other links beside it",
        ),
        ({"all": True, "from": "agent1", "settings": {"loss": 1.0}}, "all: expected no other"),
        ({"settings": {"samples_s": "x.csv"}}, "samples_s: expected a valid list, got 'x.csv'"),
        ({"settings": {"trace": "x.csv"}}, "trace: expected a valid list, got 'x.csv'"),
        (
            {"settings": {"delay_s": 1e308}},
            "delay_s: expected a magnitude of at most 10, got 1e+308",
        ),
        (
            {"settings": {"samples_s": [0.125] * 200}},
            "settings: expected at most 1000 characters, got 1",
        ),
        (
            {"settings": {"loss": 2.0}},
            "loss: expected a share, at most 1, got 2: did you mean 0.02?",
        ),
    ],
)
def test_an_invalid_change_is_refused(given: dict[str, Any], problem: str) -> None:
    """An invalid request is answered by the expected value; nothing is sent and nothing changes."""
    node = started(coordinator())
    reply, sent = answer_to(node, "link", **given)
    assert problem in reply["error"]
    assert sent == []
    assert change(node, loss=0.1)[1][0].kind == "link"


def test_there_is_no_change_without_a_next_tick() -> None:
    """Before the first tick and at the last one a change of links is refused."""
    for node in (coordinator(), at_last_tick(coordinator())):
        assert change(node, loss=0.1) == ({"error": "expected a running simulation"}, [])
