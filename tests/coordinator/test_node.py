"""The coordinator: barrier, pacing, membership, incarnations."""

from tests.support.coordinator_clock import (
    CONTINUE,
    START_NS,
    answers,
    coordinator,
    gone,
    ready,
    started,
    tell,
)
from tests.support.runs import ALL
from transport.protocol.wire.messages import UNREPORTED, Airtime, Tick

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
