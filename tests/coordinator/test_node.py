"""The coordinator: barrier, pacing, membership, incarnations."""

import pytest

from tests.support.coordinator_clock import (
    CONTINUE,
    START_NS,
    answers,
    at_last_tick,
    coordinator,
    gone,
    ready,
    started,
    tell,
)
from tests.support.runs import ALL, plant_state, setup, ticks
from transport.coordinator.outcome import Verdict
from transport.coordinator.roster import TeamRoster
from transport.protocol.wire.messages import UNREPORTED, Airtime, Control, Roster, Tick
from transport.protocol.wire.names import agent_name
from transport.protocol.wire.outbox import Outbox

PACED = "clock.speed=1"


def test_polling_at_wake_always_does_something() -> None:
    """Polling at `wake_ns` always returns messages: a loop never spins."""
    node = started(coordinator(PACED, CONTINUE))
    for k in range(3):
        tell(node, answers(k, (1, 2, 3) if k == 0 else (1, 2)), START_NS + k)
        while node.tick == k and node.finished is None:
            wake = node.wake_ns
            assert wake is not None
            assert node.poll(wake - 1) == ()
            assert len(node.poll(wake)) > 0


def test_a_plan_is_not_on_its_way_to_an_agent_that_joins_after_it() -> None:
    """Agent 2 returns at tick 1: nothing is said of it as a receiver of plans of tick 0."""
    node = started(coordinator("radio={}", CONTINUE))
    tell(node, [gone("agent2"), ready("agent2", 2)])
    _, reports, tick = tell(node, answers(0, (1, 3, 4)))
    assert isinstance(reports, Airtime)
    assert isinstance(tick, Tick)
    assert tick.members == ALL
    assert reports.agents == (1, 3, 4)
    is_told = reports.arrivals != UNREPORTED
    assert is_told.tolist() == [
        [False, False, True, True],
        [True, False, False, True],
        [True, False, True, False],
    ]


@pytest.mark.parametrize(
    ("exit_code", "outcome"),
    [(0, "completed"), (6, "diverged"), (7, "failed"), (11, "collided"), (4, "aborted")],
)
def test_the_outcome_follows_from_the_exit_code(
    exit_code: int, outcome: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the end of the last tick, with the verdict's reason."""
    monkeypatch.setattr(Verdict, "outcome", lambda _: (exit_code, "why"))
    node = at_last_tick(coordinator())
    sent = tell(node, [*answers(2), plant_state(setup(ticks(3)), 2)])
    (end,) = [message for message in sent if isinstance(message, Control)]
    assert (end.exit_code, end.outcome, end.reason, end.tick) == (exit_code, outcome, "why", 2)


def test_failures_of_ticks_that_were_passed_are_told_at_the_next() -> None:
    """A coordinator that takes over in flight begins after them; later ones wait."""
    faults = (
        "faults.event=[{at_s=0.05,do='motor_off',target='uav4'},"
        "{at_s=0.1,do='motor_off',target='uav2'}]"
    )
    roster = TeamRoster(setup(ticks(9), faults).rules, Outbox("coordinator", 0))
    for agent in ALL:
        roster.start(agent_name(agent), 0)
    told = [
        [one.off for one in roster.report_failures(tick) if isinstance(one, Roster)]
        for tick in (0, 5, 6)
    ]
    assert told == [[], [(4,), (2, 4)], []]
