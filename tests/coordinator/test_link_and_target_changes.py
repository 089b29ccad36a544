"""Targets that a coordinator tells, by its script and by request, with a planner that only notes them."""

from typing import Any

import numpy as np
import pytest
from msgspec import structs

from tests.coordinator.test_fleet import status
from tests.support.runs import ALL, ready, setup, ticks
from transport.coordinator.link_and_target_changes import Changes
from transport.coordinator.roster import TeamRoster
from transport.protocol.scenario.sections.scenario_errors import RequestError
from transport.protocol.wire.codec import encode
from transport.protocol.wire.message_form import MAX_TARGETS
from transport.protocol.wire.messages import Message, Roster, Target
from transport.protocol.wire.names import agent_name
from transport.protocol.wire.outbox import Outbox

LAND = {"land": True}


class Noting:
    """A planner that refuses "bad", and notes the targets that it is to follow."""

    def __init__(self) -> None:
        self.followed: list[int] = []

    def fields(self, wanted: Any, tick: int) -> dict[str, Any]:
        """Return the fields of a target."""
        if wanted == "bad":
            raise RequestError("why")
        return {
            "tick": tick,
            "points": np.zeros((1, 3)),
            "times": np.zeros(1),
            "approach_s": 5.0,
            "approach_ramp_s": 2.0,
            "way_s": 0.0,
            "way_ramp_s": 0.0,
            "to": (),
            "lands": wanted == LAND,
        }

    def follow(self, target: Target) -> None:
        """Note a target."""
        self.followed.append(target.number)


def changes(*scripted: tuple[int, Any], lands_at: int | None = None) -> tuple[Changes, Noting]:
    """Return the changes of a run with a script, and their planner."""
    planner = Noting()
    out = Outbox("coordinator", 0)
    roster = TeamRoster(setup(ticks(9)).rules, out)
    for agent in ALL:
        roster.start(agent_name(agent), 0)
    return Changes(roster, out, planner, scripted, lands_at), planner


def told(messages: list[Message]) -> list[Any]:
    """Return the number of each target, with a sign that it lands, and the reason of other rosters."""
    return [
        (one.number, one.lands) if isinstance(one, Target) else one.reason
        for one in messages
        if isinstance(one, Target | Roster) and " on" not in getattr(one, "reason", "")
    ]


def test_scripted_targets_are_told_at_their_ticks() -> None:
    """Those of ticks that were passed at the next one; one out of reach is refused with the reason."""
    made, planner = changes((2, "a"), (5, "bad"), (7, "b"))
    found = {tick: told(made.announce_scripted(tick)) for tick in (1, 2, 6, 7)}
    assert found == {1: [], 2: [(1, False)], 6: ["target refused: why"], 7: [(2, False)]}
    assert planner.followed == [1, 2]


@pytest.mark.parametrize(
    ("asked", "later"), [("a", [(2, False), (3, True)]), (LAND, [])], ids=["target", "landing"]
)
def test_after_a_landing_no_other_target_is_told(asked: Any, later: list[Any]) -> None:
    """Neither a scripted one nor the landing at the end of a maneuver, which is told once."""
    made, _ = changes((3, "b"), lands_at=4)
    made.target(asked, 1)
    assert (made.landing is not None) == (asked == LAND)
    assert [one for tick in (2, 3, 4, 5) for one in told(made.announce_scripted(tick))] == later
    assert made.landing is not None
    assert (made.landing.number, made.landing.tick) == ((1, 1) if asked == LAND else (3, 4))


@pytest.mark.parametrize(
    ("known", "tick", "later"),
    [("a", 2, [(2, False)]), (LAND, 2, [(2, False)]), (LAND, 1, []), ("a", 1, [(2, False)])],
)
def test_a_coordinator_that_returns_goes_on_with_the_script(
    known: Any, tick: int, later: list[Any]
) -> None:
    """It was followed until the newest target that a vehicle knows; a landing that was asked for ends it."""
    script = ((2, known), (9, "b")) if tick == 2 else ((9, "b"),)
    made, planner = changes(*script)
    fields = Noting().fields(known, tick)
    target = Outbox("coordinator", 0).stamp(Target, number=1, **fields)
    word = structs.replace(status(ready("flight"), 1), targets=1, changes=(encode(target),))
    made.learn(word)
    made.learn(word)
    assert planner.followed == [1]
    assert [one for k in (2, 3, 9) for one in told(made.announce_scripted(k))] == later


def test_links_are_repeated_before_targets_and_their_number_is_limited() -> None:
    """In the order of each kind; one target more than a run may have is refused."""
    made, _ = changes()
    made.target("a", 1)
    made.link({"settings": {"loss": 0.5}}, 1)
    assert [one.kind for one in made.repeated()] == ["link", "target"]
    for _ in range(MAX_TARGETS - 1):
        made.target("a", 1)
    with pytest.raises(RequestError, match=f"at most {MAX_TARGETS} targets"):
        made.target("a", 1)


def test_groups_and_all_links_are_two_requests() -> None:
    """Each names the links by itself."""
    made, _ = changes()
    given = {"groups": [["agent1"], ["agent2"]], "all": True, "settings": {"loss": 1.0}}
    with pytest.raises(RequestError, match="groups: expected no other links beside it"):
        made.link(given, 1)
