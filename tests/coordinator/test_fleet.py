"""Vehicles before the first tick: what keeps the team on the ground, and a coordinator that takes over."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support.runs import plan, plant_state
from transport.coordinator.fleet import Fleet
from transport.coordinator.node import CoordinatorNode
from transport.coordinator.state_machine import State
from transport.flight.roles import coordinator_of
from transport.model.arrays import Array
from transport.protocol.admission.told_changes import ToldChanges
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import (
    Message,
    Presence,
    Request,
    Roster,
    Schedule,
    Target,
    Tick,
    VehicleStatus,
)
from transport.protocol.wire.outbox import Outbox

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "flight.toml"
MS, S = 10**6, 10**9
WALL_NS = 1_700_000_000 * S
NOW_NS = 50 * S
NAMES = (
    *("plant", "agent1", "agent2", "agent3", "agent4"),
    *("vehicle1", "vehicle2", "vehicle3", "vehicle4"),
)


# No plan and no state of the plant comes here.
PATIENT = "clock.barrier_timeout_s=1000.0"


@pytest.fixture(scope="module")
def run() -> Setup:
    """The ready scenario."""
    return Setup.of(read_scenario(SCENARIO, (PATIENT,)), str(SCENARIO))


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
    battery: float = 0.9,
    told: Sequence[Target] = (),
    mode: str = "GUIDED",
    armed: bool = True,
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
        armed=armed,
        mode=mode,
        battery=battery,
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
        targets=len(told),
        changes=tuple(encode(target) for target in told),
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
        ({"moved_m": -0.7}, "UAV2 and UAV3: expected 1.10 m .*, got 0.40 m"),
        ({"moved_m": 0.7}, "UAV2 and UAV3: expected 1.10 m .*, got 1.80 m"),
        ({"phase": "checking"}, "vehicle2 is checking: battery"),
    ],
)
def test_what_is_refused(run: Setup, of_two: dict[str, float], text: str) -> None:
    """A clock that is off or cannot be known well enough, a place that does not fit, a vehicle not ready."""
    assert re.search(text, problem(run, **of_two)), problem(run, **of_two)


@pytest.mark.parametrize(
    ("moved_m", "text"), [(0.95, ""), (-0.95, ""), (1.05, "UAV1: expected within 1 m")]
)
def test_a_team_that_is_elsewhere_may_not_start(run: Setup, moved_m: float, text: str) -> None:
    """A team as a whole may be twice as far off as the distance of two of its UAVs, 0.5 m."""
    fleet = fleet_of(run)
    for uav in (1, 2, 3, 4):
        fleet.take(status(run, uav, moved_m=moved_m), NOW_NS + 2 * MS)
    assert fleet.problem().startswith(text)
    assert bool(fleet.problem()) == bool(text)


def test_the_clock_is_known_by_the_exchange_that_took_least_time(run: Setup) -> None:
    """A slower one after it changes nothing, nor does a word that answers none."""
    fleet = fleet_of(run)
    for uav in (1, 2, 3, 4):
        fleet.take(status(run, uav), NOW_NS + 2 * MS)
    fleet.take(status(run, 2, way_ms=30.0), NOW_NS + 60 * MS)
    assert fleet.problem() == ""
    fleet = fleet_of(run)
    for uav in (1, 2, 3, 4):
        word = status(run, uav)
        fleet.take(msgspec.structs.replace(word, heard_ns=0), NOW_NS + 2 * MS)
    assert "vehicle1: clock: " in fleet.problem()


def test_words_are_told_five_times_a_second_for_as_long_as_vehicles_may_take(run: Setup) -> None:
    """Each has the instant of tick 0 once it is decided, which stays; the time counts from the first word on."""
    fleet = fleet_of(run)
    ready_ns = round(run.scenario.vehicles.ready_s * S)
    assert not fleet.is_over(NOW_NS + 10 * ready_ns)
    said = [fleet.speak(NOW_NS + ms * MS) for ms in (0, 199, 200)]
    assert [one is not None for one in said] == [True, False, True]
    assert said[0] is not None
    assert (said[0].sent_ns, said[0].start_ns) == (NOW_NS + WALL_NS, 0)
    assert [fleet.is_over(NOW_NS + ready_ns + one) for one in (0, 1)] == [False, True]

    for uav in (1, 2, 3, 4):
        fleet.take(status(run, uav, roster=uav, start_ns=uav), NOW_NS + 2 * MS)
    assert (fleet.roster, fleet.followed_ns) == (4, 4)
    starts = []
    for ms in (400, 600):
        one = fleet.speak(NOW_NS + ms * MS)
        assert one is not None
        starts.append(one.start_ns)
    assert starts == [NOW_NS + WALL_NS + 1400 * MS] * 2
    assert not fleet.is_over(NOW_NS + 2 * ready_ns)


@pytest.mark.parametrize(("after_s", "learns"), [(4.99, True), (5.0, False)])
def test_a_coordinator_that_returns_learns_for_five_seconds(
    run: Setup, after_s: float, learns: bool
) -> None:
    """Changes that a vehicle knows of are waited for, from the first word on."""
    fleet = fleet_of(run)
    fleet.speak(NOW_NS)
    assert not fleet.learns(NOW_NS + MS)
    word = msgspec.structs.replace(status(run, 1), targets=1)
    fleet.take(word, NOW_NS + round(after_s * S))
    assert fleet.learns(NOW_NS + round(after_s * S)) is learns


def test_a_missing_word_is_named(run: Setup) -> None:
    """Before its first word a vehicle is missing."""
    assert fleet_of(run).problem() == "vehicle1: no word from it"


def ready(node: CoordinatorNode) -> list[Message]:
    """Let all processes be ready."""
    said: list[Message] = []
    for name in NAMES:  # outside nothing waits for a plant
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


def test_it_learns_the_targets_of_an_earlier_coordinator(low_run: Setup) -> None:
    """It takes over once it knows all that the vehicles know, repeats it, and goes on with the next number."""
    first = flying(low_run)
    told = asked(first, "target", points_m=[[0.5, 0.0, -1.3]])[1][0]
    assert isinstance(told, Target)

    node = coordinator_of(low_run, 1, wall_offset_ns=WALL_NS)
    ready(node)
    start_ns = NOW_NS + WALL_NS - 8 * S
    for uav in (1, 2, 3, 4):
        knows = status(low_run, uav, phase="flying", tick=159, start_ns=start_ns, told=[told])
        node.receive(msgspec.structs.replace(knows, changes=()), NOW_NS + 2 * MS)
    at_ns = node.wake_ns
    assert at_ns is not None
    (word,) = node.poll(at_ns)
    assert isinstance(word, Schedule)
    assert word.targets == 0  # so that they tell
    assert node.state is State.PREPARING
    knows = status(low_run, 3, phase="flying", tick=160, start_ns=start_ns, told=[told], sequence=1)
    node.receive(knows, at_ns + MS)
    assert node.wake_ns is not None
    said = node.poll(node.wake_ns)
    repeated = next(message for message in said if isinstance(message, Target))
    assert (repeated.number, repeated.points.tolist()) == (1, told.points.tolist())
    landing = asked(node, "target", land=True)[1][0]
    assert isinstance(landing, Target)
    assert landing.number == 2
    assert landing.points[0, 0] == pytest.approx(0.5)  # below the first target


def flying(run: Setup) -> CoordinatorNode:
    """A coordinator whose team flies at tick 0."""
    node = coordinator_of(run, wall_offset_ns=WALL_NS)
    ready(node)
    for uav in (1, 2, 3, 4):
        node.receive(status(run, uav), NOW_NS + 2 * MS)
    at_ns = node.wake_ns
    assert at_ns is not None
    node.poll(at_ns)
    node.poll(at_ns + S)
    assert (node.state, node.tick) == (State.OPEN, 0)
    return node


def asked(
    node: CoordinatorNode, what: str, **given: Any
) -> tuple[Mapping[str, Any], list[Message]]:
    """The answer to a request in flight, and what is sent because of it."""
    replies: list[Mapping[str, Any]] = []
    sent = list(node.receive(Request(what, given, replies.append), NOW_NS + 2 * S))
    (reply,) = replies
    return reply, sent


def until(node: CoordinatorNode, tick: int) -> None:
    """Let ticks open."""
    while node.tick < tick:
        assert node.wake_ns is not None
        node.poll(node.wake_ns)


@pytest.fixture(scope="module")
def low_run() -> Setup:
    """The ready team, 1 m above the ground for half a minute."""
    settings = (
        "maneuver.start_m=[0,0,-1.3]",
        "maneuver.phase=[{name='hover',duration_s=30,displacement_m=[0,0,0]}]",
        "clock.on_agent_loss=continue",
        PATIENT,
    )
    return Setup.of(read_scenario(SCENARIO, settings), str(SCENARIO))


def test_a_team_that_has_landed_is_released(low_run: Setup) -> None:
    """The run ends with the release, not before the team is at rest on the ground."""
    node = flying(low_run)
    assert "expected a team that has landed" in asked(node, "release")[0]["error"]
    reply, _ = asked(node, "target", land=True)
    assert "expected a team at rest" in asked(node, "release")[0]["error"]
    until(node, round((reply["ends_s"] + 2.0) / 0.05))
    _, sent = asked(node, "release")
    assert sent == [node.finished]
    assert node.finished is not None
    assert (node.finished.outcome, node.finished.exit_code) == ("completed", 0)


def test_an_abort_is_the_fastest_landing(low_run: Setup) -> None:
    """It is on the ground before `transport land` would be, and the run is aborted, not completed."""
    slow = asked(flying(low_run), "target", land=True)[0]
    node = flying(low_run)
    fast, (target, *_) = asked(node, "abort")
    assert isinstance(target, Target)
    assert target.lands
    assert fast["point_m"] == slow["point_m"]
    assert fast["ends_s"] < slow["ends_s"]
    until(node, round((fast["ends_s"] + 2.0) / 0.05))
    asked(node, "release")
    assert node.finished is not None
    assert (node.finished.outcome, node.finished.exit_code) == ("aborted", 130)
    assert node.finished.reason == "aborted by a person at t = 0.05 s"


@pytest.mark.parametrize("is_back", [False, True])
def test_no_scripted_target_follows_a_landing(*, is_back: bool) -> None:
    """It would lead a team up again that a person has landed, also one of a coordinator that has returned."""
    settings = (
        "maneuver.start_m=[0,0,-1.3]",
        "maneuver.phase=[{name='hover',duration_s=30,displacement_m=[0,0,0]}]",
        "maneuver.target=[{at_s=10.0,points_m=[[0.5,0.0,-1.3]]}]",
        PATIENT,
    )
    scripted = Setup.of(read_scenario(SCENARIO, settings), str(SCENARIO))
    node = flying(scripted)
    landing = asked(node, "target", land=True)[1][0]
    assert isinstance(landing, Target)
    if is_back:
        node = coordinator_of(scripted, 1, wall_offset_ns=WALL_NS)
        ready(node)
        start_ns = NOW_NS + WALL_NS - 8 * S
        knows = status(scripted, 3, phase="flying", tick=159, start_ns=start_ns, told=[landing])
        node.receive(knows, NOW_NS + 2 * MS)
    said: list[Message] = []
    while node.tick < 250:
        assert node.wake_ns is not None
        said += node.poll(node.wake_ns)
    assert {told.number for told in said if isinstance(told, Target)} <= {landing.number}
    asked(node, "release")
    assert node.finished is not None
    assert node.finished.outcome == "completed"


def test_a_low_battery_lands_the_team_once(low_run: Setup) -> None:
    """One UAV below `vehicles.battery_land` brings all down, by one message; a fuller one nothing."""
    node = flying(low_run)
    at_ns = NOW_NS + 1200 * MS
    assert not node.receive(status(low_run, 1, phase="flying", battery=0.2), at_ns)
    said = node.receive(status(low_run, 2, phase="flying", battery=0.1), at_ns)
    landing = [target for target in said if isinstance(target, Target)]
    assert [(target.lands, target.tick) for target in landing] == [(True, node.tick + 1)]
    reasons = [roster.reason for roster in said if isinstance(roster, Roster)]
    assert "battery of UAV2 at 10%: the team lands" in reasons
    assert not node.receive(status(low_run, 3, phase="flying", battery=0.1), at_ns)


def test_a_pilot_who_takes_over_is_told(low_run: Setup) -> None:
    """A UAV that leaves the mode of setpoints or is disarmed is named once, and when it is back."""
    node = flying(low_run)
    told: list[str] = []
    changes: list[dict[str, Any]] = [{}, {"mode": "STABILIZE"}, {"mode": "STABILIZE"}, {}]
    for change in [*changes, {"armed": False}]:
        word = status(low_run, 3, phase="flying", **change)
        said = node.receive(word, NOW_NS + 1200 * MS)
        told += [message.reason for message in said if isinstance(message, Roster)]
    assert told == [
        "UAV3: mode STABILIZE, not GUIDED: its setpoints have no effect",
        "UAV3: back in mode GUIDED",
        "UAV3: disarmed in flight",
    ]


def test_without_any_agent_the_vehicles_can_be_landed(low_run: Setup) -> None:
    """The run goes on, as each UAV has its own law, which follows the landing as well."""
    node = flying(low_run)
    for name in ("agent1", "agent2", "agent3", "agent4"):
        node.receive(Presence(name, 0, alive=False), NOW_NS + 1200 * MS)
    assert node.state is State.OPEN
    until(node, 5)
    assert asked(node, "target", land=True)[0]["point_m"][2] == pytest.approx(-0.275)


def test_silent_agents_leave_their_vehicles_to_fly_on() -> None:
    """All of them at once are lost one by one in a team of vehicles, and end no run."""
    settings = (
        "plant.kind=vehicles",
        "clock.on_agent_loss=continue",
        "clock.barrier_timeout_s=1.0",
    )
    silent = Setup.of(read_scenario(SCENARIO, settings), str(SCENARIO))
    node = flying(silent)
    said: list[Message] = []
    while node.tick < 30:
        assert node.wake_ns is not None
        said += node.poll(node.wake_ns)
    rosters = [one for one in said if isinstance(one, Roster)]
    assert [one.agents for one in rosters] == [()]
    assert "agent1, agent2, agent3, agent4 did not answer tick" in rosters[0].reason
    assert node.state is State.OPEN


def test_a_recorder_that_returns_is_told_what_it_missed(low_run: Setup) -> None:
    """Targets and roster again, in a run whose vehicles go on without it."""
    node = coordinator_of(low_run, observers=["recorder"], wall_offset_ns=WALL_NS)
    node.receive(Presence("recorder", 0, alive=True), NOW_NS)
    ready(node)
    for uav in (1, 2, 3, 4):
        node.receive(status(low_run, uav), NOW_NS + 2 * MS)
    until(node, 3)
    told = asked(node, "target", points_m=[[0.5, 0.0, -1.3]])[1][0]
    assert isinstance(told, Target)
    node.receive(Presence("recorder", 0, alive=False), NOW_NS + 1200 * MS)
    assert node.state is State.OPEN
    assert asked(node, "status")[0]["observers"] == []
    said = node.receive(Presence("recorder", 1, alive=True), NOW_NS + 1200 * MS)
    assert [type(message) for message in said[:2]] == [Target, Roster]
    assert asked(node, "status")[0]["observers"] == ["recorder"]


def test_a_landing_that_does_not_fit_is_told(run: Setup) -> None:
    """From 10 m the ready maneuver leaves no time at its end: the record has the reason."""
    node = flying(run)
    until(node, 460)
    assert node.wake_ns is not None
    said = node.receive(status(run, 2, phase="flying", battery=0.1), node.wake_ns - 1)
    assert [type(message) for message in said] == [Roster]
    assert isinstance(said[0], Roster)
    assert "landing refused: expected a target before the end of the run" in said[0].reason


@pytest.fixture(scope="module")
def outside() -> Setup:
    """The ready team 10 m up, outside of a simulation; its maneuver takes 5 s."""
    settings = (
        "plant.kind=vehicles",
        "maneuver.phase=[{name='hover',duration_s=5,displacement_m=[0,0,0]}]",
        PATIENT,
    )
    return Setup.of(read_scenario(SCENARIO, settings), str(SCENARIO))


def landings(messages: Sequence[Message]) -> list[Target]:
    """Targets that bring the team down."""
    return [message for message in messages if isinstance(message, Target) and message.lands]


def test_outside_a_maneuver_ends_with_a_landing(outside: Setup) -> None:
    """At its end 10 m up the team comes down by itself, and is released; no other target is after it."""
    node = flying(outside)
    said: list[Message] = []
    while node.tick < 100:
        assert node.wake_ns is not None
        said += node.poll(node.wake_ns)
    (landing,) = landings(said)
    assert landing.tick == 100  # 5 s
    assert landing.points[-1, 2] == pytest.approx(-0.275)  # the height at which the load rests
    assert node.finished is None
    refused = asked(node, "target", points_m=[[0.5, 0.0, -9.0]])[0]["error"]
    assert "before the end of the maneuver at t = 4.95 s" in refused
    until(node, landing.tick + round((landing.approach_s + landing.way_s + 2.0) / 0.05) + 1)
    asked(node, "release")
    assert node.finished is not None
    assert node.finished.outcome == "completed"


@pytest.mark.parametrize("tick", [0, 90, 99, 130])
def test_outside_an_abort_always_has_time(outside: Setup, tick: int) -> None:
    """In the maneuver, at its last ticks, and while the team comes down already."""
    node = flying(outside)
    until(node, tick)
    assert "error" not in asked(node, "abort")[0]


def test_outside_a_signal_lands_the_team(outside: Setup) -> None:
    """The first one in the air is an abort, after which the run goes on; the second one ends it."""
    node = flying(outside)
    said = node.interrupt("interrupted (SIGTERM)")
    assert len(landings(said)) == 1
    assert node.finished is None
    until(node, 5)
    (end,) = node.interrupt("interrupted (SIGTERM)")
    assert node.finished is end
    assert (node.finished.outcome, node.finished.exit_code) == ("aborted", 130)


def test_in_a_simulation_a_signal_ends_the_run(low_run: Setup) -> None:
    """Nothing falls: the run ends at once."""
    node = flying(low_run)
    (end,) = node.interrupt("interrupted (SIGINT)")
    assert node.finished is end


def test_an_abort_before_the_first_tick_ends_the_run(outside: Setup) -> None:
    """Each autopilot hovers by itself, and keeps its UAV; a team in flight without a coordinator flies on."""
    node = coordinator_of(outside, wall_offset_ns=WALL_NS)
    ready(node)
    reply, _ = asked(node, "abort")
    assert reply["tick"] == -1
    assert node.finished is not None
    assert node.finished.outcome == "aborted"

    back = coordinator_of(outside, 1, wall_offset_ns=WALL_NS)
    ready(back)
    start_ns = NOW_NS + WALL_NS - 2 * S
    back.receive(status(outside, 1, phase="flying", start_ns=start_ns), NOW_NS + 2 * MS)
    if back.state is not State.OPEN:
        assert back.interrupt("interrupted (SIGTERM)") == ()
    assert back.finished is None

    waits = coordinator_of(outside, 1, wall_offset_ns=WALL_NS)  # for a process that is not there
    waits.receive(status(outside, 1, phase="flying", start_ns=start_ns), NOW_NS + 2 * MS)
    assert waits.interrupt("interrupted (SIGTERM)") == ()
    assert waits.finished is None


@pytest.mark.parametrize("gone", ["agent2", "vehicle3"])
def test_a_loss_before_it_takes_over_ends_nothing(low_run: Setup, gone: str) -> None:
    """The end of a run would leave each UAV in the air to its autopilot, on its rod."""
    first = flying(low_run)
    told = asked(first, "target", points_m=[[0.5, 0.0, -1.3]])[1][0]
    assert isinstance(told, Target)
    back = coordinator_of(low_run, 1, wall_offset_ns=WALL_NS)
    ready(back)
    start_ns = NOW_NS + WALL_NS - 2 * S
    knows = status(low_run, 1, phase="flying", start_ns=start_ns, told=[told])
    back.receive(msgspec.structs.replace(knows, changes=()), NOW_NS + 2 * MS)
    assert back.state is State.PREPARING
    assert "has just returned: ask again" in asked(back, "target", land=True)[0]["error"]
    assert back.receive(Presence(gone, 0, alive=False), NOW_NS + 3 * MS) == ()
    knows = status(low_run, 3, phase="flying", start_ns=start_ns, told=[told], sequence=1)
    back.receive(knows, NOW_NS + 4 * MS)
    assert back.wake_ns is not None
    back.poll(back.wake_ns)
    assert back.finished is None
    assert back.tick > 0


def test_a_loss_between_the_word_and_tick_0_ends_the_run(run: Setup) -> None:
    """Also where vehicles have said already that they follow that word; a state of a plant changes nothing."""
    node = coordinator_of(run, wall_offset_ns=WALL_NS)
    ready(node)
    for uav in (1, 2, 3, 4):
        node.receive(status(run, uav), NOW_NS + 2 * MS)
    assert node.wake_ns is not None
    word = node.poll(node.wake_ns)[-1]
    assert isinstance(word, Schedule)
    node.receive(status(run, 1, start_ns=word.start_ns, sequence=1), NOW_NS + 210 * MS)
    assert node.receive(plant_state(run, 0, "UAV1 roll of 90 deg"), NOW_NS + 220 * MS) == ()
    assert node.state is State.STARTING
    node.receive(Presence("agent2", 0, alive=False), NOW_NS + 230 * MS)
    assert node.finished is not None
    assert (node.finished.exit_code, node.finished.tick) == (4, 0)


def test_a_plan_may_be_here_before_its_tick(outside: Setup) -> None:
    """Agents of vehicles have clocks of their own: it is an answer once the tick is open."""
    node = flying(outside)
    node.receive(plan(outside, 2, 1, delay=1), NOW_NS + 1200 * MS)
    said: list[Message] = []
    while node.tick < 2:
        assert node.wake_ns is not None
        said += node.poll(node.wake_ns)
    assert [one.answered for one in said if isinstance(one, Tick)] == [(), (2,)]


def test_vehicles_that_are_never_ready_end_the_run(run: Setup) -> None:
    """After `vehicles.ready_s` the run ends, and says what is missing."""
    node = coordinator_of(run, wall_offset_ns=WALL_NS)
    ready(node)
    (end,) = node.poll(NOW_NS + 181 * S)
    assert node.finished is end
    assert node.finished.reason == "the vehicles are not ready: vehicle1: no word from it"


def test_a_vehicle_that_is_gone_ends_the_run_before_its_first_tick_alone(run: Setup) -> None:
    """In flight the others and its own autopilot go on: the record has the reason, and its return."""
    preparing = coordinator_of(run, wall_offset_ns=WALL_NS)
    ready(preparing)
    preparing.receive(Presence("vehicle2", 0, alive=False), NOW_NS)
    assert preparing.finished is not None
    assert preparing.finished.exit_code == 4
    assert preparing.finished.reason == "vehicle2 is gone at t = 0.00 s"

    node = flying(run)
    gone = node.receive(Presence("vehicle2", 0, alive=False), NOW_NS + 2 * S)
    assert [told.reason for told in gone if isinstance(told, Roster)] == [
        "vehicle2 is gone at t = 0.00 s"
    ]
    back = node.receive(Presence("vehicle2", 1, alive=True), NOW_NS + 3 * S)
    assert [type(told) for told in back] == [Roster, Schedule]
    assert not node.receive(Presence("vehicle2", 0, alive=False), NOW_NS + 3 * S)
    assert node.finished is None
