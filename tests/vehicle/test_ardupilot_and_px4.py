"""Modes, parameters and health of ArduPilot and PX4, by the numbers of their documentation."""

from collections.abc import Sequence
from types import SimpleNamespace

import pytest

from transport.vehicle.ardupilot_and_px4 import DIALECTS, Parameter

ATTITUDE, VELOCITY, POSITION, CONSTANT_POSITION = 1, 2, 16, 128
ALL = ATTITUDE | VELOCITY | POSITION


@pytest.mark.parametrize(
    ("is_most", "got", "is_met"),
    [
        (False, 8.0, True),
        (False, 8.1, False),
        (False, 8.00001, False),
        (False, None, False),
        (True, 8.0, True),
        (True, 0.1, True),
        (True, 8.1, False),
        (True, 0.0, False),  # no time-out
        (True, None, False),
    ],
)
def test_a_parameter_has_its_value_or_at_most_that(
    is_most: bool, got: float | None, is_met: bool
) -> None:
    """One that is not known yet is not met, and has no value."""
    finding = Parameter(name="P", value=8.0, reason="why", is_most=is_most).finding(got)
    assert finding.is_met == is_met
    assert finding.expected == ("at most 8" if is_most else "8")
    assert finding.got == ("" if got is None else f"{got:g}")


@pytest.mark.parametrize("name", DIALECTS)
def test_an_estimate_is_healthy_with_attitude_velocity_and_position(name: str) -> None:
    """Each of them is needed; ArduPilot's constant position is none."""
    dialect = DIALECTS[name](0.5)
    healthy = [flags for flags in range(256) if dialect.is_healthy(SimpleNamespace(flags=flags))]
    refused = CONSTANT_POSITION if name == "ardupilot" else 0
    assert healthy == [flags for flags in range(256) if flags & ALL == ALL and not flags & refused]


@pytest.mark.parametrize(
    ("name", "guided", "others"),
    [
        ("ardupilot", 4, {0: "STABILIZE", 5: "LOITER", 9: "LAND", 17: "BRAKE", 6: "mode 6"}),
        ("px4", 6 << 16, {4 << 16 | 3 << 24: "HOLD", 4 << 16 | 6 << 24: "LAND", 3 << 16: "POSCTL"}),
    ],
)
def test_one_mode_obeys_setpoints(name: str, guided: int, others: dict[int, str]) -> None:
    """GUIDED or OFFBOARD, by the custom mode of a heartbeat; modes without a name have their number."""
    dialect = DIALECTS[name](0.5)
    assert dialect.is_guided(guided)
    assert dialect.mode_name(guided) in ("GUIDED", "OFFBOARD")
    assert not any(map(dialect.is_guided, others))
    assert {mode: dialect.mode_name(mode) for mode in others} == others


@pytest.mark.parametrize(
    ("name", "modes"),
    [
        ("ardupilot", [(1, 4, 0), (1, 17, 0), (1, 9, 0)]),  # GUIDED, BRAKE, LAND
        ("px4", [(1, 6, 0), (1, 4, 3), (1, 4, 6)]),  # OFFBOARD, AUTO LOITER, AUTO LAND
    ],
)
def test_modes_are_asked_for_by_their_numbers(name: str, modes: Sequence[object]) -> None:
    """Base mode with a custom one, main and sub mode: of setpoints, of holding, of landing."""
    dialect = DIALECTS[name](0.5)
    assert [dialect.guided, dialect.hold, dialect.land] == modes


def test_the_time_out_of_setpoints_is_a_parameter() -> None:
    """At most the one asked for; thrust is linear in what is sent to either."""
    wanted = {
        name: {each.name: (each.value, each.is_most) for each in make(0.4).parameters}
        for name, make in DIALECTS.items()
    }
    assert wanted["ardupilot"]["GUID_TIMEOUT"] == wanted["px4"]["COM_OF_LOSS_T"] == (0.4, True)
    # Thrust curve, no thrust added, full range, no boost with the tilt, no slow jump of the position.
    assert wanted["ardupilot"] == {
        "GUID_OPTIONS": (8, False), "GUID_TIMEOUT": (0.4, True), "MOT_THST_EXPO": (1, False),
        "MOT_SPIN_MIN": (0, False), "MOT_SPIN_MAX": (1, False), "ATC_ANGLE_BOOST": (0, False),
        "EK3_POS_I_GATE": (200, True),
    }  # fmt: skip
    assert wanted["px4"] == {
        "COM_OF_LOSS_T": (0.4, True), "COM_OBL_RC_ACT": (5, False), "THR_MDL_FAC": (1, False),
    }  # fmt: skip


def test_health_and_force_have_their_messages() -> None:
    """Specific force in thousandths of standard gravity or in m/s^2."""
    told = {name: make(0.4) for name, make in DIALECTS.items()}
    assert {name: (one.health, one.imu, one.imu_mps2) for name, one in told.items()} == {
        "ardupilot": ("EKF_STATUS_REPORT", "SCALED_IMU", 9.80665e-3),
        "px4": ("ESTIMATOR_STATUS", "HIGHRES_IMU", 1.0),
    }
