"""Measurements of an autopilot at the ticks: moved on by their age, without jumps of the estimate."""

from typing import Any

import numpy as np
import pytest

from transport.model.state import SENSED
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.vehicle.autopilot import AutopilotState
from transport.vehicle.measurements_at_ticks import TickMeasurements

MS = 10**6
SECTION = VehiclesSection(stale_s=0.3, jump_m=0.5)
PLACE, VELOCITY, RATES = np.array([1.0, 2.0, -3.0]), np.array([0.4, -0.2, 0.1]), [0.1, 0.2, -0.3]


def told(place: Any = PLACE, at_s: float = 0.0, **changes: Any) -> AutopilotState:
    """Return a state that arrived at 0, of a UAV that moves and turns."""
    sensed = np.zeros(SENSED)
    sensed[:3], sensed[3:6], sensed[9:12] = place, VELOCITY, RATES
    state = {
        "sensed": sensed,
        "position_ns": 0,
        "attitude_ns": 0,
        "position_s": at_s,
        "armed": True,
        "takes_setpoints": True,
        "is_healthy": True,
        "battery": 1.0,
        "thrust_N": None,
        "mode": "",
        "says": "",
    }
    return AutopilotState(**{**state, **changes})


@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_place_and_attitude_go_on_from_their_arrival(speed: float) -> None:
    """Each by its own age, in time of the run; one that has arrived after the instant goes back to it."""
    state = told(attitude_ns=150 * MS)
    sensed, age_s = TickMeasurements(SECTION, speed).at(state, 100 * MS)
    assert sensed is not None
    assert age_s == pytest.approx(0.1 * speed)
    np.testing.assert_allclose(sensed[:3], PLACE + 0.1 * speed * VELOCITY)
    np.testing.assert_allclose(sensed[6:9], -0.05 * speed * np.array(RATES))
    assert state.sensed is not None
    np.testing.assert_array_equal(state.sensed[:3], PLACE)  # as the autopilot has told it


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"sensed": None}, "no state from the autopilot"),
        ({"is_healthy": False, "says": "EKF"}, "the autopilot's estimate is not valid: EKF"),
        ({"attitude_ns": -301 * MS}, "state of the autopilot 0.30 s old"),
        ({"position_ns": -301 * MS}, "state of the autopilot 0.30 s old"),
        ({"position_ns": -300 * MS, "attitude_ns": -300 * MS}, ""),
    ],
)
def test_a_state_that_is_not_valid_is_no_measurement(changes: dict[str, Any], problem: str) -> None:
    """The problem says why, until the next valid one."""
    measurements = TickMeasurements(SECTION, 1.0)
    sensed, _ = measurements.at(told(**changes), 0)
    assert (sensed is None, measurements.problem) == (bool(problem), problem)
    sensed, _ = measurements.at(told(at_s=0.1, place=PLACE + 0.1 * VELOCITY), 0)
    assert sensed is not None
    assert measurements.problem == ""


def test_jumps_are_taken_out_of_all_positions_after_them() -> None:
    """What is beyond the motion by more than `jump_m`; a jump back ends the shift, a silence is none."""
    measurements = TickMeasurements(SECTION, 1.0)
    off = np.zeros(3)
    found = []
    # Time by the autopilot's clock, and how far its place has jumped since the last one.
    for at_s, jump_m in [
        (0.0, 0.0),
        (0.1, 0.45),
        (0.2, 0.55),
        (0.3, 0.0),
        (0.6, -0.55),
        (1.0, 0.7),
    ]:
        off = off + np.array([0.0, jump_m, 0.0])
        place = PLACE + at_s * VELOCITY + off
        sensed, _ = measurements.at(told(place, at_s), 0)
        assert sensed is not None
        np.testing.assert_allclose(sensed[:3], place + measurements.shift_I)
        found.append(-measurements.shift_I[1])
    np.testing.assert_allclose(found, [0.0, 0.0, 0.55, 0.55, 0.0, 0.0], atol=1e-12)
    measurements.at(told(PLACE + off + 1.1 * VELOCITY + [3.0, 0.0, 4.0], 1.1), 0)
    assert measurements.problem == "the autopilot's position has jumped by 5.0 m"
