"""Plausibility: the contents a message can have in a run, at any tick."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.log_messages import report
from tests.support.messages import sample
from tests.support.runs import setup, ticks
from transport.model.state import PER_UAV, REPORTED, REPORTS, SENSED
from transport.protocol.admission.plausibility import check_plausible
from transport.protocol.wire.codec import encode
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import ActualInputs, Airtime, Message, Target, VehicleStatus
from transport.protocol.wire.node_interface import RunShape

RUN = setup("controller.horizon=5", ticks(40))
PLAN, MEASUREMENT = runs.plan(RUN, 2, 3), runs.measurement(RUN, 2, 3)
TARGET = replace(sample(Target), tick=3)
ACTUAL = replace(sample(ActualInputs), tick=3)
AIRTIME = replace(sample(Airtime), tick=3, agents=(1,), receivers=(1, 2, 3, 4))


def refusal(message: Message, shape: RunShape = RUN.rules.shape) -> tuple[str, str]:
    """Reason and text with which a message is refused; empty if it is not."""
    try:
        check_plausible(message, shape)
    except MessageError as error:
        return error.reason, str(error)
    return "", ""


@pytest.mark.parametrize(
    ("message", "changes", "reason", "text"),
    [
        (PLAN, {"tick": 40, "start_tick": 40}, "future", "plan of tick 40, expected 39 or earlier"),
        (
            runs.end(),
            {"tick": 2**40},
            "future",
            "control of tick 1099511627776, expected 39 or earlier",
        ),
        (PLAN, {"agent": 9, "sender": "agent9"}, "unknown_agent", "plan of agent 9, the run has 4"),
        (PLAN, {"uavs": (3,)}, "wrong_uavs", "plan of UAVs [3], agent 2 has [2]"),
        (PLAN, {"uavs": ()}, "wrong_uavs", "plan of UAVs [], agent 2 has [2]"),
        (
            PLAN,
            {"targets": (encode(runs.tick(3)),)},
            "wrong_sender",
            "targets: expected targets of the coordinator or an agent, got tick of coordinator",
        ),
        (PLAN, {"start_tick": 4}, "future", "plan of tick 3 that starts at tick 4"),
        (PLAN, {"start_tick": 2}, "past", "plan of tick 3 that starts at tick 2"),
        (PLAN, {"negotiation": 1}, "out_of_range", "negotiation: expected less than 1, got 1"),
        (
            PLAN,
            {"inputs": PLAN.inputs + 30.0},
            "outside_limits",
            "inputs outside the limits of agent2",
        ),
        (
            PLAN,
            {"inputs": PLAN.inputs - 30.0},
            "outside_limits",
            "inputs outside the limits of agent2",
        ),
        (
            PLAN,
            {"corrections": PLAN.inputs - 2e6},
            "out_of_range",
            "corrections: expected at most 1e+06, got 2e+06",
        ),
        (
            PLAN,
            {"uav_states": PLAN.uav_states * 0.5},
            "out_of_range",
            "expected rod directions of length 1, got 0.5",
        ),
        (
            PLAN,
            {"uav_states": PLAN.uav_states + 1e7},
            "out_of_range",
            "uav_states: expected at most 1e+06, got 1e+07",
        ),
        (
            PLAN,
            {"uav_states": np.zeros((1, 80))},
            "wrong_shape",
            "uav_states: expected 12 numbers of a UAV, got 80",
        ),
        (MEASUREMENT, {"uavs": (1,)}, "wrong_uavs", "measurement of UAVs [1], agent 2 has [2]"),
        (MEASUREMENT, {"agent": 5}, "unknown_agent", "measurement of agent 5, the run has 4"),
        (
            MEASUREMENT,
            {"answered": (2, 5, 7)},
            "unknown_agent",
            "answered: expected agents of this run, got [5, 7]",
        ),
        (
            MEASUREMENT,
            {"payload": np.full(12, -1e9)},
            "out_of_range",
            "payload: expected at most 1e+06, got 1e+09",
        ),
        (
            MEASUREMENT,
            {"inputs": np.full((1, 4), 1e300)},
            "out_of_range",
            "inputs: expected at most 1e+06, got 1e+300",
        ),
        (
            runs.tick(3),
            {"members": (1, 5)},
            "unknown_agent",
            "members: expected agents of this run, got [5]",
        ),
        (
            runs.tick(3),
            {"answered": (256,)},
            "unknown_agent",
            "answered: expected agents of this run, got [256]",
        ),
        (
            runs.roster({1: 0, 6: 0}),
            {},
            "unknown_agent",
            "agents: expected agents of this run, got [6]",
        ),
        (
            runs.roster({1: 0}),
            {"released": (200,)},
            "unknown_agent",
            "released: expected UAVs of this run, got [200]",
        ),
        (
            runs.tick(3),
            {"shared": (0,)},
            "unknown_agent",
            "shared: expected agents of this run, got [0]",
        ),
        (
            MEASUREMENT,
            {"shared": (2, 6)},
            "unknown_agent",
            "shared: expected agents of this run, got [6]",
        ),
        (
            MEASUREMENT,
            {"missing": 1},
            "wrong_shape",
            "missing: expected none without sensors of vehicles, got 1",
        ),
        (
            runs.roster({1: 0}),
            {"off": (1, 5)},
            "unknown_agent",
            "off: expected UAVs of this run, got [5]",
        ),
        (
            TARGET,
            {"to": (2, 9)},
            "unknown_agent",
            "to: expected agents of this run, got [9]",
        ),
        (
            ACTUAL,
            {"uavs": (5,)},
            "unknown_agent",
            "uavs: expected UAVs of this run, got [5]",
        ),
        (
            ACTUAL,
            {"cables": (7,)},
            "unknown_agent",
            "cables: expected UAVs of this run, got [7]",
        ),
        (
            replace(sample(VehicleStatus), tick=3),
            {"changes": (encode(TARGET), encode(replace(TARGET, to=(9,))))},
            "unknown_agent",
            "to: expected agents of this run, got [9]",
        ),
        (
            AIRTIME,
            {"agents": (5,)},
            "unknown_agent",
            "agents: expected agents of this run, got [5]",
        ),
        (
            AIRTIME,
            {"receivers": (1, 2, 3)},
            "unknown_agent",
            "receivers: expected all agents of this run, got [1, 2, 3]",
        ),
        (
            report(RUN, 2, 3),
            {"peers": (1, 3, 9)},
            "unknown_agent",
            "peers: expected agents of this run, got [9]",
        ),
        (
            sample(type(runs.plant_state(RUN, 3))),
            {"tick": 3},
            "wrong_shape",
            "x: expected a state of 4 UAVs",
        ),
        (
            runs.plant_state(RUN, 3),
            {"plan_ticks": (3,) * 5},
            "wrong_shape",
            "x: expected a state of 4 UAVs, got one of 5",
        ),
    ],
)
def test_implausible_messages_are_refused(
    message: Message, changes: dict[str, Any], reason: str, text: str
) -> None:
    """Each impossible field is refused with its reason and a text."""
    found = refusal(replace(message, **changes))
    assert found[0] == reason
    assert text in found[1]


LOW, HIGH = RUN.rules.shape.limits[2]
BESIDE_PAIR = setup("agents.owned=[[1,2],[3],[4]]", ticks(40))


@pytest.mark.parametrize(
    ("message", "changes", "shape"),
    [
        (PLAN, {"tick": 0, "start_tick": 0}, {}),
        (PLAN, {"tick": 39, "start_tick": 39}, {}),
        (PLAN, {"negotiation": 2}, {"negotiation_iterations": 3}),
        (PLAN, {"inputs": np.tile(LOW, (5, 1))}, {}),
        (PLAN, {"inputs": np.tile(HIGH, (5, 1))}, {}),
        (PLAN, {"corrections": np.full((5, 4), 1e6)}, {}),
        (MEASUREMENT, {"payload": np.full(12, -1e6)}, {}),
        (PLAN, {"uav_states": np.zeros((1, REPORTS * REPORTED))}, {"vehicle_sensors": True}),
        (
            MEASUREMENT,
            {"uav_states": np.zeros((1, SENSED)), "payload": np.zeros(0), "missing": (1,)},
            {"vehicle_sensors": True},
        ),
    ],
)
def test_what_is_just_possible_is_accepted(
    message: Message, changes: dict[str, Any], shape: dict[str, Any]
) -> None:
    """The first and the last tick, the last proposal, inputs at limits, the largest numbers; what sensors measure."""
    assert refusal(replace(message, **changes), dataclasses.replace(RUN.rules.shape, **shape)) == (
        "",
        "",
    )


def test_each_agent_has_the_limits_of_its_own_uavs() -> None:
    """An agent of one UAV has other limits than one of two."""
    assert refusal(runs.plan(BESIDE_PAIR, 2, 3), BESIDE_PAIR.rules.shape) == ("", "")


def test_rod_directions_of_all_uavs_count() -> None:
    """The refusal tells the length that is farthest from 1, of whichever UAV."""
    found = runs.measurement(BESIDE_PAIR, 1, 3)
    states = found.uav_states.copy()
    states[1] *= 0.5
    refused = refusal(
        replace(found, uav_states=states, answered=(), shared=()), BESIDE_PAIR.rules.shape
    )
    expected = "uav_states: expected rod directions of length 1, got 0.5"
    assert refused == ("out_of_range", expected)


@pytest.mark.parametrize(
    ("length", "is_possible"), [(0.81, True), (1.19, True), (0.79, False), (1.21, False)]
)
def test_a_rod_direction_is_a_unit_vector_but_for_noise(length: float, is_possible: bool) -> None:
    """Sensor noise explains a length up to 0.2 from 1."""
    scaled = replace(MEASUREMENT, uav_states=MEASUREMENT.uav_states * length)
    assert (refusal(scaled) == ("", "")) is is_possible


SOLID_IN_SIGHT = np.array([[2.0, 1e6, -1e6, -10.0, -3.0, 0.5, 1e6, 0.0, 0.0, 0.3, 0.2]])


@pytest.mark.parametrize(
    ("column", "value"),
    [
        (None, 0.0),
        (0, 0.0),
        (0, 1.5),
        (1, 1.1e6),
        (2, -1.1e6),
        *((size, -0.1) for size in range(5, 11)),
    ],
)
def test_solids_in_sight_are_of_an_obstacle(column: int | None, value: float) -> None:
    """A number from 1, places and sizes within the largest ones, no negative size; a heading has any sign."""
    sighted = dataclasses.replace(RUN.rules.shape, sights=1)
    seen = SOLID_IN_SIGHT.copy()
    if column is None:
        assert refusal(replace(MEASUREMENT, seen=seen), sighted) == ("", "")
        return
    seen[0, column] = value
    reason, text = refusal(replace(MEASUREMENT, seen=seen), sighted)
    assert reason == "out_of_range"
    assert "seen: expected a number from 1, and sizes from 0 to 1e+06" in text


@pytest.mark.parametrize(("sights", "most"), [(0, 0), (1, 64)])
def test_solids_are_seen_where_obstacles_are_to_be_seen(sights: int, most: int) -> None:
    """None in a run whose obstacles all know, else at most 64 at once."""
    shape = dataclasses.replace(RUN.rules.shape, sights=sights)
    assert refusal(replace(MEASUREMENT, seen=np.repeat(SOLID_IN_SIGHT, most, axis=0)), shape) == (
        "",
        "",
    )
    too_many = replace(MEASUREMENT, seen=np.repeat(SOLID_IN_SIGHT, most + 1, axis=0))
    assert refusal(too_many, shape)[0] == "out_of_range"


def test_numbers_of_vehicle_sensors() -> None:
    """Where UAVs have sensors of their own, a measurement has their numbers, not states."""
    shape = dataclasses.replace(RUN.rules.shape, vehicle_sensors=True)
    expected = f"uav_states: expected {SENSED} numbers of a UAV, got {PER_UAV}"
    assert refusal(MEASUREMENT, shape) == ("wrong_shape", expected)


def test_start_of_plans() -> None:
    """With actuation "next_tick" a plan starts one tick after its own."""
    shape = setup("clock.actuation=next_tick").rules.shape
    assert refusal(replace(PLAN, start_tick=4), shape) == ("", "")
    assert refusal(PLAN, shape)[0] == "past"
