"""Runs in which agents share a plan only on a relevant change.

Receivers, and bitwise reproducibility.
"""

from collections.abc import Sequence

import pytest

from tests.support.runs import SHORT, ready, recorded, reproducible
from tests.support.shuffled import fly_shuffled
from transport.analysis.analysed_run import AnalysedRun, counted
from transport.analysis.replay.replay_of_agent import Replay
from transport.analysis.summary_assembly import summarise
from transport.flight import memory
from transport.log.run_log import Recorded, RunLog
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Message, Plan, StepReport, Tick

ON_CHANGE = (
    "controller.share=on_change",
    "controller.share_threshold=0.02",
    "controller.share_heartbeat_s=0.4",
)
BAD = ("links.delay_s=0.1", "links.jitter_s=0.05", "links.loss=0.3")
RETURN = (
    "clock.on_agent_loss=continue",
    "faults.event=[{at_s=0.4,do='kill',target='agent3'},{at_s=0.8,do='restart',target='agent3'}]",
)


def run_of(*changes: str) -> Setup:
    """Return a run of 1.5 s of the ready scenario with the shared control law."""
    return ready("resilient", SHORT, *ON_CHANGE, *changes)


def log_of(messages: Sequence[Message]) -> RunLog:
    """Return the log that the recorder would write."""
    return RunLog(
        header={},
        messages=tuple(Recorded(message=m, received_ns=i) for i, m in enumerate(messages)),
        cut="",
    )


def of(kind: type[Message], messages: Sequence[Message]) -> list[bytes]:
    """Return the messages of a kind by sender and sequence number, without wall-clock times."""
    found = sorted(
        (m for m in messages if isinstance(m, kind)), key=lambda m: (m.sender, m.sequence)
    )
    return [encode(reproducible(m)) for m in found]


def test_unshared_plans_reach_no_other_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    """An agent receives only the others' shared plans, plant and coordinator all.

    Ticks name the shared ones.
    """
    heard: dict[str, set[tuple[int, int, bool]]] = {}
    deliver = memory.InMemoryRun._deliver

    def noting(flight: memory.InMemoryRun, message: Message) -> None:
        if isinstance(message, Plan):
            for name in flight._receivers(message):
                heard.setdefault(name, set()).add((message.agent, message.tick, message.shared))
        deliver(flight, message)

    monkeypatch.setattr(memory.InMemoryRun, "_deliver", noting)
    messages = recorded(run_of())
    plans = {(m.agent, m.tick, m.shared) for m in messages if isinstance(m, Plan)}
    shared = {entry for entry in plans if entry[2]}
    assert 0 < len(shared) < len(plans) == 120
    assert heard["plant"] == heard["coordinator"] == plans
    for agent in (1, 2, 3, 4):
        assert heard[f"agent{agent}"] == {entry for entry in shared if entry[0] != agent}
    for tick in (m for m in messages if isinstance(m, Tick) and m.tick):
        assert tick.answered == (1, 2, 3, 4)
        assert tick.shared == tuple(sorted(agent for agent, k, _ in shared if k == tick.tick - 1))


@pytest.mark.parametrize("changes", [(), (*BAD, *RETURN)], ids=["perfect", "bad, with a return"])
def test_arrival_order_makes_no_difference(changes: tuple[str, ...]) -> None:
    """The order of arrival does not change a bit of the plans, the reports or the plant states."""
    run = run_of(*changes)
    straight = recorded(run)
    shuffled = recorded(run, lambda setup, record: fly_shuffled(setup, record, seed=7))
    for kind in (Plan, StepReport, Tick):
        assert of(kind, shuffled) == of(kind, straight), kind


def test_plans_grow_old_and_say_so() -> None:
    """Reports have the age of the newest plan received.

    On a perfect network the heartbeat bounds it.
    """
    messages = recorded(run_of("controller.share_threshold=1000.0"))
    reports = [m for m in messages if isinstance(m, StepReport)]
    assert max(age for report in reports for age in report.plan_ages) == 8
    assert [r.plan_ages for r in reports if r.tick == 5] == [(5, 5, 5)] * 4
    plans = [m for m in messages if isinstance(m, Plan)]
    assert {m.tick for m in plans if m.shared} == {0, 8, 16, 24}
    summary = summarise(AnalysedRun.of(run_of(), log_of(messages)))
    assert summary["messages"]["shared"] == 16
    assert summary["messages"]["planned"] == 120


def test_all_share_when_an_agent_goes_and_when_it_returns() -> None:
    """Under a new roster every agent shares its first plan.

    A returning agent knows the others one tick later.
    """
    run = run_of(*RETURN, "controller.share_threshold=1000.0", "controller.share_heartbeat_s=100.0")
    messages = recorded(run)
    shared = {(m.agent, m.tick) for m in messages if isinstance(m, Plan) and m.shared}
    assert shared == {
        *((agent, 0) for agent in (1, 2, 3, 4)),
        *(
            (agent, 9) for agent in (1, 2, 4)
        ),  # killed when tick 8 was opened: tick 9 names another roster
        *((agent, 16) for agent in (1, 2, 3, 4)),
        (3, 24),  # it has begun alone: less so by more than 0.2
    }
    back = [
        m for m in messages if isinstance(m, StepReport) and m.agent == 3 and m.incarnation == 1
    ]
    assert [report.plan_ages for report in back[:3]] == [(-1, -1, -1), (1, 1, 1), (2, 2, 2)]


def test_a_replay_hears_what_the_agent_heard() -> None:
    """An agent replayed from the log alone publishes bitwise the same messages."""
    run = run_of(*BAD)
    replay = Replay(run, counted(run, log_of(recorded(run))), 2)
    steps = list(replay.steps())
    assert len(steps) == 30
    assert replay.notes == []
    for step in steps:
        for now, then in zip(step.answers, step.recorded, strict=True):
            assert then is not None
            assert encode(reproducible(now)) == encode(reproducible(then))
