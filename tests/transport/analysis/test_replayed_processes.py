"""Processes of an agent in a log composed by hand: which there are, what each could receive, and in which order."""

from collections.abc import Sequence

import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.log_messages import radio_report
from tests.support.logs import log_of
from transport.analysis.replay.replayed_processes import in_order_of_need, processes_of
from transport.protocol.wire.messages import FaultNote, LinkChange, Measurement, Message, Roster

AGENT = 3
OTHERS = {1: 1, 2: 1, 4: 1}


def roster(k: int, version: int, incarnation: int | None) -> Roster:
    """Return the roster of tick k, with an incarnation of agent 3 or without the agent."""
    own = {} if incarnation is None else {AGENT: incarnation}
    return runs.roster({**OTHERS, **own}, k=k, version=version)


def note(what: str, k: int, target: str = "agent3") -> FaultNote:
    """Return the note of the recorder about a process."""
    return FaultNote(
        sender="recorder",
        incarnation=0,
        sequence=k,
        tick=k,
        target=target,
        what=what,
        origin="person",
    )


def change(k: int) -> LinkChange:
    """Return a change of all links at tick k."""
    return LinkChange(
        sender="coordinator",
        incarnation=0,
        sequence=k,
        tick=k,
        number=1,
        source="",
        target="",
        settings="{}",
    )


@pytest.mark.parametrize(
    ("incarnation", "notes", "starts"),
    [
        (1, [], [0]),  # never off
        (2, [note("stopped", 3), note("continued", 8)], [0]),
        (2, [note("killed", 3), note("restarted", 8)], [0, 8]),
        (2, [note("stopped", 3), note("continued", 8), note("killed", 8)], [0, 8]),
        (2, [note("continued", 3, target="agent1"), note("killed", 3)], [0, 8]),
        (2, [note("stopped", 0), note("continued", 8)], [0]),  # in the tick that admits it
        (2, [note("killed", 0)], [0, 8]),
        (3, [note("continued", 8)], [0, 8]),  # noticed at most one absence
        (2, [], [0]),  # an in-memory run without a fault of the agent
    ],
)
def test_a_process_that_rejoins_may_be_the_one_that_was_stopped(
    incarnation: int, notes: Sequence[FaultNote], starts: Sequence[int]
) -> None:
    """It has the next incarnation, and the last note about it says that it was continued."""
    run = runs.setup(runs.ticks(20))
    log = log_of([roster(0, 1, 1), roster(4, 2, None), *notes, roster(8, 3, incarnation)])
    processes = processes_of(run, log, AGENT)
    assert [process.ticks.start for process in processes] == list(starts)
    assert [process.ticks.stop for process in processes] == [*starts[1:], 20]


@pytest.mark.parametrize(
    ("fault_s", "starts"), [(0.0, [0]), (0.2, [0, 8]), (0.4, [0, 8]), (0.45, [0])]
)
def test_an_agent_that_rejoins_after_a_fault_in_memory_has_a_new_process(
    fault_s: float, starts: Sequence[int]
) -> None:
    """The fault is at a tick after its first one, up to that of its return."""
    events = f"faults.event=[{{at_s={fault_s},do='kill',target='agent3'}}]"
    run = runs.setup(runs.ticks(20), "clock.on_agent_loss='continue'", events)
    log = log_of([roster(0, 1, 1), roster(4, 2, None), roster(8, 3, 2)])
    assert [process.ticks.start for process in processes_of(run, log, AGENT)] == list(starts)


def test_each_process_receives_what_was_sent_while_it_was_there() -> None:
    """Shared plans of the others at its ticks, its rosters, and changes from the beginning to its end."""
    run = runs.setup(runs.ticks(20), "radio={}")
    sent: dict[str, Message] = {
        "first roster": roster(0, 1, 1),
        "plan": runs.plan(run, 1, 4),
        "own plan": runs.plan(run, AGENT, 4),
        "unshared plan": runs.plan(run, 1, 4, shared=False),
        "change": change(5),
        "airtime": radio_report(run, 5),
        "change at the restart": change(8),
        "second roster": roster(8, 2, 3),
        "plan at the restart": runs.plan(run, 1, 8),
        "change after the restart": change(9),
        "airtime after the restart": radio_report(run, 9),
        "third roster": roster(10, 3, 3),
    }
    log = log_of(list(sent.values()))
    names = {id(message): name for name, message in sent.items()}
    first, second = (
        [names[id(message)] for message in process.received(log)]
        for process in processes_of(run, log, AGENT)
    )
    common = ["change", "change at the restart"]
    assert first == ["first roster", "plan", common[0], "airtime", common[1]]
    assert second == [
        *common,
        "second roster",
        "plan at the restart",
        "change after the restart",
        "airtime after the restart",
        "third roster",
    ]


def test_messages_come_before_the_measurement_that_needs_them() -> None:
    """A plan of tick k before that of k + 1; a change with the next roster; a roster before a measurement names it."""
    run = runs.setup(runs.ticks(20), "radio={}")
    measurements: list[Measurement] = [
        runs.measurement(run, AGENT, 0),
        runs.measurement(run, AGENT, 1, version=2),
    ]
    first, later = roster(0, 1, 1), roster(1, 2, 1)
    plans = [runs.plan(run, 1, k) for k in range(3)]
    proposal = replace(runs.plan(run, 2, 1), negotiation=1)
    changed, air = change(0), radio_report(run, 1)
    exchanged, last = replace(air, negotiation=1), roster(2, 3, 1)
    received: list[Message] = [
        *(plans[2], plans[0], plans[1], proposal, first, changed, air, later),
        *(exchanged, last),
    ]
    found = in_order_of_need(received, measurements)
    expected: list[Message] = [
        *(first, measurements[0]),
        *(plans[0], changed, air, later, measurements[1]),
        # The step of tick 1 may end with them; that of tick 3 is beyond.
        *(plans[1], proposal, exchanged, last),
    ]
    assert [id(message) for message in found] == [id(message) for message in expected]


def test_measurements_of_a_process_are_in_the_order_of_their_ticks() -> None:
    """The recorder may receive them in another one; those of another agent are left out."""
    run = runs.setup(runs.ticks(20))
    sent = [runs.measurement(run, agent, k) for agent, k in ((AGENT, 2), (1, 1), (AGENT, 0))]
    log = log_of([roster(0, 1, 1), *sent])
    (process,) = processes_of(run, log, AGENT)
    assert [(one.agent, one.tick) for one in process.measurements(log)] == [(AGENT, 0), (AGENT, 2)]
