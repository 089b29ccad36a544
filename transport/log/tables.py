"""Messages as one table per kind.

Arrays are flattened into columns whose names end in their units.
"""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np

from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.model.state import (
    ALL_SENSORS,
    INPUTS,
    IS_KNOWN,
    PAYLOAD,
    PER_UAV,
    SENSED,
    SENSED_VALUES,
    is_measured,
)
from transport.protocol.wire.messages import (
    KINDS,
    STAGES,
    ActualInputs,
    Measurement,
    Message,
    Note,
    Plan,
    PlantState,
    StepReport,
)

Row = dict[str, Any]

_AXES = 3  # numbers of each of `model.state.SENSORS`

# Names of the entries of states and inputs, each ending in its unit, in the order of `model.state`.
PAYLOAD_NAMES = (
    *("r0_x_m", "r0_y_m", "r0_z_m"),
    *("v0_x_m_s", "v0_y_m_s", "v0_z_m_s"),
    *("roll_rad", "pitch_rad", "yaw_rad"),
    *("omega0_x_rad_s", "omega0_y_rad_s", "omega0_z_rad_s"),
)
UAV_STATE_NAMES = (
    *("e_x", "e_y", "e_z"),
    *("Omega_x_rad_s", "Omega_y_rad_s", "Omega_z_rad_s"),
    *("roll_rad", "pitch_rad", "yaw_rad"),
    *("omega_x_rad_s", "omega_y_rad_s", "omega_z_rad_s"),
)
SENSED_NAMES = (
    *("r_x_m", "r_y_m", "r_z_m"),
    *("v_x_m_s", "v_y_m_s", "v_z_m_s"),
    *UAV_STATE_NAMES[6:],
    *("specific_force_x_m_s2", "specific_force_y_m_s2", "specific_force_z_m_s2"),
)
INPUT_NAMES = ("thrust_N", "moment_x_Nm", "moment_y_Nm", "moment_z_Nm")
RATE_NAMES = ("thrust_N", "rate_x_rad_s", "rate_y_rad_s", "rate_z_rad_s")

# Fields that `_spread` writes to columns or rows of their own, by kind of message.
_SPREAD: Mapping[str, Collection[str]] = {
    Measurement.kind: ("payload", "uavs", "uav_states", "inputs", "missing"),
    Plan.kind: ("uavs", "uav_states", "inputs", "corrections", "data"),
    StepReport.kind: ("peers", "plan_ages", "state_ages", "force", "times_ms"),
    Note.kind: ("names", "values"),
    PlantState.kind: ("x", "u", "plan_ticks"),
    ActualInputs.kind: ("uavs", "inputs", "cables", "tensions"),
}


def tables(
    log: RunLog,
    period_s: float | None,
    commands: tuple[str, ...] = INPUT_NAMES,
    kinds: Collection[str] = KINDS,
) -> dict[str, list[Row]]:
    """Return the messages of a log by kind, each row as values by column (docs/log.md).

    Measurements, plans and actual inputs have one row per UAV, other messages one row. Ids and other
    arrays become text with blanks in between. A number of the user's class whose name is that of
    another column is preceded by `own_`.

    Args:
        log: The log.
        period_s: Sampling period, s; an unknown one leaves `t_s` empty.
        commands: Names of the commands.
        kinds: Kinds of messages.
    """
    rows_by_kind: dict[str, list[Row]] = {kind: [] for kind in KINDS}
    for entry in log.messages:
        message = entry.message
        if message.kind not in kinds:
            continue
        row: Row = {
            "tick": message.tick,
            "t_s": None if period_s is None else message.tick * period_s,
            "received_ns": entry.received_ns,
            "sender": message.sender,
            "incarnation": message.incarnation,
            "sequence": message.sequence,
        }

        spread_fields = _SPREAD.get(message.kind, ())
        for name in message.__struct_fields__:
            if name not in row and name not in spread_fields:
                row[name] = _cell(getattr(message, name))

        rows_by_kind[message.kind] += [
            _beside(row, spread) for spread in _spread(message, commands)
        ]
    return {kind: rows for kind, rows in rows_by_kind.items() if rows}


def _beside(row: Row, spread: Row) -> Row:
    """Return a row with further columns; `own_` precedes names that are there already."""
    whole = dict(row)
    for name, value in spread.items():
        while name in whole:
            name = f"own_{name}"
        whole[name] = value
    return whole


def _cell(value: Any) -> Any:
    """Return a field as a cell; ids and arrays, row by row, are text with blanks in between.

    Bytes are hexadecimal.
    """
    if isinstance(value, np.ndarray):
        return " ".join(map(repr, value.ravel().tolist()))  # reads back as the same bits
    if isinstance(value, tuple):
        return " ".join(one.hex() if isinstance(one, bytes) else str(one) for one in value)
    return value


def columns(rows: list[Row]) -> list[str]:
    """Return the columns of a table in the order of their first appearance."""
    return list(dict.fromkeys(name for row in rows for name in row))


def _spread(message: Message, commands: tuple[str, ...]) -> Iterator[Row]:
    """Yield the columns of the array fields: once, or once per UAV of the message."""
    match message:
        case Measurement():
            yield from _measured(message, commands)
        case Plan():
            yield from _planned(message, commands)
        case StepReport():
            yield _reported(message)
        case Note():
            yield _named("", message.names, message.values)
        case PlantState():
            yield _simulated(message, commands)
        case ActualInputs():
            yield from _actual(message)
        case _:
            yield {}


def _measured(message: Measurement, commands: tuple[str, ...]) -> Iterator[Row]:
    """Yield the payload with states and inputs of each UAV."""
    payload = _named("payload_", PAYLOAD_NAMES[: len(message.payload)], message.payload)
    missing = message.missing or (0,) * len(message.uavs)
    uavs = zip(message.uavs, message.uav_states, message.inputs, missing, strict=True)

    for uav, states, inputs, sensors in uavs:
        measured = _uav_columns(states, sensors)
        yield {"uav": uav, **payload, **measured, **_named("", commands, inputs)}


def _planned(message: Plan, commands: tuple[str, ...]) -> Iterator[Row]:
    """Yield states of each UAV with its inputs and corrections over the horizon, and own data."""
    data = {f"data[{place}]": float(value) for place, value in enumerate(message.data)}
    for i, (uav, states) in enumerate(zip(message.uavs, message.uav_states, strict=True)):
        own = slice(INPUTS * i, INPUTS * (i + 1))
        inputs = _over_horizon("", commands, message.inputs[:, own])
        corrections = _over_horizon("correction_", commands, message.corrections[:, own])
        yield {"uav": uav, **_uav_columns(states), **inputs, **corrections, **data}


def _reported(message: StepReport) -> Row:
    """Return force, times and ages of a step."""
    row = _named("force_", ("x_N", "y_N", "z_N"), message.force)
    row |= _named("", tuple(f"{stage}_ms" for stage in STAGES), message.times_ms)

    ages = zip(message.peers, message.plan_ages, message.state_ages, strict=True)
    for peer, plan_age, state_age in ages:
        row[f"plan_age_agent{peer}_ticks"] = plan_age
        row[f"state_age_agent{peer}_ticks"] = state_age
    return row


def _simulated(message: PlantState, commands: tuple[str, ...]) -> Row:
    """Return the state of the payload, and state, inputs and plan of every UAV."""
    row = _named("payload_", PAYLOAD_NAMES, message.x[:PAYLOAD])
    for i, plan_tick in enumerate(message.plan_ticks):
        prefix = f"uav{i + 1}_"
        begin = PAYLOAD + PER_UAV * i
        row |= _named(prefix, UAV_STATE_NAMES, message.x[begin : begin + PER_UAV])
        row |= _named(prefix, commands, message.u[INPUTS * i : INPUTS * (i + 1)])
        row[f"{prefix}plan_tick"] = plan_tick
    return row


def _actual(message: ActualInputs) -> Iterator[Row]:
    """Yield the inputs of each UAV, with cables also their tension: all UAVs have one, or none."""
    for i, (uav, inputs) in enumerate(zip(message.uavs, message.inputs, strict=True)):
        tension = {"tension_N": float(message.tensions[i])} if message.cables else {}
        yield {"uav": uav, **_named("", INPUT_NAMES, inputs), **tension}


def _uav_columns(values: Array, missing: int = 0) -> Row:
    """Return the states of a UAV, or the newest values of its sensors in a message.

    Sensors without a measurement, bits of `missing`, have no columns.

    The length tells which: (PER_UAV,) are states, (SENSED,) measurements; a longer array has the
    rows of the last ticks that a plan reports (`model.state.REPORTED`), the newest first. Only that
    one has columns; none where it is not known.
    """
    if len(values) == PER_UAV:
        return _named("", UAV_STATE_NAMES, values)
    if len(values) != SENSED:
        known = int(values[IS_KNOWN])
        missing = known - 1 if known > 0 else ALL_SENSORS
        values = values[SENSED_VALUES]
    sensed = _named("", SENSED_NAMES, values)
    return {
        name: value
        for place, (name, value) in enumerate(sensed.items())
        if is_measured(place // _AXES, missing)
    }


def _named(prefix: str, names: tuple[str, ...], values: Array) -> Row:
    """Return values by name, all with a prefix."""
    return {prefix + name: float(value) for name, value in zip(names, values, strict=True)}


def _over_horizon(prefix: str, commands: tuple[str, ...], sequence: Array) -> Row:
    """Return the inputs of one UAV over the horizon, (steps, 4).

    They are sorted by quantity: thrust_N[0], thrust_N[1], ...
    """
    return {
        f"{prefix}{name}[{step}]": float(value)
        for name, values in zip(commands, sequence.T, strict=True)
        for step, value in enumerate(values)
    }
