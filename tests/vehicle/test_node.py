"""The process of one UAV as a state machine, above an autopilot that records what it is told."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as changed

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import (
    Control,
    LinkChange,
    Measurement,
    Message,
    Plan,
    Presence,
    Roster,
    Schedule,
    Target,
    VehicleStatus,
)
from transport.vehicle.autopilot import AutopilotState, Finding
from transport.vehicle.law_by_autopilot_state import OwnLaw
from transport.vehicle.node import Conduct, VehicleNode
from transport.vehicle.plan_in_force import Plans, interpolated

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "flight.toml"
MS, S = 10**6, 10**9
WALL_NS = 1_700_000_000 * S  # of the steady clock's zero
START_NS = 100 * S
UAV = 2
T_S = 0.05


@lru_cache(maxsize=4)
def flight(*settings: str) -> Setup:
    """The ready scenario."""
    return Setup.of(read_scenario(SCENARIO, settings), str(SCENARIO))


class Recording:
    """An autopilot at the hover of the scenario, whose properties a test changes."""

    tells_thrust = True

    def __init__(self, setup: Setup) -> None:
        x = setup.initial_state()
        hover = setup.model.sensed(x, setup.hover.u).reshape(-1, 15)[UAV - 1]
        self.told: AutopilotState | None = AutopilotState(
            sensed=hover.copy(),
            position_ns=0,
            attitude_ns=0,
            position_s=0.0,
            armed=True,
            takes_setpoints=True,
            is_healthy=True,
            battery=0.9,
            thrust_N=float(setup.hover.u[4 * (UAV - 1)]),
            mode="GUIDED",
            says="",
        )
        self.now_ns = 0
        self.is_silent_since: int | None = None
        self.unmet: list[Finding] = []
        self.commands: list[tuple[int, float, Array, float]] = []
        self.asked: list[str] = []

    def state(self) -> AutopilotState | None:
        """What it has told, with the time of its last word."""
        if self.told is None:
            return None
        heard = self.now_ns if self.is_silent_since is None else self.is_silent_since
        at_s = heard / S  # its clock runs as that of the run, from another zero
        return replace(self.told, position_ns=heard, attitude_ns=heard, position_s=at_s)

    def silence(self) -> str:
        """What is told while it is silent."""
        return "no sign of life from the autopilot"

    def attend(self, now_ns: int) -> None:
        """Note the time."""
        self.now_ns = now_ns

    def findings(self) -> Sequence[Finding]:
        """The checks of the test."""
        return self.unmet

    def command(self, thrust_N: float, rates_rads: Array, since_s: float) -> None:
        """Record a setpoint."""
        self.commands.append((self.now_ns, thrust_N, rates_rads.copy(), since_s))

    def arm(self) -> None:
        """Record the request."""
        self.asked.append("arm")

    def hold(self) -> None:
        """Record the request."""
        self.asked.append("hold")

    def land(self) -> None:
        """Record the request."""
        self.asked.append("land")

    def close(self) -> None:
        """Record the request."""
        self.asked.append("close")


class Flight:
    """A vehicle and its autopilot in virtual time."""

    def __init__(self, *settings: str, stands: bool = False, speaks: bool = True) -> None:
        self.setup = flight(*settings)
        self.autopilot = Recording(self.setup)
        conduct = Conduct(section=self.setup.scenario.vehicles, stands=stands)
        self.node = VehicleNode(
            self.setup.run, UAV, self.autopilot, conduct, wall_offset_ns=WALL_NS
        )
        self.said: list[Message] = []
        self.now_ns = START_NS - 2 * S
        if speaks:
            self.tell(self.schedule(0))
            self.tell(self.roster(1))

    def tell(self, event: Message | Presence) -> None:
        """Pass an event to the vehicle."""
        self.said += self.node.receive(event, self.now_ns)

    def roster(self, version: int, released: tuple[int, ...] = ()) -> Roster:
        """A roster of all agents, some of whose UAVs are off their rods."""
        return Roster(
            sender="coordinator",
            incarnation=0,
            sequence=version,
            tick=0,
            version=version,
            agents=(1, 2, 3, 4),
            incarnations=(0, 0, 0, 0),
            off=released,
            released=released,
            reason="",
        )

    def begin(self) -> None:
        """Tell tick 0."""
        self.tell(self.schedule(START_NS + WALL_NS))

    def schedule(self, start_ns: int) -> Schedule:
        """A word of the coordinator."""
        return Schedule(
            sender="coordinator",
            incarnation=0,
            sequence=1,
            tick=0,
            sent_ns=self.now_ns + WALL_NS,
            start_ns=start_ns,
        )

    def until(self, time_s: float) -> None:
        """Go on to a time since tick 0, s."""
        end_ns = START_NS + round(time_s * S)
        while self.node.wake_ns <= end_ns:
            self.now_ns = max(self.now_ns, self.node.wake_ns)
            self.said += self.node.poll(self.now_ns)
        self.now_ns = end_ns

    def plan(self, tick: int, thrust_N: float = 20.0, steps: int = 20) -> Plan:
        """A plan of the vehicle's agent."""
        inputs = np.tile([thrust_N, 0.1, 0.0, 0.0], (steps, 1))
        return Plan(
            sender=f"agent{UAV}",
            incarnation=0,
            sequence=tick,
            tick=tick,
            agent=UAV,
            start_tick=tick + 1,
            negotiation=0,
            shared=True,
            uavs=(UAV,),
            uav_states=np.zeros((1, 80)),
            inputs=inputs,
            corrections=np.zeros((0, 4)),
            status="solved",
        )

    def target(self, *, lands: bool = False) -> Target:
        """A target from tick 11 on, 5 s away."""
        return Target(
            sender="coordinator",
            incarnation=0,
            sequence=3,
            tick=11,
            number=1,
            points=np.array([[1.0, 0.0, -10.0]]),
            times=np.zeros(1),
            approach_s=5.0,
            approach_ramp_s=2.0,
            way_s=0.0,
            way_ramp_s=0.0,
            lands=lands,
        )

    def link(self) -> LinkChange:
        """A change of all links from tick 11 on."""
        return LinkChange(
            sender="coordinator",
            incarnation=0,
            sequence=4,
            tick=11,
            number=1,
            source="",
            target="",
            settings='{"delay_s": 0.1}',
        )

    def end(self, outcome: Any) -> Control:
        """The end of the run."""
        return Control(
            sender="coordinator",
            incarnation=0,
            sequence=9,
            tick=10,
            outcome=outcome,
            reason="",
            exit_code=0,
        )

    def statuses(self) -> list[VehicleStatus]:
        """The statuses so far."""
        return [message for message in self.said if isinstance(message, VehicleStatus)]

    def measured(self) -> list[Measurement]:
        """The measurements so far."""
        return [message for message in self.said if isinstance(message, Measurement)]


def test_it_measures_at_each_tick_of_the_common_clock() -> None:
    """From tick 0 on there is one measurement and one status at each instant t0 + k T_s."""
    run = Flight()
    run.begin()
    run.until(0.51)
    assert [message.tick for message in run.measured()] == list(range(11))
    first = run.measured()[0]
    assert (first.sender, first.agent, first.uavs, first.roster) == ("vehicle2", 2, (2,), 1)
    assert first.uav_states.shape == (1, 15)
    np.testing.assert_allclose(first.inputs[0], run.setup.hover.u[4:8], atol=1e-12)
    assert run.statuses()[-1].phase == "flying"


def test_setpoints_come_at_their_rate_from_fresh_plans_only() -> None:
    """Plans are obeyed from their start, for 0.4 s; then its own law takes over, at once."""
    run = Flight()
    run.begin()
    run.until(0.02)
    run.tell(run.plan(0))
    run.until(1.0)

    by_plan = [at for at, thrust_N, _, _ in run.autopilot.commands if thrust_N == 20.0]
    since = [(at - START_NS) / S - since_s for at, _, _, since_s in run.autopilot.commands]
    assert (by_plan[0] - START_NS) / S == pytest.approx(T_S)  # at its first instant
    assert (by_plan[-1] - START_NS) / S < T_S + 0.4
    # Never by older knowledge than the plan's 0.4 s and the tick before its start.
    assert max(since) < 0.4 + T_S + 1e-6
    gaps_ms = np.diff([at for at, *_ in run.autopilot.commands]) / MS
    assert gaps_ms == pytest.approx([1e3 / 60.0] * len(gaps_ms), abs=0.01)
    assert {status.plan_tick for status in run.statuses()} == {-1, 0, -2}


def test_another_agents_plan_is_not_obeyed() -> None:
    """A plan of another UAV changes nothing."""
    run = Flight()
    run.begin()
    run.until(0.02)
    other = run.plan(0)
    run.tell(
        Plan(
            **{
                field: getattr(other, field)
                for field in other.__struct_fields__
                if field not in ("sender", "agent", "uavs")
            },
            sender="agent3",
            agent=3,
            uavs=(3,),
        )
    )
    run.until(0.3)
    assert all(thrust_N != 20.0 for _, thrust_N, _, _ in run.autopilot.commands)


def test_its_own_law_holds_the_hover() -> None:
    """At its place it gives the thrust of hover; a metre too low, more, and level."""
    run = Flight()
    run.begin()
    run.until(0.3)
    hover_N = run.setup.hover.u[4]
    assert [c[1] for c in run.autopilot.commands] == pytest.approx(
        [hover_N] * len(run.autopilot.commands), rel=1e-3
    )
    low = Flight()
    assert low.autopilot.told is not None
    assert low.autopilot.told.sensed is not None
    low.autopilot.told.sensed[state.POSITION] += [0.0, 0.0, 1.0]
    low.begin()
    low.until(0.3)
    assert low.autopilot.commands[-1][1] > 1.1 * hover_N


def test_after_a_plan_its_own_law_has_no_integral() -> None:
    """Its first inputs after a plan are those of a law that has observed the same and never summed an error."""
    run = Flight()
    assert run.autopilot.told is not None
    assert run.autopilot.told.sensed is not None
    run.autopilot.told.sensed[state.POSITION] += [0.0, 0.0, 0.05]
    run.begin()
    run.until(2.02)  # 41 ticks by its own law
    plan = run.plan(40, thrust_N=0.95 * float(run.setup.hover.u[4]))
    plan.inputs[:, 1:] = 0.0
    run.tell(plan)
    run.until(2.44)
    assert run.statuses()[-1].plan_tick == 40

    law = OwnLaw(run.setup.run, UAV - 1)
    law.warm_up()
    first = 49  # start 41 and 8 steps of 0.05 s
    run.until(first * T_S + 0.001)
    _, thrust_N, rates_rads, _ = run.autopilot.commands[-2]  # the plan's last
    for message in run.measured():
        law.observe(message.uav_states[0], float(message.inputs[0, 0]), message.tick)
    newest = run.measured()[-1]
    expected = law.inputs(newest.uav_states[0], first, np.array([thrust_N, *rates_rads]))
    assert newest.tick == first
    _, thrust_N, rates_rads, since_s = run.autopilot.commands[-1]
    assert since_s == pytest.approx(first * T_S)
    np.testing.assert_allclose([thrust_N, *rates_rads], expected, rtol=1e-12, atol=1e-12)


def test_a_silent_autopilot_gets_no_setpoint() -> None:
    """With a state older than `vehicles.stale_s` there is no measurement, and no setpoint by its own law."""
    run = Flight()
    run.begin()
    run.until(0.5)
    run.autopilot.is_silent_since = run.now_ns
    before = len(run.autopilot.commands)
    run.until(1.5)
    last_s = (run.autopilot.commands[-1][0] - START_NS) / S
    assert len(run.autopilot.commands) > before
    assert last_s < 0.5 + 0.25 + 1.5 * T_S
    assert run.measured()[-1].tick <= round((0.5 + 0.25) / T_S)
    assert "old" in run.statuses()[-1].problem
    run.autopilot.is_silent_since = None
    run.until(1.7)
    assert (run.autopilot.commands[-1][0] - START_NS) / S > 1.65
    assert run.measured()[-1].tick == 34


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"takes_setpoints": False, "mode": "STABILIZE"}, "no effect: mode STABILIZE"),
        ({"armed": False}, "no effect: disarmed"),
        ({"armed": False, "takes_setpoints": False, "mode": "LAND"}, "no effect: disarmed"),
    ],
)
def test_a_pilot_who_takes_over_is_told(change: dict[str, Any], problem: str) -> None:
    """Another mode or a disarmed autopilot in flight is a problem of the status until it is over."""
    run = Flight()
    run.begin()
    run.until(0.5)
    assert run.autopilot.told is not None
    before = run.autopilot.told
    run.autopilot.told = replace(before, **change)
    run.until(1.0)
    assert problem in run.statuses()[-1].problem
    run.autopilot.told = before
    run.until(1.2)
    assert run.statuses()[-1].problem == ""


def test_a_jump_of_the_estimate_is_taken_out() -> None:
    """A position that jumps by 2 m leaves measurements and setpoints as they were, and is reported."""
    run = Flight()
    run.begin()
    run.until(0.5)
    before = run.measured()[-1].uav_states[0, :3]
    assert run.autopilot.told is not None
    assert run.autopilot.told.sensed is not None
    run.autopilot.told.sensed[0] += 2.0
    run.until(1.0)
    after = run.measured()[-1].uav_states[0, :3]
    assert np.linalg.norm(after - before) < 0.01
    assert "jumped by 2.0 m" in run.statuses()[-1].problem
    thrusts = [c[1] for c in run.autopilot.commands]
    assert max(thrusts) - min(thrusts) < 0.05 * run.setup.hover.u[4]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"battery": 0.1}, "battery: expected at least 25%, got 10%"),
        ({"thrust_N": 10.3}, "thrust of its hover: expected 27.0 N [+]- 15%, .*, got 10.3 N"),
        ({"thrust_N": None}, "does not tell its thrust"),
        ({"is_healthy": False, "says": "EKF"}, "no valid estimate of its position: EKF"),
        ({"armed": False, "says": "Arm: throttle"}, "not armed in the mode of setpoints"),
    ],
)
def test_what_is_missing_before_the_start(change: dict[str, object], problem: str) -> None:
    """A vehicle that may not fly is not ready, and says why."""
    run = Flight()
    run.until(-1.5)
    assert run.statuses()[-1].phase == "ready"
    assert run.autopilot.told is not None
    run.autopilot.told = replace(run.autopilot.told, **change)  # type: ignore[arg-type]
    run.tell(run.schedule(0))
    run.until(8.0)
    assert run.statuses()[-1].phase == "checking"
    assert re.search(problem, run.statuses()[-1].problem)
    run.autopilot.told = None
    run.until(8.5)
    assert (run.statuses()[-1].phase, run.autopilot.commands) == ("silent", [])


def test_a_wrong_parameter_is_named() -> None:
    """With a finding that is not met it is not ready."""
    run = Flight()
    run.autopilot.unmet = [
        Finding(subject="GUID_TIMEOUT", expected="at most 0.5", got="3", is_met=False, reason="why")
    ]
    run.until(-1.5)
    assert run.statuses()[-1].problem == "GUID_TIMEOUT: expected at most 0.5, got 3 (why)"


def test_on_a_stand_it_arms_and_lifts() -> None:
    """Standing it arms until the autopilot is up, and then gives the thrust of hover."""
    run = Flight(stands=True)
    assert run.autopilot.told is not None
    run.autopilot.told = replace(run.autopilot.told, armed=False)
    run.until(-1.5)
    assert set(run.autopilot.asked) == {"arm"}
    run.autopilot.commands.clear()
    run.until(-1.3)
    assert run.autopilot.commands == []
    # It has not told its thrust yet.
    run.autopilot.told = replace(run.autopilot.told, armed=True, thrust_N=None)
    run.until(-1.2)
    assert run.statuses()[-1].phase == "checking"
    assert "does not tell its thrust" in run.statuses()[-1].problem
    # ArduCopter takes two seconds from arming to thrust.
    run.autopilot.told = replace(run.autopilot.told, thrust_N=0.0)
    run.until(-1.0)
    given = {(thrust_N, *rates, since_s) for _, thrust_N, rates, since_s in run.autopilot.commands}
    assert given == {(run.setup.hover.u[4], 0.0, 0.0, 0.0, 0.0)}
    assert run.statuses()[-1].phase == "checking"
    assert "0.0 N of 27.0 N" in run.statuses()[-1].problem
    run.autopilot.told = replace(run.autopilot.told, thrust_N=27.0)
    run.until(-0.5)
    assert run.statuses()[-1].phase == "ready"


def test_without_a_stand_it_leaves_the_hover_to_the_autopilot() -> None:
    """A UAV that hovers by itself gets no setpoint and no request before tick 0."""
    run = Flight()
    run.begin()
    run.until(-0.001)
    assert (run.autopilot.commands, run.autopilot.asked) == ([], [])


def test_it_goes_on_without_the_coordinator_and_comes_back() -> None:
    """Without the coordinator it flies on; a process that starts then has ticks from another vehicle."""
    run = Flight()
    run.begin()
    run.until(0.5)
    run.tell(Presence("coordinator", 0, alive=False))
    run.until(1.0)
    assert run.node.finished is None
    assert run.measured()[-1].tick == 20

    late = Flight()
    late.now_ns = START_NS + round(0.52 * S)
    told = run.statuses()[-1]
    late.tell(told)
    late.until(1.0)
    assert [message.tick for message in late.measured()] == list(range(10, 21))


@pytest.mark.parametrize(
    ("at_end", "outcome", "asked"),
    [("hold", "completed", "hold"), ("land", "completed", "land"), ("land", "aborted", "hold")],
)
def test_at_the_end_the_autopilot_takes_over(at_end: str, outcome: Any, asked: str) -> None:
    """The end of the run leaves the UAV to its autopilot: it lands only after an end in order."""
    run = Flight(f"vehicles.at_end={at_end}")
    run.begin()
    run.until(0.5)
    run.tell(run.end(outcome))
    assert run.autopilot.asked == [asked]
    assert run.node.finished is not None


@pytest.mark.parametrize("at_end", ["hold", "land"])
def test_off_its_rod_the_autopilot_takes_over(at_end: str) -> None:
    """A UAV that is released gets no setpoint any more; its process tells on how it is, without a source."""
    run = Flight(f"vehicles.at_end={at_end}")
    run.begin()
    run.until(0.5)
    run.tell(run.roster(2, released=(1, 3, 4)))
    assert run.autopilot.asked == []
    run.tell(run.roster(3, released=(UAV,)))
    before = len(run.autopilot.commands)
    run.until(1.5)
    assert (run.autopilot.asked, len(run.autopilot.commands)) == ([at_end], before)
    told = run.statuses()[-1]
    assert (told.phase, told.plan_tick) == ("released", -3)


def test_vehicles_tell_each_other_what_one_missed() -> None:
    """One that returns while there is no coordinator has the targets and links told before from the others.

    One after a gap waits for those before it.
    """
    run = Flight()
    run.begin()
    run.until(0.5)
    run.tell(run.target())
    run.tell(run.link())
    run.until(0.6)
    told = run.statuses()[-1]
    assert (told.targets, told.links, told.changes) == (1, 1, ())

    late = Flight()
    late.now_ns = run.now_ns
    elsewhere = np.array([[0.0, 5.0, -10.0]])
    gaps = changed(run.target(), number=2, points=elsewhere), changed(run.link(), number=2)
    late.tell(changed(told, changes=tuple(map(encode, gaps))))
    late.until(0.7)
    assert (late.statuses()[-1].targets, late.statuses()[-1].links) == (0, 0)
    run.tell(late.statuses()[-1])
    run.until(0.75)
    late.tell(run.statuses()[-1])
    late.until(0.8)
    assert (late.statuses()[-1].targets, late.statuses()[-1].links) == (1, 1)
    # Both follow the same path by their own laws.
    run.until(6.0)
    late.until(6.0)
    np.testing.assert_allclose(
        late.autopilot.commands[-1][2], run.autopilot.commands[-1][2], atol=1e-9
    )


def test_a_motion_during_a_silence_is_no_jump() -> None:
    """A UAV that has drifted by 2 m while nothing was heard of its autopilot is where it says."""
    run = Flight()
    run.begin()
    run.until(0.5)
    run.autopilot.is_silent_since = run.now_ns
    run.until(2.5)
    assert run.autopilot.told is not None
    assert run.autopilot.told.sensed is not None
    run.autopilot.told.sensed[0] += 2.0
    run.autopilot.is_silent_since = None
    before = run.measured()[-1].uav_states[0, 0]
    run.until(3.0)
    assert run.measured()[-1].uav_states[0, 0] - before == pytest.approx(2.0, abs=0.01)
    assert run.statuses()[-1].problem == ""


def test_interpolation_keeps_the_middles() -> None:
    """In the middle of a step its inputs are applied, between two middles a mixture, none before."""
    inputs = np.arange(12.0).reshape(3, 4)
    for step in range(3):
        np.testing.assert_array_equal(interpolated(inputs, step + 0.5), inputs[step])
    np.testing.assert_allclose(interpolated(inputs, 1.0), inputs[:2].mean(axis=0))
    np.testing.assert_array_equal(interpolated(inputs, 0.0), inputs[0])
    np.testing.assert_array_equal(interpolated(inputs, 2.9), inputs[2])


def test_the_newest_started_plan_counts() -> None:
    """Plans in any order of arrival: the newest one that has started, unless it is too old."""
    make = Flight().plan
    plans = Plans(played=8)
    plans.add(make(4, 24.0), 0)
    plans.add(make(3, 23.0), 0)
    assert plans.at(3.9) is None
    found = plans.at(4.5)
    assert found is not None
    assert found[1][0] == 23.0
    found = plans.at(5.2)
    assert found is not None
    assert found[1][0] == 24.0
    assert plans.at(12.99) is not None
    assert plans.at(13.0) is None
    # Rows that repeat older inputs count from these, and those of a short plan end with it.
    for plan, steps in ((changed(make(4), stale=5), 3), (make(4, steps=2), 2)):
        plans = Plans(played=8)
        plans.add(plan, 0)
        assert plans.at(5.0 + steps - 0.01) is not None
        assert plans.at(5.0 + steps) is None


def test_before_tick_0_it_looks_fifty_times_a_second_and_tells_five_times() -> None:
    """Nothing is said before the coordinator has spoken; the last look is at the instant of tick 0."""
    silent = Flight(speaks=False)
    silent.until(-1.0)
    assert silent.said == []

    run = Flight()
    run.now_ns += 7 * MS  # tick 0 is no whole number of looks later
    run.begin()
    looks: list[int] = []
    attend = run.autopilot.attend

    def look(now_ns: int) -> None:
        looks.append(now_ns)
        attend(now_ns)

    run.autopilot.attend = look  # type: ignore[method-assign]
    run.until(0.01)
    assert len(run.statuses()) == 11  # ten in 1.993 s, and that of tick 0
    assert [status.phase for status in run.statuses()] == ["ready"] * 10 + ["flying"]
    before = [at for at in looks if at < START_NS]
    assert len(before) == 99
    assert {round((b - a) / MS) for a, b in pairwise(before)} == {20}
    assert looks[99] == run.autopilot.commands[0][0] == START_NS


def test_the_first_instants_of_the_ticks_hold() -> None:
    """A schedule without them or with others changes nothing."""
    run = Flight()
    run.begin()
    run.until(0.1)
    run.tell(run.schedule(0))
    run.tell(run.schedule(START_NS + WALL_NS + 3 * S))
    run.until(0.3)
    assert run.measured()[-1].tick == 6
    assert run.statuses()[-1].start_ns == START_NS + WALL_NS


def test_measurements_have_the_mean_of_the_setpoints_since_the_last_tick() -> None:
    """Those of a plan from its start on; a tick without setpoints has the last one."""
    run = Flight()
    run.begin()
    run.until(0.02)
    plan = run.plan(0)
    plan.inputs[:, 0] += 0.5 * np.arange(20) ** 2
    run.tell(plan)
    run.until(0.12)
    given = [[thrust_N, *rates] for _, thrust_N, rates, _ in run.autopilot.commands]
    # Of the setpoints at 0, 16.7 and 33.3 ms none is by the plan.
    assert [each[1] for each in given[:6]] == pytest.approx([0.0] * 3 + [0.1] * 3, abs=1e-9)
    for k in (1, 2):
        mean = np.mean(given[3 * k - 3 : 3 * k], axis=0)
        np.testing.assert_allclose(run.measured()[k].inputs[0], mean)
    run.now_ns = START_NS + 170 * MS  # busy from 120 ms on
    run.until(0.17)
    assert run.measured()[-1].tick == 3
    run.now_ns = START_NS + 240 * MS
    run.said += run.node.poll(run.now_ns)
    assert run.measured()[-1].tick == 4
    _, thrust_N, rates_rads, _ = run.autopilot.commands[-2]  # the newest one is from now on
    np.testing.assert_allclose(run.measured()[-1].inputs[0], [thrust_N, *rates_rads])
    members = run.measured()[-1]
    assert members.answered == members.shared == (1, 2, 3, 4)


def test_instants_that_have_passed_are_left_out() -> None:
    """A process that was busy sends one setpoint, tells by how much it was late, and goes on at the next instant."""
    run = Flight()
    run.begin()
    run.until(0.18)  # the next setpoint is due at 183.3 ms
    before = len(run.autopilot.commands)
    run.now_ns = START_NS + 262 * MS
    run.said += run.node.poll(run.now_ns)
    run.until(0.301)
    ms = [round((at - START_NS) / MS) for at, *_ in run.autopilot.commands[before:]]
    assert ms == [262, 267, 283, 300]
    late_s = {status.tick: status.late_s for status in run.statuses()}
    assert (late_s[3], late_s[5]) == (0.0, 0.0)
    assert late_s[6] == pytest.approx(0.262 - 11 / 60, abs=1e-6)
    run.until(0.36)
    assert run.statuses()[-1].late_s == 0.0


@pytest.mark.parametrize(("arrives_s", "latency_s"), [(0.02, 0.0), (0.06, 1 / 15 - 0.06)])
def test_the_latency_of_a_plan_is_from_when_it_may_be_used(
    arrives_s: float, latency_s: float
) -> None:
    """From its arrival or, if that is later, its start, to its first setpoint; told once for each plan."""
    run = Flight()
    run.begin()
    run.until(arrives_s)
    run.tell(run.plan(0))  # from tick 1 on
    run.until(0.21)
    told = [status.latency_s for status in run.statuses() if status.tick >= 0]
    assert [latency for latency in told if latency >= 0.0] == [pytest.approx(latency_s, abs=1e-6)]


def test_setpoints_tell_by_which_knowledge_they_are() -> None:
    """That of the plan's tick less the ticks by which it repeats an older one; by its own law that of this tick."""
    run = Flight()
    run.begin()
    run.until(0.12)
    own = {since_s for *_, since_s in run.autopilot.commands}
    assert own == {0.0, T_S, 2 * T_S}
    run.tell(changed(run.plan(2), stale=2))
    run.until(0.19)
    assert {since_s for *_, since_s in run.autopilot.commands[-2:]} == {0.0}


@pytest.mark.parametrize(
    ("lands", "at_s", "asked"),
    [(True, 7.55, "land"), (True, 7.5, "hold"), (False, 9.0, "hold")],
)
def test_a_team_that_has_landed_may_be_ended(lands: bool, at_s: float, asked: str) -> None:
    """An end without success is in order once the team is at rest on the ground; a second end changes nothing."""
    run = Flight("vehicles.at_end=land")
    run.begin()
    run.until(0.5)
    run.tell(run.target(lands=lands))  # 5 s from tick 11 on, and 2 s to settle
    run.until(at_s)
    run.tell(run.end("aborted"))
    assert run.autopilot.asked == [asked]
    run.tell(run.roster(2, released=(UAV,)))
    assert run.autopilot.asked == [asked]


def test_a_further_target_follows_the_ones_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own law knows them all, and the newest one says whether the team lands."""
    known: list[int] = []
    follow = OwnLaw.follow

    def watched(law: OwnLaw, run: Any) -> None:
        known.append(len(run.maneuver.targets))
        follow(law, run)

    monkeypatch.setattr(OwnLaw, "follow", watched)
    run = Flight("vehicles.at_end=land")
    run.begin()
    run.until(0.5)
    run.tell(run.target())
    run.until(2.0)
    run.tell(
        changed(run.target(lands=True), tick=41, number=2, approach_s=1.0, approach_ramp_s=0.5)
    )
    assert known == [1, 2]
    run.until(6.0)
    run.tell(run.end("aborted"))
    assert run.autopilot.asked == ["land"]


def test_instants_told_just_before_tick_0_and_setpoints_between_ticks() -> None:
    """Tick 0 has its setpoint at its instant, and a tick between two setpoints its measurement."""
    run = Flight("vehicles.setpoint_hz=50.0")
    run.now_ns += 7 * MS
    run.node.poll(run.now_ns)  # one each 20 ms from now on: the next would be 7 ms after tick 0
    run.until(-0.005)
    run.begin()
    run.until(0.16)
    assert [at - START_NS for at, *_ in run.autopilot.commands[:3]] == [0, 20 * MS, 40 * MS]
    sent_ms = [
        (one.sent_ns - WALL_NS - START_NS) / MS for one in run.statuses() if one.phase == "flying"
    ]
    assert sent_ms == [0, 50, 100, 150]


def test_after_the_last_tick_it_holds_its_hover() -> None:
    """Until the coordinator ends the run there are setpoints and statuses of the last tick, no measurements."""
    run = Flight()
    ticks = run.setup.ticks
    run.now_ns = START_NS + round((ticks - 2) * T_S * S)
    run.begin()
    run.until((ticks + 3) * T_S)
    assert run.measured()[-1].tick == ticks - 1
    assert [status.tick for status in run.statuses()][-4:] == [ticks - 1] * 4
    assert (run.autopilot.commands[-1][0] - START_NS) / S > (ticks + 2.5) * T_S


def test_a_status_tells_how_the_uav_is() -> None:
    """Its place with jumps taken out, its age, what was heard of the coordinator and when; unknown values are -1."""
    run = Flight()
    run.begin()
    run.until(0.3)
    assert run.autopilot.told is not None
    assert run.autopilot.told.sensed is not None
    place = run.autopilot.told.sensed[:3].copy()
    run.autopilot.told.sensed[0] += 2.0
    run.autopilot.is_silent_since = run.now_ns
    run.now_ns += 20 * MS
    word = run.schedule(START_NS + WALL_NS)
    run.tell(word)
    run.until(0.36)
    told = run.statuses()[-1]
    np.testing.assert_allclose(told.position, place)
    assert (told.tick, told.uav, told.roster, told.battery) == (7, UAV, 1, 0.9)
    assert (told.armed, told.healthy, told.mode) == (True, True, "GUIDED")
    assert told.age_s == pytest.approx(0.05)
    heard_ns = START_NS + 320 * MS + WALL_NS
    assert (told.heard_ns, told.heard_at_ns) == (word.sent_ns, heard_ns)
    assert told.sent_ns == START_NS + 350 * MS + WALL_NS

    run.autopilot.told = None
    run.until(0.41)
    told = run.statuses()[-1]
    assert (told.armed, told.healthy, told.mode, told.battery, told.age_s) == (
        False, False, "", -1.0, -1.0,
    )  # fmt: skip
    assert not told.position.any()
