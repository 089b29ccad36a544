"""The plant that plays physics to autopilots: standing, release at tick 0, record, and a host that is too slow."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from transport.flight.roles import plant_run
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.plant.actuator_schedule import MOTOR_OFF
from transport.plant.autopilot.node import PlayedPlant
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import ActualInputs, Message, PlantState, Schedule

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "flight.toml"
MS, S = 10**6, 10**9
WALL_NS = 1_700_000_000 * S
FOUR_TICKS = "maneuver.phase=[{name='hover',duration_s=0.2,displacement_m=[0,0,0]}]"
# A degradation of motors that are off gives them no thrust.
MOTOR_OFF_AT_TICK_2 = (
    "faults.event=[{at_s=0.1,do='motor_off',target='uav2'},"
    "{at_s=0.15,do='degrade',target='uav2',efficiency=0.5}]"
)
WIND = "plant.wind.speed_mps=[8.0,0.0,0.0]"


@lru_cache(maxsize=2)
def flight(*settings: str) -> Setup:
    """The ready scenario with some settings changed."""
    return Setup.of(read_scenario(SCENARIO, settings), str(SCENARIO))


class Constant:
    """Autopilots that give the same thrusts whatever they sense."""

    step_s = 1 / 400

    def __init__(self, inputs: Array) -> None:
        self.failure = ""
        self.given = inputs
        self.times_s: list[float] = []
        self.sensed: list[Array] = []

    def inputs(self) -> Array:
        """Thrust and moments of the motors."""
        return self.given

    def sense(self, time_s: float, sensed: Array) -> None:
        """Keep what is sensed."""
        self.times_s.append(time_s)
        self.sensed.append(sensed.reshape(-1, 15).copy())


def played(share: float, *settings: str) -> tuple[PlayedPlant, Constant]:
    """A plant above autopilots that give a share of the thrust of hover."""
    run = flight(*settings)
    bank = Constant(share * run.hover.u)
    return PlayedPlant(plant_run(run), bank, wall_offset_ns=WALL_NS), bank


def schedule(start_ns: int) -> Schedule:
    """Tell tick 0."""
    return Schedule(
        sender="coordinator",
        incarnation=0,
        sequence=0,
        tick=0,
        sent_ns=WALL_NS,
        start_ns=start_ns + WALL_NS,
    )


def go(plant: PlayedPlant, begin_ns: int, end_ns: int) -> list[Message]:
    """Poll every 5 ms."""
    said: list[Message] = []
    for now_ns in range(begin_ns, end_ns + 1, 5 * MS):
        said += plant.poll(now_ns)
    return said


def test_the_team_stands_until_tick_0() -> None:
    """Before it, whatever the motors give, autopilots sense a team at rest; their time goes on in equal steps."""
    plant, bank = played(0.0)
    assert go(plant, 0, 1 * S) == []
    assert np.ptp(np.array(bank.sensed), axis=0).max() == 0.0
    np.testing.assert_allclose(np.diff(bank.times_s), 1 / 400, atol=1e-9)
    assert len(bank.times_s) == 400
    # At rest an accelerometer feels what carries the body: its weight, upwards.
    assert bank.sensed[-1][:, 14] == pytest.approx([-9.81] * 4)


def test_autopilots_start_in_real_time() -> None:
    """A run at half of real time starts its autopilots in real time, and slows down when tick 0 is told."""
    plant, bank = played(1.0, "clock.speed=0.5")
    go(plant, 0, 1 * S)
    assert len(bank.times_s) == 400
    plant.receive(schedule(2 * S), 1 * S)
    go(plant, 1 * S, 2 * S)
    assert len(bank.times_s) == 600
    said = go(plant, 2 * S, 3 * S)
    assert len(bank.times_s) == 800
    assert len([message for message in said if isinstance(message, PlantState)]) == 10


def test_from_tick_0_on_it_flies_and_is_recorded() -> None:
    """At the instant of tick 0 the team is let go: at hover thrust it stays, one state for each tick."""
    plant, bank = played(1.0)
    go(plant, 0, 1 * S)
    assert list(plant.receive(schedule(1 * S + 250 * MS), 1 * S)) == []
    said = go(plant, 1 * S, 2 * S + 250 * MS)
    states = [message for message in said if isinstance(message, PlantState)]
    assert [state.tick for state in states] == list(range(20))
    np.testing.assert_allclose(states[-1].x, states[0].x, atol=1e-4)
    assert states[-1].diverged == ""
    assert np.abs(bank.sensed[-1][:, :3] - bank.sensed[0][:, :3]).max() < 1e-3


def test_without_thrust_it_falls() -> None:
    """Let go without thrust the team falls: the release is real, and not before tick 0."""
    plant, bank = played(0.0)
    go(plant, 0, 1 * S)
    plant.receive(schedule(1 * S + 100 * MS), 1 * S)
    go(plant, 1 * S, 1 * S + 600 * MS)
    fallen_m = bank.sensed[-1][:, 2] - bank.sensed[0][:, 2]
    # g t^2 / 2 over 0.5 s, less the lag of the motors.
    assert fallen_m.min() > 0.8
    assert fallen_m.max() < 1.23


def test_a_host_that_is_too_slow_ends_the_run() -> None:
    """Physics more than a second behind the ticks end the run, with the remedy; before tick 0 they wait."""
    plant, _ = played(1.0)
    go(plant, 0, 100 * MS)
    assert list(plant.poll(5 * S)) == []  # nothing depends on the pace yet
    plant.receive(schedule(6 * S), 5 * S)
    said = go(plant, 5 * S, 7 * S)
    said += go(plant, 9 * S, 10 * S)
    states = [message for message in said if isinstance(message, PlantState)]
    assert "lower clock.speed" in states[-1].diverged

    # A coordinator that was away learns it, as of a tick that it has not heard of.
    again = [message for message in go(plant, 10 * S, 12 * S) if isinstance(message, PlantState)]
    assert [state.diverged for state in again] == [states[-1].diverged] * len(again)
    assert len(again) in (1, 2)
    assert again[0].tick > states[-1].tick


def test_steps_that_are_due_are_played_in_turns() -> None:
    """At most 40 between two looks at messages; a plant that is behind wakes at once, else after 5 ms."""
    plant, bank = played(1.0)
    plant.poll(0)
    found = []
    for _ in range(3):
        plant.poll(250 * MS)
        found.append((len(bank.times_s), plant.wake_ns))
    assert found == [(40, 250 * MS), (80, 250 * MS), (100, 255 * MS)]
    # Before tick 0 is told a second is made up for at most.
    for _ in range(20):
        plant.poll(5 * S)
    assert (len(bank.times_s), plant.wake_ns) == (500, 5 * S + 5 * MS)


def test_after_the_last_tick_it_flies_on_without_a_record() -> None:
    """Autopilots need their sensors until the coordinator ends the run; a second tick 0 changes nothing."""
    plant, bank = played(0.95, FOUR_TICKS)
    go(plant, 0, 1 * S)
    plant.receive(schedule(-WALL_NS), 1 * S)  # not known yet
    plant.receive(schedule(1 * S), 1 * S)
    plant.receive(schedule(5 * S), 1 * S)
    states = [message for message in go(plant, 1 * S, 2 * S) if isinstance(message, PlantState)]
    assert [state.tick for state in states] == [0, 1, 2, 3]
    assert len(bank.times_s) == 800
    # With less thrust than that of hover they sink on, step by step.
    heights_m = np.array(bank.sensed[-300:])[:, :, 2]
    assert (np.diff(heights_m, axis=0) > 0.0).all()


@pytest.mark.parametrize(("fails_ms", "ticks"), [(1125, [2, 3, 3]), (1175, [3])])
def test_the_end_is_told_again_each_second(fails_ms: int, ticks: list[int]) -> None:
    """A failure ends the run within its period, and is told again as of the newest tick that the run has."""
    plant, bank = played(1.0, FOUR_TICKS)
    go(plant, 0, 1 * S)
    plant.receive(schedule(1 * S), 1 * S)
    go(plant, 1 * S, fails_ms * MS)
    bank.failure = "gone"
    played_before = len(bank.times_s)
    said = go(plant, fails_ms * MS, 3200 * MS)
    states = [message for message in said if isinstance(message, PlantState)]
    assert [state.tick for state in states] == ticks
    assert {state.diverged for state in states} == {"gone"}
    assert len(bank.times_s) == played_before + 1
    assert plant.wake_ns == 4200 * MS


def test_failures_of_uavs_act_with_their_tick() -> None:
    """Motors that are switched off at 0.1 s follow no autopilot from tick 2 on."""
    plant, _ = played(1.0, MOTOR_OFF_AT_TICK_2)
    go(plant, 0, 1 * S)
    plant.receive(schedule(1 * S), 1 * S)
    said = go(plant, 1 * S, 1250 * MS)
    states = [message for message in said if isinstance(message, PlantState)]
    given = [message.inputs[1] for message in said if isinstance(message, ActualInputs)]
    are_off = [False, False, True, True, True]
    assert [state.plan_ticks[1] == MOTOR_OFF for state in states] == are_off
    assert [not inputs.any() for inputs in given] == are_off


def test_accelerometers_feel_thrust_rods_and_wind() -> None:
    """The specific force of a UAV is the change of its velocity less gravity, R f = dv/dt - g.

    Also while its thrust rises.
    """
    plant, bank = played(1.0, WIND)
    hover = bank.given
    go(plant, 0, 1 * S)
    plant.receive(schedule(1 * S), 1 * S)
    for now_ms in range(1000, 1301, 5):
        bank.given = hover * (now_ms / 1000)
        plant.poll(now_ms * MS)
    sensed = np.array(bank.sensed[-60:])
    rates = (sensed[2:, :, 3:6] - sensed[:-2, :, 3:6]) * 200.0
    for step, now in enumerate(sensed[1:-1]):
        for uav, own in enumerate(now):
            felt = rotation(own[6:9]) @ own[12:15] + [0.0, 0.0, 9.81]
            np.testing.assert_allclose(felt, rates[step, uav], atol=0.05)
