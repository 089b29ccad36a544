"""Tables of messages: each number stands under its name and unit (docs/log.md)."""

from typing import Any

import numpy as np
import pytest

from tests.support.logs import log_of
from transport.log.tables import INPUT_NAMES, Row, columns, tables
from transport.protocol.wire.messages import (
    ActualInputs,
    Measurement,
    Message,
    Note,
    Plan,
    PlantState,
    StepReport,
)

# Names in the order of the numbers in a message, as docs/log.md and docs/reference/protocol.md give them.
ATTITUDE = ["roll_rad", "pitch_rad", "yaw_rad"]
RATE = ["omega_x_rad_s", "omega_y_rad_s", "omega_z_rad_s"]
PAYLOAD = [
    *("payload_r0_x_m", "payload_r0_y_m", "payload_r0_z_m"),
    *("payload_v0_x_m_s", "payload_v0_y_m_s", "payload_v0_z_m_s"),
    *("payload_roll_rad", "payload_pitch_rad", "payload_yaw_rad"),
    *("payload_omega0_x_rad_s", "payload_omega0_y_rad_s", "payload_omega0_z_rad_s"),
]
UAV = ["e_x", "e_y", "e_z", "Omega_x_rad_s", "Omega_y_rad_s", "Omega_z_rad_s", *ATTITUDE, *RATE]
POSITION = ["r_x_m", "r_y_m", "r_z_m"]
VELOCITY = ["v_x_m_s", "v_y_m_s", "v_z_m_s"]
FORCE = ["specific_force_x_m_s2", "specific_force_y_m_s2", "specific_force_z_m_s2"]
COMMANDS = ["thrust_N", "moment_x_Nm", "moment_y_Nm", "moment_z_Nm"]


def numbers(first: int, count: int) -> list[float]:
    """Return consecutive numbers, all different within a message."""
    return [float(value) for value in range(first, first + count)]


def named(names: list[str], first: int, prefix: str = "") -> Row:
    """Return consecutive numbers by name."""
    return {prefix + name: float(first + place) for place, name in enumerate(names)}


def common(sender: str, sequence: int) -> dict[str, Any]:
    """Return the fields that every message has, of tick 7."""
    return {"sender": sender, "incarnation": 2, "sequence": sequence, "tick": 7}


def of(message: Message) -> list[Row]:
    """Return the rows of a message, without the columns that it has in common with all others."""
    (rows,) = tables(log_of([message], [3.0]), 0.05).values()
    head = {"t_s": 0.35000000000000003, "received_ns": 3_000_000}
    head |= common(message.sender, message.sequence)
    for row in rows:
        assert {name: row.pop(name) for name in head} == head
    return rows


def measurement(
    payload: int, values: list[list[float]], missing: tuple[int, ...] = ()
) -> Measurement:
    """Return a measurement of UAVs 2 and 4."""
    return Measurement(
        **common("plant", 5), agent=3, answered=(1, 3), shared=(3,), roster=9,
        payload=np.array(numbers(1, payload)), uavs=(2, 4), uav_states=np.array(values),
        inputs=np.array([numbers(201, 4), numbers(205, 4)]), missing=missing,
    )  # fmt: skip


MEASURED = {"agent": 3, "answered": "1 3", "shared": "3", "roster": 9, "seen": ""}


def test_a_measurement_of_states() -> None:
    """A row for each UAV: the payload, its own states, and its commands."""
    rows = of(measurement(12, [numbers(101, 12), numbers(113, 12)]))
    payload = named(PAYLOAD, 1)
    assert rows == [
        MEASURED | payload | {"uav": 2} | named(UAV, 101) | named(COMMANDS, 201),
        MEASURED | payload | {"uav": 4} | named(UAV, 113) | named(COMMANDS, 205),
    ]


def test_a_measurement_of_sensors() -> None:
    """Sensors without a measurement, bits of `missing`, have no columns; nothing of the payload has."""
    # 0b01001: the first, position, and the fourth, body rate. 0b10010: velocity and specific force.
    rows = of(measurement(0, [numbers(101, 15), numbers(116, 15)], (0b01001, 0b10010)))
    second = named(VELOCITY, 104) | named(ATTITUDE, 107) | named(FORCE, 113)
    fourth = named(POSITION, 116) | named(ATTITUDE, 122) | named(RATE, 125)
    assert rows == [
        MEASURED | {"uav": 2} | second | named(COMMANDS, 201),
        MEASURED | {"uav": 4} | fourth | named(COMMANDS, 205),
    ]


def plan(uav_states: list[list[float]]) -> Plan:
    """Return a plan of UAVs 2 and 4 over two steps."""
    return Plan(
        **common("agent3", 6), agent=3, start_tick=8, negotiation=1, shared=True, uavs=(2, 4),
        uav_states=np.array(uav_states), inputs=np.array([numbers(201, 8), numbers(211, 8)]),
        corrections=np.array([numbers(301, 8), numbers(311, 8)]), status="limit", alone=0.25,
        data=np.array([401.0, 402.0]), stale=3, lag=2,
    )  # fmt: skip


PLANNED = {
    "agent": 3, "start_tick": 8, "negotiation": 1, "shared": True, "status": "limit", "alone": 0.25,
    "stale": 3, "targets": "", "lag": 2, "data[0]": 401.0, "data[1]": 402.0,
}  # fmt: skip


def test_a_plan() -> None:
    """A row for each UAV: states, inputs and corrections by step, and the numbers of the sender."""
    rows = of(plan([numbers(101, 12), numbers(113, 12)]))
    inputs_of_uav2 = {
        "thrust_N[0]": 201.0, "thrust_N[1]": 211.0, "moment_x_Nm[0]": 202.0, "moment_x_Nm[1]": 212.0,
        "moment_y_Nm[0]": 203.0, "moment_y_Nm[1]": 213.0, "moment_z_Nm[0]": 204.0, "moment_z_Nm[1]": 214.0,
    }  # fmt: skip
    inputs_of_uav4 = {name: value + 4.0 for name, value in inputs_of_uav2.items()}
    assert rows == [
        PLANNED | {"uav": uav} | named(UAV, first) | inputs
        | {f"correction_{name}": value + 100.0 for name, value in inputs.items()}
        for uav, first, inputs in ((2, 101, inputs_of_uav2), (4, 113, inputs_of_uav4))
    ]  # fmt: skip
    steps = ["thrust_N[0]", "thrust_N[1]", "moment_x_Nm[0]"]
    assert [name for name in columns(rows) if name in steps] == steps


def test_a_plan_reports_its_newest_sensors() -> None:
    """Of four reported ticks the first has columns, and none of it where it is not known."""
    # Of each tick: 1 + bits of the sensors without a measurement, 15 measurements, 4 inputs.
    known = [1.0 + 0b00100, *numbers(101, 15), *numbers(116, 4)]
    older = [1.0, *numbers(501, 19)]
    unknown = [0.0] * 20
    second, fourth = of(plan([known + 3 * older, unknown + 3 * older]))
    names = [*POSITION, *VELOCITY, *ATTITUDE, *RATE, *FORCE]
    seen = named(POSITION, 101) | named(VELOCITY, 104) | named(RATE, 110) | named(FORCE, 113)
    assert {name: second[name] for name in names if name in second} == seen
    assert not {*names, *UAV} & {*fourth}


def test_a_report() -> None:
    """Ages belong to their agents, times to their stages, the force to its axes."""
    report = StepReport(
        **common("agent3", 8), agent=3, status="solved", solver="own", fallback=True, iterations=11,
        residual=0.125, peers=(1, 4), plan_ages=(21, 22), state_ages=(31, 32), measurement_age=41,
        delivered=42, lost=43, late=44, force=np.array([51.0, 52.0, 53.0]),
        times_ms=np.array(numbers(61, 8)), measurements_lost=45,
    )  # fmt: skip
    (row,) = of(report)
    assert row == {
        "agent": 3, "status": "solved", "solver": "own", "fallback": True, "iterations": 11,
        "residual": 0.125, "measurement_age": 41, "delivered": 42, "lost": 43, "late": 44,
        "measurements_lost": 45, "force_x_N": 51.0, "force_y_N": 52.0, "force_z_N": 53.0,
        "wait_ms": 61.0, "estimate_ms": 62.0, "linearise_ms": 63.0, "discretise_ms": 64.0,
        "condense_ms": 65.0, "solve_ms": 66.0, "publish_ms": 67.0, "total_ms": 68.0,
        "plan_age_agent1_ticks": 21, "plan_age_agent4_ticks": 22,
        "state_age_agent1_ticks": 31, "state_age_agent4_ticks": 32,
    }  # fmt: skip


def test_a_plant_state() -> None:
    """One row: the payload, and states, commands and plan of every UAV."""
    state = PlantState(
        **common("plant", 9), x=np.array(numbers(1, 36)), u=np.array(numbers(201, 8)),
        plan_ticks=(6, -2), local_error=0.5, diverged="", plans_lost=4,
    )  # fmt: skip
    (row,) = of(state)
    assert row == (
        {"local_error": 0.5, "diverged": "", "plans_lost": 4}
        | named(PAYLOAD, 1)
        | (named(UAV, 13, "uav1_") | named(COMMANDS, 201, "uav1_") | {"uav1_plan_tick": 6})
        | (named(UAV, 25, "uav2_") | named(COMMANDS, 205, "uav2_") | {"uav2_plan_tick": -2})
    )


@pytest.mark.parametrize("commands", [INPUT_NAMES, ("thrust_N", "a", "b", "c")])
def test_actual_inputs(commands: tuple[str, ...]) -> None:
    """They are thrust and moments whatever is commanded; cables add their tensions."""
    inputs = np.array([numbers(201, 4), numbers(205, 4)])
    hung = ActualInputs(
        **common("plant", 10), uavs=(1, 2), inputs=inputs, cables=(1, 2), tensions=np.array([0.0, 7.5])
    )  # fmt: skip
    rods = ActualInputs(**common("plant", 11), uavs=(1, 2), inputs=inputs)
    first, second = tables(log_of([hung]), 0.05, commands)["actual_inputs"]
    shown = ["uav", *COMMANDS, "tension_N"]
    assert [first[name] for name in shown] == [1, 201.0, 202.0, 203.0, 204.0, 0.0]
    assert [second[name] for name in shown] == [2, 205.0, 206.0, 207.0, 208.0, 7.5]
    assert of(rods) == [{"uav": 1} | named(COMMANDS, 201), {"uav": 2} | named(COMMANDS, 205)]


def test_numbers_of_a_class_do_not_hide_columns() -> None:
    """One with the name of a column is preceded by `own_`, as often as needed; other names stay."""
    note = Note(
        **common("agent3", 12), agent=3, problem="", names=("gain", "tick", "agent"),
        values=np.array([1.0, 2.0, 3.0]),
    )  # fmt: skip
    (row,) = of(note)
    assert row == {"agent": 3, "problem": "", "gain": 1.0, "own_tick": 2.0, "own_agent": 3.0}


def test_only_the_kinds_asked_for_have_tables() -> None:
    """An unknown sampling period leaves the time empty."""
    state = PlantState(
        **common("plant", 9), x=np.array(numbers(1, 36)), u=np.array(numbers(201, 8)),
        plan_ticks=(6, -2), local_error=0.5, diverged="", plans_lost=4,
    )  # fmt: skip
    log = log_of([plan([numbers(101, 12), numbers(113, 12)]), state])
    found = tables(log, None, kinds=["plant_state"])
    assert list(found) == ["plant_state"]
    assert [row["t_s"] for row in found["plant_state"]] == [None]
    assert set(tables(log, 0.05)) == {"plan", "plant_state"}
