"""The process of one UAV as a state machine, above an autopilot that records what it is told."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import (
    Control,
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

    def __init__(self, *settings: str, stands: bool = False) -> None:
        self.setup = flight(*settings)
        self.autopilot = Recording(self.setup)
        conduct = Conduct(section=self.setup.scenario.vehicles, stands=stands)
        self.node = VehicleNode(
            self.setup.run, UAV, self.autopilot, conduct, wall_offset_ns=WALL_NS
        )
        self.said: list[Message] = []
        self.now_ns = START_NS - 2 * S
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
    assert {c[1] for c in run.autopilot.commands} == {run.setup.hover.u[4]}
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
    run.tell(
        Control(
            sender="coordinator",
            incarnation=0,
            sequence=9,
            tick=10,
            outcome=outcome,
            reason="",
            exit_code=0,
        )
    )
    assert run.autopilot.asked == [asked]
    assert run.node.finished is not None


def test_off_its_rod_the_autopilot_takes_over() -> None:
    """A UAV that is released gets no setpoint any more; its process tells on how it is."""
    run = Flight()
    run.begin()
    run.until(0.5)
    run.tell(run.roster(2, released=(UAV,)))
    before = len(run.autopilot.commands)
    run.until(1.5)
    assert (run.autopilot.asked, len(run.autopilot.commands)) == (["hold"], before)
    assert run.statuses()[-1].phase == "released"


def test_vehicles_tell_each_other_what_one_missed() -> None:
    """One that returns while there is no coordinator has the targets told before from the others."""
    run = Flight()
    run.begin()
    run.until(0.5)
    run.tell(
        Target(
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
        )
    )
    run.until(0.6)
    assert (run.statuses()[-1].targets, run.statuses()[-1].changes) == (1, ())

    late = Flight()
    late.now_ns = run.now_ns
    late.tell(run.statuses()[-1])
    late.until(0.7)
    assert late.statuses()[-1].targets == 0
    run.tell(late.statuses()[-1])
    run.until(0.75)
    late.tell(run.statuses()[-1])
    late.until(0.8)
    assert late.statuses()[-1].targets == 1
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
