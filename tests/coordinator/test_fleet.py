"""Vehicles before the first tick: what keeps the team on the ground, and a coordinator that takes over."""

import re
from pathlib import Path

import numpy as np
import pytest

from transport.coordinator.fleet import Fleet
from transport.coordinator.node import CoordinatorNode
from transport.coordinator.state_machine import State
from transport.flight.roles import coordinator_of
from transport.model.arrays import Array
from transport.protocol.admission.told_changes import ToldChanges
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import (
    Message,
    Presence,
    Roster,
    Schedule,
    Tick,
    VehicleStatus,
)
from transport.protocol.wire.node_interface import Outbox

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "flight.toml"
MS, S = 10**6, 10**9
WALL_NS = 1_700_000_000 * S
NOW_NS = 50 * S
NAMES = (
    *("plant", "agent1", "agent2", "agent3", "agent4"),
    *("vehicle1", "vehicle2", "vehicle3", "vehicle4"),
)


@pytest.fixture(scope="module")
def run() -> Setup:
    """The ready scenario."""
    return Setup.of(read_scenario(SCENARIO), str(SCENARIO))


def places(run: Setup) -> Array:
    """Positions of the UAVs at the start, (4, 3)."""
    sensed = run.model.sensed(run.initial_state(), run.hover.u)
    return np.asarray(sensed.reshape(-1, 15)[:, :3])


def status(
    run: Setup,
    uav: int,
    *,
    phase: str = "ready",
    off_ms: float = 0.0,
    way_ms: float = 1.0,
    moved_m: float = 0.0,
    start_ns: int = 0,
    sequence: int = 0,
    tick: int = 0,
    heard_ns: int = NOW_NS,
    roster: int = 0,
) -> VehicleStatus:
    """A vehicle's word, which arrives at `heard_ns` + 2 `way_ms`, of a clock that is off."""
    off_ns = round(off_ms * MS)
    arrived_ns = heard_ns + WALL_NS + round(way_ms * MS)
    return VehicleStatus(
        sender=f"vehicle{uav}",
        incarnation=0,
        sequence=sequence,
        tick=tick,
        uav=uav,
        phase=phase,
        problem="battery" if phase == "checking" else "",
        armed=True,
        mode="GUIDED",
        battery=0.9,
        healthy=True,
        position=places(run)[uav - 1] + [moved_m, 0.0, 0.0],
        age_s=0.0,
        plan_tick=-1,
        latency_s=-1.0,
        late_s=0.0,
        roster=roster,
        heard_ns=heard_ns + WALL_NS,
        heard_at_ns=arrived_ns + off_ns,
        sent_ns=arrived_ns + off_ns,
        start_ns=start_ns,
    )


def fleet_of(run: Setup) -> Fleet:
    """The vehicles as a coordinator knows them that has just begun."""
    out = Outbox("coordinator", 0)
    return Fleet(run.scenario.vehicles, places(run), out, WALL_NS, ToldChanges())


def problem(run: Setup, **of_two: float | str) -> str:
    """What keeps a team from its first tick whose second vehicle differs."""
    fleet = fleet_of(run)
    for uav in (1, 2, 3, 4):
        told = status(run, uav, **(of_two if uav == 2 else {}))  # type: ignore[arg-type]
        way_ms = float(of_two.get("way_ms", 1.0)) if uav == 2 else 1.0
        fleet.take(told, NOW_NS + round(2.0 * way_ms * MS))
    return fleet.problem()


def test_a_team_that_fits_may_start(run: Setup) -> None:
    """All ready, in their places, with one time: nothing is missing."""
    assert problem(run) == ""
    assert problem(run, off_ms=5.0, moved_m=0.3) == ""


@pytest.mark.parametrize(
    ("of_two", "text"),
    [
        ({"off_ms": 50.0}, "vehicle2: clock: expected at most 10 ms.*got [+]50.0 ms [+]- 1.0 ms"),
        ({"off_ms": -50.0}, "got -50.0 ms"),
        ({"way_ms": 30.0}, "got [+-]0.0 ms [+]- 30.0 ms"),
        ({"moved_m": 2.0}, "UAV1 and UAV2: expected 1.10 m .*, got "),
        ({"phase": "checking"}, "vehicle2 is checking: battery"),
    ],
)
def test_what_is_refused(run: Setup, of_two: dict[str, float], text: str) -> None:
    """A clock that is off or cannot be known well enough, a place that does not fit, a vehicle not ready."""
    assert re.search(text, problem(run, **of_two)), problem(run, **of_two)


def test_a_missing_word_is_named(run: Setup) -> None:
    """Before its first word a vehicle is missing."""
    assert fleet_of(run).problem() == "vehicle1: no word from it"


def ready(node: CoordinatorNode) -> list[Message]:
    """Let all processes be ready."""
    said: list[Message] = []
    for name in NAMES:
        said += node.receive(Presence(name, 0, alive=True), NOW_NS)
    return said


def test_the_first_tick_is_told_a_second_ahead(run: Setup) -> None:
    """Words to the vehicles, then the roster and the instant of tick 0, and the tick at that instant."""
    node = coordinator_of(run, wall_offset_ns=WALL_NS)
    said = ready(node)
    assert [type(message) for message in said] == [Schedule]
    assert node.state is State.PREPARING
    for uav in (1, 2, 3, 4):
        node.receive(status(run, uav), NOW_NS + 2 * MS)
    at_ns = node.wake_ns
    assert at_ns is not None
    roster, word = node.poll(at_ns)
    assert isinstance(roster, Roster)
    assert isinstance(word, Schedule)
    assert word.start_ns == at_ns + WALL_NS + S
    assert node.wake_ns == at_ns + S
    opened = node.poll(at_ns + S)
    assert [(type(message), message.tick) for message in opened] == [(Tick, 0)]


def test_a_coordinator_that_returns_takes_over(run: Setup) -> None:
    """From what the vehicles follow it takes the instants of the ticks, and a roster newer than theirs."""
    node = coordinator_of(run, 1, wall_offset_ns=WALL_NS)
    start_ns = NOW_NS + WALL_NS - 8 * S
    ready(node)
    for uav in (1, 2, 3, 4):
        told = status(run, uav, phase="flying", tick=159, start_ns=start_ns, roster=7)
        node.receive(told, NOW_NS + 2 * MS)
    at_ns = node.wake_ns
    assert at_ns is not None
    said = node.poll(at_ns)
    roster = next(message for message in said if isinstance(message, Roster))
    opened = next(message for message in said if isinstance(message, Tick))
    assert (roster.version, roster.agents) == (8, (1, 2, 3, 4))
    assert opened.tick == (at_ns + WALL_NS - start_ns) // (50 * MS)
    assert node.state is State.OPEN
    # The next tick is due at its instant of the same clock.
    assert node.wake_ns == start_ns - WALL_NS + (opened.tick + 1) * 50 * MS


def test_vehicles_that_are_never_ready_end_the_run(run: Setup) -> None:
    """After `vehicles.ready_s` the run ends, and says what is missing."""
    node = coordinator_of(run, wall_offset_ns=WALL_NS)
    ready(node)
    (end,) = node.poll(NOW_NS + 181 * S)
    assert node.finished is end
    assert node.finished.reason == "the vehicles are not ready: vehicle1: no word from it"
