"""The coordinator: barrier, pacing, membership, incarnations."""

import pytest
from msgspec.structs import replace

from tests.support.coordinator_clock import (
    CONTINUE,
    MS,
    START_NS,
    THREE,
    TIMEOUT_S,
    answers,
    coordinator,
    gone,
    kinds,
    ready,
    started,
    tell,
)
from tests.support.runs import ALL, plan, plant_state, setup
from transport.protocol.wire.errors import MessageError
from transport.protocol.wire.messages import NO_NEWS, Airtime, Control, Roster, Tick

PACED = "clock.speed=1"
BARRIER_NS = round(TIMEOUT_S * 1e9)


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


@pytest.mark.parametrize("mode", ["clock.speed=0", "clock.speed=1"])
def test_on_a_radio_a_silent_plant_ends_the_run(mode: str) -> None:
    """Tick 2 opens with the positions of tick 0: without them the coordinator waits, and never spins."""
    node = started(coordinator("radio={}", CONTINUE, mode))
    later_ns = START_NS + 60 * MS
    assert kinds([*tell(node, answers(0), later_ns), *node.poll(later_ns)])[-1] == "tick 1"
    assert kinds(tell(node, answers(1), later_ns + 60 * MS)) == []
    expires_ns = later_ns + BARRIER_NS
    assert node.wake_ns == expires_ns
    assert not node.poll(expires_ns - 1)
    (end,) = node.poll(expires_ns)
    assert isinstance(end, Control)
    assert (end.outcome, end.exit_code) == ("aborted", 4)
    assert end.reason == "plant did not answer tick 0 in time"


def test_on_a_radio_the_plants_state_opens_the_tick_that_waits_for_it() -> None:
    """The state of tick 0 that comes after all answers to tick 1 opens tick 2."""
    node = started(coordinator("radio={}"))
    tell(node, answers(0))
    assert tell(node, answers(1)) == []
    assert kinds(tell(node, [plant_state(setup(), 0)])) == ["airtime 2", "tick 2"]


def test_an_agent_that_blocks_a_negotiation_is_lost_alone() -> None:
    """The others, which wait for its proposal, have the whole timeout again."""
    node = started(coordinator("controller.negotiation_iterations=3", CONTINUE))
    proposals = [replace(answer, negotiation=2) for answer in answers(0, (1, 2, 3))]
    assert tell(node, proposals) == []
    expires_ns = START_NS + BARRIER_NS
    (left,) = node.poll(expires_ns)
    assert isinstance(left, Roster)
    assert left.agents == (1, 2, 3)
    assert node.wake_ns == expires_ns + BARRIER_NS
    assert not node.poll(expires_ns + BARRIER_NS - 1)
    assert kinds(tell(node, answers(0, (1, 2, 3)), expires_ns + MS)) == ["tick 1"]


def test_in_lockstep_a_plan_of_an_earlier_tick_is_refused() -> None:
    """Real time takes late plans; in lockstep an answer belongs to the open tick."""
    node = started(coordinator())
    tell(node, answers(0))
    node.check_moment(plan(setup(THREE), 1, 1))
    with pytest.raises(MessageError, match="tick"):
        node.check_moment(plan(setup(THREE), 1, 0))


def test_a_plan_is_not_on_its_way_to_an_agent_that_joins_after_it() -> None:
    """Agent 2 returns at tick 1: nothing is said of it as a receiver of plans of tick 0."""
    node = started(coordinator("radio={}", CONTINUE))
    tell(node, [gone("agent2"), ready("agent2", 2)])
    _, news, tick = tell(node, answers(0, (1, 3, 4)))
    assert isinstance(news, Airtime)
    assert isinstance(tick, Tick)
    assert tick.members == ALL
    assert news.agents == (1, 3, 4)
    is_told = news.arrivals != NO_NEWS
    assert is_told.tolist() == [
        [False, False, True, True],
        [True, False, False, True],
        [True, False, True, False],
    ]
