"""The coordinator in real time: absolute deadlines, missed deadlines, lost and returning agents."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tests.support.coordinator_clock import CONTINUE, MS, START_NS, S, kinds, ready, started, tell
from tests.support.nodes import CoordinatorNode
from tests.support.runs import ALL, plan, plant_state, setup, ticks
from transport.coordinator.when_ticks_open_and_close import Clock
from transport.protocol.scenario.sections.lockstep_and_realtime_section import ClockSection
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Control, Message, Plan, PlantState, Roster, Tick

REALTIME = ("clock.mode=realtime", "clock.speed=1")
PERIOD_NS = 50 * MS
BARRIER_NS = 5 * S  # clock.barrier_timeout_s, the default
HOLD, ABORT = "clock.on_overrun=hold", "clock.on_overrun=abort"


def realtime(*settings: str, length: int = 400) -> tuple[Setup, CoordinatorNode]:
    """A run of 20 s and its coordinator, tick 0 open since `START_NS`."""
    run = setup(ticks(length), *REALTIME, *settings)
    return run, started(CoordinatorNode(run))


def answers(run: Setup, k: int, agents: Sequence[int] = ALL) -> list[Message]:
    """Plans of tick k for the next."""
    return [plan(run, agent, k, delay=1) for agent in agents]


def due(k: int) -> int:
    """The deadline at which tick k is to be opened."""
    return START_NS + k * PERIOD_NS


def only_tick(messages: Sequence[Message]) -> Tick:
    """The only message, a tick."""
    (message,) = messages
    assert isinstance(message, Tick)
    return message


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_deadlines_do_not_drift(speed: float) -> None:
    """Over 10,000 ticks whose process wakes up late at random each is due k T_s / speed after the first, to 1 ns.

    A tick is opened at the first awakening at or after its deadline, and says how late that was.
    """
    count = 10_000
    run = setup(
        ticks(count), "clock.mode=realtime", f"clock.speed={speed}", "clock.barrier_timeout_s=1e6"
    )
    node = started(CoordinatorNode(run))
    rng = np.random.default_rng(1)
    # Usually some tenths of a millisecond, now and then more than a period.
    lateness_ns = (rng.exponential(0.3 * MS, count) + (rng.random(count) < 0.01) * 120 * MS).astype(
        int
    )
    now_ns = START_NS
    for k in range(1, count):
        deadline_ns = START_NS + round(k * PERIOD_NS / speed)
        assert node.wake_ns == deadline_ns
        if now_ns < deadline_ns:
            assert node.poll(deadline_ns - 1) == ()
        now_ns = max(now_ns, deadline_ns) + int(lateness_ns[k])
        opened = [message for message in node.poll(now_ns) if isinstance(message, Tick)]
        assert [tick.tick for tick in opened] == [k]
        assert opened[0].late_ns == now_ns - deadline_ns
    assert lateness_ns.sum() > 10 * 120 * MS  # it has really been late


@pytest.mark.parametrize("mode", [REALTIME, ("clock.speed=1",), ("clock.speed=0",)])
def test_the_coordinators_own_absence_restarts_the_timeouts(mode: tuple[str, ...]) -> None:
    """After an absence of its own, all agents look silent to the coordinator, which restarts their timeouts."""
    for first in ("poll", "receive"):
        run = setup(ticks(400), *mode)
        node = started(CoordinatorNode(run))
        delay = int(run.scenario.clock.next_tick)
        now_ns = START_NS + 3 * BARRIER_NS
        if first == "poll":
            node.poll(now_ns)
        else:
            node.receive(plan(run, 1, 0, delay=delay), now_ns)
        tell(node, [plan(run, agent, 0, delay=delay) for agent in ALL], now_ns + MS)
        tell(node, [plant_state(run, 0)], now_ns + MS)
        node.poll(now_ns + 2 * MS)
        assert node.finished is None
        assert node.tick > 0


def test_a_coordinator_that_always_wakes_up_late_loses_a_silent_agent() -> None:
    """Its absence restarts the timeouts once while a tick is open, not each time."""
    run = setup(ticks(400), CONTINUE)
    node = started(CoordinatorNode(run))
    delay = int(run.scenario.clock.next_tick)
    answered = [plan(run, agent, 0, delay=delay) for agent in (1, 2, 3)]
    tell(node, [*answered, plant_state(run, 0)], START_NS + MS)
    for is_silent in (False, True):
        assert node.wake_ns is not None
        rosters = [one for one in node.poll(node.wake_ns + 300 * MS) if isinstance(one, Roster)]
        assert [one.agents for one in rosters] == [(1, 2, 3)] * is_silent


def run_until(
    run: Setup, node: CoordinatorNode, until_ns: int, silent: Sequence[str]
) -> tuple[list[Message], int]:
    """Let all but the silent processes answer every tick at once.

    Return the first messages besides ticks, and when.
    """
    sent_else: list[Message] = []
    agents = [agent for agent in ALL if f"agent{agent}" not in silent]
    while node.finished is None and node.wake_ns is not None and node.wake_ns < until_ns:
        now_ns = node.wake_ns
        sent = list(node.poll(now_ns))
        sent_else += [message for message in sent if not isinstance(message, Tick)]
        events: list[Plan | PlantState | Message] = [*answers(run, node.tick, agents)]
        tell(node, events if "plant" in silent else [*events, plant_state(run, node.tick)], now_ns)
        if sent_else:
            return sent_else, now_ns
    return sent_else, until_ns


def test_a_frozen_agent_is_taken_off_the_roster() -> None:
    """An agent that is silent for the barrier timeout leaves the roster.

    Ticks open on time before and after.
    """
    run, node = realtime(CONTINUE)
    tell(node, [*answers(run, 0), plant_state(run, 0)])
    sent, now_ns = run_until(run, node, due(400), ["agent4"])
    (roster,) = sent
    assert isinstance(roster, Roster)
    assert roster.agents == (1, 2, 3)
    assert roster.reason.startswith("agent4 did not answer tick ")
    # It owes its answer since tick 1 was opened; a tick is the clock's resolution.
    assert due(1) + BARRIER_NS <= now_ns <= due(2) + BARRIER_NS
    tick = node.tick
    sent, _ = run_until(run, node, due(150), ["agent4"])
    assert sent == []
    assert node.tick - tick > 30


def test_a_coordinator_that_falls_behind_loses_a_frozen_agent_all_the_same() -> None:
    """Each message takes it longer than a period: it is later and later, but was never away."""
    run, node = realtime(CONTINUE)
    now_ns = START_NS
    handling_ns = 80 * MS
    sent: list[Message] = []
    while not sent and now_ns < START_NS + 2 * BARRIER_NS:
        for event in [*answers(run, node.tick, (1, 2, 3)), plant_state(run, node.tick)]:
            now_ns += handling_ns
            node.receive(event, now_ns)
        sent = [message for message in node.poll(now_ns) if isinstance(message, Roster)]
    assert now_ns - due(node.tick) > S, "it has not fallen behind"
    assert len(sent) == 1
    assert due(0) + BARRIER_NS <= now_ns <= due(0) + BARRIER_NS + 8 * handling_ns


def test_a_frozen_agent_that_returns_has_the_whole_timeout() -> None:
    """A new start of an agent owes its answer since it joined, not since the last one was lost."""
    run, node = realtime(CONTINUE)
    tell(node, [*answers(run, 0), plant_state(run, 0)])
    _, now_ns = run_until(run, node, due(400), ["agent4"])
    assert tell(node, [ready("agent4", 2)], now_ns) == []
    assert node.wake_ns is not None
    joined_ns = node.wake_ns
    roster, tick = node.poll(joined_ns)
    assert isinstance(roster, Roster)
    assert isinstance(tick, Tick)
    assert (roster.agents, tick.members) == (ALL, ALL)
    events = [*answers(run, node.tick, (1, 2, 3)), plant_state(run, node.tick)]
    assert tell(node, events, joined_ns + MS) == []
    assert node.poll(joined_ns + 2 * MS) == ()

    sent, lost_ns = run_until(run, node, due(400), ["agent4"])
    assert [message.kind for message in sent] == ["roster"]
    assert joined_ns + BARRIER_NS <= lost_ns <= joined_ns + BARRIER_NS + PERIOD_NS


def test_a_slow_agent_is_not_lost() -> None:
    """An agent that always answers late stays on the roster: missed deadlines are not silence."""
    run, node = realtime(CONTINUE)
    for k in range(1, 200):
        now_ns = due(k)
        assert kinds(node.poll(now_ns)) == [f"tick {k}"]
        tell(node, [*answers(run, k, (1, 2, 3)), plant_state(run, k - 1)], now_ns + MS)
        tell(node, answers(run, max(k - 3, 0), (4,)), now_ns + 2 * MS)
    assert node.finished is None


def test_a_frozen_plant_ends_the_run() -> None:
    """A plant that is silent for the barrier timeout ends the run, whatever `clock.on_agent_loss` says."""
    run, node = realtime(CONTINUE)
    tell(node, [*answers(run, 0), plant_state(run, 0)])
    sent, now_ns = run_until(run, node, due(400), ["plant"])
    (end,) = sent
    assert isinstance(end, Control)
    assert (end.outcome, end.exit_code) == ("aborted", 4)
    assert end.reason == "plant has not answered since tick 0"
    assert due(1) + BARRIER_NS <= now_ns <= due(2) + BARRIER_NS


def clock(**settings: Any) -> Clock:
    """Return a clock in real time, at twice the speed, with a barrier timeout of 1 s."""
    given = {"mode": "realtime", "speed": 2.0, "actuation": "next_tick", "barrier_timeout_s": 1.0}
    return Clock(ClockSection(**{**given, **settings}), PERIOD_NS)


def test_ticks_are_due_from_the_first_on_at_the_speed_of_the_run() -> None:
    """From the instant that the vehicles were told, or else from that at which tick 0 opens."""
    told, free = clock(), clock()
    told.begin(START_NS)
    for one in (told, free):
        one.open(0, ALL, (), START_NS + 7)
    assert (told.due_ns(4), free.due_ns(4)) == (START_NS + 100 * MS, START_NS + 100 * MS + 7)
    past_ns = (-10 * S, -1, 0, 25 * MS - 1, 25 * MS, 40 * MS)
    assert [told.newest(START_NS + ns) for ns in past_ns] == [-1, -1, 0, 0, 1, 1]
    at_once = clock(mode="lockstep", speed=0.0)
    at_once.begin(START_NS)
    assert at_once.due_ns(9) == 0
    # In lockstep alone the last tick closes with its last answer, and no deadline is missed.
    paced = clock(mode="lockstep", speed=1.0, on_overrun="abort", overrun_limit=0)
    paced.begin(START_NS)
    for one, last, closes in ((paced, True, True), (paced, False, False), (told, True, False)):
        assert one.is_time_to_close(3, set(), START_NS, last=last) is closes
    assert paced.judge_overruns(3, {4}, START_NS + S) == ""


def test_an_agent_is_silent_that_owes_an_answer_for_the_timeout() -> None:
    """Since the oldest open tick, its late plan or its return; the plant since its own answer."""
    one = clock()
    one.begin(START_NS)
    one.note_plant(START_NS + 3 * MS)
    for tick in range(4):
        one.open(tick, ALL, (), START_NS + tick * 25 * MS)
    run = setup()
    one.answer(plan(run, 2, 1), 3, START_NS + 80 * MS)  # late
    one.answer(plan(run, 3, 3), 3, START_NS + 85 * MS)
    one.open(4, ALL, (4,), START_NS + 100 * MS)

    def silent(after_ns: int) -> set[int]:
        return set(one.silent({*ALL}, set(), START_NS + S + after_ns))

    assert [silent(ns) for ns in (-1, 0, 80 * MS - 1)] == [set(), {1}, {1}]
    assert [silent(ns) for ns in (80 * MS, 100 * MS - 1, 100 * MS)] == [{1, 2}, {1, 2}, {*ALL}]
    assert not one.plant_is_silent(START_NS + S + 3 * MS - 1)
    assert one.plant_is_silent(START_NS + S + 3 * MS)
    assert not clock(mode="lockstep").plant_is_silent(START_NS + 9 * S)


@pytest.mark.parametrize(("late_ms", "is_away"), [(200, False), (201, True)])
def test_an_absence_of_more_than_200_ms_is_excused_once_a_tick(
    late_ms: int, *, is_away: bool
) -> None:
    """From the planned awakening, or the last one if that was later: all timeouts begin anew."""
    one = clock()
    one.begin(START_NS)
    one.open(0, ALL, (), START_NS)
    one.excuse_absence(0, START_NS, START_NS + 150 * MS)  # called, but not away
    now_ns = START_NS + (150 + late_ms) * MS
    one.excuse_absence(0, START_NS + 50 * MS, now_ns)
    assert (one.expires_ns == now_ns + S) is is_away
    assert (one.expires_ns == START_NS + S) is not is_away
    assert set(one.silent({*ALL}, set(), START_NS + S)) == (set() if is_away else {*ALL})
    assert one.plant_is_silent(now_ns + S - 1) is not is_away
    one.excuse_absence(0, now_ns, now_ns + S)
    assert (one.expires_ns == now_ns + 2 * S) is not is_away


def test_missed_deadlines_end_a_run_beyond_what_is_allowed() -> None:
    """Their number, of all agents, or how late a tick or a plan was."""
    counted = clock(on_overrun="abort", overrun_limit=3)
    counted.begin(START_NS)
    assert counted.judge_overruns(0, {1, 2, 3}, START_NS) == ""
    reason = counted.judge_overruns(1, {4}, START_NS)
    assert (
        reason == "agent4 missed the deadline of tick 1 at t = 0.10 s: 4 missed in total, 3 allowed"
    )
    run = setup()
    for plan_late_ms, tick_late_ms, expected in (
        (12, 10, "a plan before tick 5 was 0.012 s late, 0.01 s allowed"),
        (3, 11, "tick 5 was 0.011 s late, 0.01 s allowed"),
        (10, 10, ""),
    ):
        one = clock(on_overrun="abort", overrun_limit=3, overrun_limit_s=0.01)
        one.begin(0)
        one.open(4, ALL, (), 100 * MS)
        one.answer(plan(run, 2, 3), 4, (100 + plan_late_ms) * MS)
        one.answer(plan(run, 3, 4), 4, 101 * MS)
        assert one.judge_overruns(4, set(), (125 + tick_late_ms) * MS) == expected
        assert one.lateness_ns(4, 105 * MS) == (5 * MS, plan_late_ms * MS)
