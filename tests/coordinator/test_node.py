"""The coordinator: barrier, pacing, membership, incarnations."""

import pytest

from tests.support.coordinator_clock import (
    CONTINUE,
    MS,
    START_NS,
    answers,
    coordinator,
    gone,
    kinds,
    ready,
    started,
    tell,
)
from tests.support.runs import ALL, plan, setup
from transport.protocol.wire.messages import Roster, Tick

PACED = "clock.speed=1"


@pytest.mark.parametrize(("speed", "period_ns"), [(1.0, 50 * MS), (2.0, 25 * MS), (0.5, 100 * MS)])
def test_pacing(speed: float, period_ns: int) -> None:
    """At speed s tick k opens at the first moment from k T_s / s after tick 0, on the dot when answers are early."""
    node = started(coordinator(f"clock.speed={speed}"))
    for k in (1, 2):
        assert tell(node, answers(k - 1), START_NS + (k - 1) * period_ns + 1) == []
        due = START_NS + k * period_ns
        assert node.wake_ns == due
        assert list(node.poll(due - 1)) == []
        assert kinds(node.poll(due)) == [f"tick {k}"]


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


@pytest.mark.parametrize("incarnations", [(0, 1), (0, 1, 4), (2, 1), (4, 0, 3)])
def test_newest_incarnation_takes_part(incarnations: tuple[int, ...]) -> None:
    """The newest of several incarnations of an agent is on the roster, in any order of their tokens."""
    node = coordinator()
    tell(node, [ready("agent2", incarnation) for incarnation in incarnations])
    roster, _ = tell(node, [ready(name) for name in ("plant", "agent1", "agent3", "agent4")])
    assert isinstance(roster, Roster)
    assert roster.incarnations == (1, max(incarnations), 1, 1)


@pytest.mark.parametrize("incarnations", [(2, 3), (3, 2)])
def test_the_newest_of_several_returns_joins(incarnations: tuple[int, ...]) -> None:
    """A token of an older start that comes late does not replace the newer one that waits."""
    node = started(coordinator(CONTINUE))
    tell(node, [gone("agent2", 1)])
    tell(node, [ready("agent2", incarnation) for incarnation in incarnations])
    joined, _ = tell(node, answers(0, (1, 3, 4)))
    assert isinstance(joined, Roster)
    assert joined.incarnations == (1, 3, 1, 1)


def test_a_restarted_agent_joins_at_the_next_tick() -> None:
    """A new incarnation ends the old one, is not awaited in the open tick, and takes part from the next tick on.

    The late end of the old one's token does not concern the new one.
    """
    node = started(coordinator(CONTINUE))
    (left,) = tell(node, [ready("agent2", 2)])
    assert isinstance(left, Roster)
    assert (left.agents, left.reason) == ((1, 3, 4), "agent2 is gone at t = 0.00 s")
    assert tell(node, [plan(setup(), 2, 0, incarnation=2)]) == []
    joined, tick = tell(node, answers(0, (1, 3, 4)))
    assert isinstance(joined, Roster)
    assert (joined.tick, joined.agents, joined.incarnations) == (1, ALL, (1, 2, 1, 1))
    assert joined.reason == "agent2 joined at t = 0.05 s"
    assert isinstance(tick, Tick)
    assert (tick.tick, tick.members, tick.answered, tick.roster) == (1, ALL, (1, 3, 4), 3)
    assert tell(node, [gone("agent2", 1)]) == []
    assert node.finished is None
