"""Single sensors of UAVs that fail (docs/record/guarantees.md, "Sensors that fail")."""

import numpy as np
import pytest

from tests.support.logs import log_of
from tests.support.runs import SHORT, VEHICLE, completed, plant_states, ready, setup
from transport.analysis.events import events
from transport.analysis.series import series_of
from transport.log.tables import tables
from transport.model import state
from transport.protocol.wire.messages import Measurement, Message, Note, Plan

OFF, ON = 10, 20  # ticks
TEAM = (1, 2, 3, 4)
LEG = (
    "maneuver.phase=[{name='hover',duration_s=1.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=5.0,displacement_m=[0,0,-2.5]},"
    "{name='hover',duration_s=2.0,displacement_m=[0,0,0]}]"
)
POSITION, SPECIFIC_FORCE = 1, 16  # bits of `model.state.SENSORS`


def off(uavs: tuple[int, ...], sensors: str, at_s: float, duration_s: float | None) -> str:
    """Return the setting of an outage of sensors, for good without a duration."""
    lasting = "" if duration_s is None else f",duration_s={duration_s}"
    outages = [
        f"{{at_s={at_s},do='sensors_off',target='uav{uav}',sensors=[{sensors}]{lasting}}}"
        for uav in uavs
    ]
    return f"faults.event=[{','.join(outages)}]"


def of_uav_2(messages: list[Message]) -> list[Measurement]:
    """Return the measurements of UAV 2, in the order of ticks."""
    measured = [one for one in messages if isinstance(one, Measurement) and one.agent == 2]
    return sorted(measured, key=lambda one: one.tick)


def test_missing_measurements_are_told_and_not_used() -> None:
    """A measurement names the sensors without one, the plans of the next ticks too, and no number is made up.

    The filters take none of the zeros for a position ten metres away: none is denied, and the payload
    is where it is in the run with all sensors.
    """
    whole = completed(setup(SHORT, *VEHICLE))
    run = setup(SHORT, *VEHICLE, off((2,), "'position','specific_force'", 0.05 * OFF, 0.5))
    messages = completed(run)

    measured = of_uav_2(messages)
    bits = [one.missing for one in measured]
    assert bits == [(POSITION + SPECIFIC_FORCE,) if OFF <= k < ON else () for k in range(run.ticks)]
    at_once, of_whole = measured[OFF].uav_states[0], of_uav_2(whole)[OFF].uav_states[0]
    assert not at_once[state.POSITION].any()
    assert not at_once[state.SPECIFIC_FORCE].any()
    np.testing.assert_array_equal(at_once[3:12], of_whole[3:12])

    (plan,) = (p for p in messages if isinstance(p, Plan) and (p.agent, p.tick) == (2, ON))
    newest_first = plan.uav_states.reshape(state.REPORTS, state.REPORTED)[:, state.IS_KNOWN]
    assert newest_first.tolist() == [1.0, 18.0, 18.0, 18.0]

    assert not [note.problem for note in messages if isinstance(note, Note) and note.problem]
    paths = [np.array([one.x for one in plant_states(of)]) for of in (messages, whole)]
    np.testing.assert_array_equal(paths[0][: OFF + 1], paths[1][: OFF + 1])
    assert np.linalg.norm((paths[0] - paths[1])[:, state.R0], axis=1).max() < 0.01


def test_an_outage_is_in_summary_and_tables() -> None:
    """Begin and end are faults by script, and the tables have empty cells."""
    run = setup(SHORT, *VEHICLE, off((2,), "'position'", 0.05 * OFF, 0.5))
    log = log_of(completed(run))
    told = [(one["tick"], one["what"], one["processes"]) for one in events(run, log, None)]
    assert told == [
        (OFF, "uav2 without position by script", ["uav2"]),
        (ON, "uav2 has position again by script", ["uav2"]),
    ]
    rows = tables(log, 0.05, kinds=("measurement", "plan"))
    cells = {kind: {row["tick"]: row for row in rows[kind] if row["uav"] == 2} for kind in rows}
    for kind in ("measurement", "plan"):
        assert "r_x_m" not in cells[kind][OFF]
        assert "v_x_m_s" in cells[kind][OFF]
        assert "r_x_m" in cells[kind][ON]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("uavs", "sensors", "duration_s", "most_deg"),
    [
        ((2,), "'position'", 5.0, 2.0),
        (TEAM, "'position'", 3.0, 3.0),
        ((2,), "'position','velocity'", None, 6.0),
    ],
)
def test_the_others_tell_where_a_uav_is(
    uavs: tuple[int, ...], sensors: str, duration_s: float | None, most_deg: float
) -> None:
    """`precise` with a filter completes, about as near to its path as with all sensors (2.2 cm rms).

    Attitudes are those of the sensors, and with the velocity lost twice as many degrees.
    """
    run = ready("precise", *VEHICLE, LEG, off(uavs, sensors, 2.5, duration_s))
    series = series_of(run, log_of(completed(run)))
    errors_m = np.linalg.norm(series.payload_error_I, axis=1)
    assert np.sqrt(np.mean(errors_m**2)) < 0.03
    assert series.attitude_max_deg.max() < most_deg


def test_uavs_alone_go_on_by_dead_reckoning() -> None:
    """The controller `alone`, whose UAVs hear of no other, keeps a UAV without position on its path: (31i)."""
    sensed = (SHORT, *VEHICLE)
    run = ready("alone", *sensed, off((2,), "'position'", 0.25, None))
    series = series_of(run, log_of(completed(run)))
    whole = series_of(run, log_of(completed(ready("alone", *sensed))))
    difference_m = np.linalg.norm(series.payload_error_I - whole.payload_error_I, axis=1)
    assert 0.0 < difference_m.max() < 0.03
