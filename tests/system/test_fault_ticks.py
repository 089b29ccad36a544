"""Scripted faults of a lockstep run are due by ticks: the pace of the run and frozen processes change nothing."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.support.commands import SHORT, Forked, processes_of, settings
from transport.flight.memory import simulate
from transport.log.run_log import read_log
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, Plan, PlantState, Roster

CONTINUE = "clock.on_agent_loss=continue"
# One agent is killed and restarted, another is stopped and continued a tick later.
EVENTS = (
    "{at_s=0.4,target='agent3',do='kill'},{at_s=0.8,target='agent3',do='restart'},"
    "{at_s=0.5,target='agent2',do='stop'},{at_s=0.55,target='agent2',do='continue'}"
)
# The barrier timeout decides nothing but how long the tests take: an agent is stopped in each run.
BARRIER = "clock.barrier_timeout_s=2.0"
FROZEN_COORDINATOR = (
    ",{at_s=0.3,target='coordinator',do='stop'},{at_s=1.2,target='coordinator',do='continue'}"
)
FROZEN_PLANT = ",{at_s=0.3,target='plant',do='stop'},{at_s=1.2,target='plant',do='continue'}"


class Course(NamedTuple):
    """What a run must repeat bit for bit.

    Attributes:
        rosters: Tick, agents and their incarnations, of each version.
        states: Bytes of the plant states, in order.
        plans: Bytes of the inputs of each plan that was used, by tick and agent.
    """

    rosters: list[tuple[int, tuple[int, ...], tuple[int, ...]]]
    states: list[bytes]
    plans: dict[tuple[int, int], bytes]


def course_of(messages: list[Message]) -> Course:
    """Return the course of a run from its messages."""
    rosters = [message for message in messages if isinstance(message, Roster)]
    states = [message for message in messages if isinstance(message, PlantState)]
    plans = [message for message in messages if isinstance(message, Plan)]
    # A continued agent may still send its plan of the tick at which it was stopped; no process uses it.
    stopped = {(round(0.5 / 0.05), 2)}
    return Course(
        [(roster.tick, roster.agents, roster.incarnations) for roster in rosters],
        [state.x.tobytes() for state in sorted(states, key=lambda state: state.tick)],
        {
            (plan.tick, plan.agent): plan.inputs.tobytes()
            for plan in plans
            if (plan.tick, plan.agent) not in stopped
        },
    )


def in_memory(*changes: str) -> Course:
    """Return the course of the run without processes."""
    path = find_scenario("resilient")
    run = Setup.of(read_scenario(path, changes), path.name)
    messages: list[Message] = []
    assert simulate(run, messages.append).outcome == "completed"
    return course_of(messages)


def with_processes(forked: Callable[..., Forked], folder: Path, *changes: str) -> Course:
    """Return the course of the run with processes, which must be completed."""
    options = ["--out", "run", "--no-figures"]
    code, printed = forked("run", "resilient", *settings(*changes), *options, cwd=folder).end()
    assert code == 0, printed
    assert processes_of("run") == {}
    log = read_log(folder / "run" / "run.mcap")
    return course_of([entry.message for entry in log.messages])


@pytest.fixture(scope="module")
def expected() -> Course:
    """Return the course of the run in memory."""
    return in_memory(SHORT, CONTINUE, f"faults.event=[{EVENTS}]")


@pytest.mark.slow
def test_a_host_slower_than_the_pace_changes_nothing(
    expected: Course, forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """Kill, restart, stop and continue act at their ticks with the same bits: a wall clock is ahead of the ticks."""
    pace = (BARRIER, "clock.speed=1000")
    course = with_processes(forked, tmp_path, SHORT, CONTINUE, *pace, f"faults.event=[{EVENTS}]")
    assert course == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frozen", "speed"),
    [(FROZEN_COORDINATOR, 0), (FROZEN_PLANT, 1)],
    ids=["coordinator", "plant"],
)
def test_no_fault_acts_while_no_tick_opens(
    frozen: str, speed: float, expected: Course, forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """While coordinator or plant is stopped for 0.9 s no other fault acts.

    Both are continued after that time at the pace of the run, and the run has the bits of one in
    which they were not stopped: without a pace, and in real time.
    """
    events = f"faults.event=[{EVENTS}{frozen}]"
    assert in_memory(SHORT, CONTINUE, events) == expected
    course = with_processes(
        forked, tmp_path, SHORT, CONTINUE, BARRIER, f"clock.speed={speed}", events
    )
    assert course == expected


@pytest.mark.slow
def test_a_stop_longer_than_a_connection_lasts(
    forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """An agent stopped for 12 s of wall time loses its connections after 10 s, and returns at its tick."""
    hover = "maneuver.phase=[{name='hover',duration_s=4.0,displacement_m=[0,0,0]}]"
    events = "faults.event=[{at_s=0.5,target='agent2',do='stop'},{at_s=3.5,target='agent2',do='continue'}]"
    # The default timeout of the barrier: on a busy host an agent needs seconds for new connections.
    changes = (hover, CONTINUE, events)
    assert with_processes(forked, tmp_path, *changes, "clock.speed=0.25") == in_memory(*changes)
