"""What ArduPilot and PX4 do differently with the same messages: modes, parameters, health; and the throttle of both.

ArduCopter 4.7-dev has been flown in the loop (docs/flight.md); PX4 follows its documentation.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from transport.vehicle.autopilot import Finding

# Bits of EKF_STATUS_REPORT and ESTIMATOR_STATUS: attitude, horizontal velocity and position.
_ATTITUDE, _VELOCITY, _POSITION = 1, 2, 16
_CONSTANT_POSITION = 128


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """A parameter of an autopilot: the value that it must have, or at most have, and why."""

    name: str
    value: float
    reason: str
    is_most: bool = False  # smaller values above zero serve as well

    def finding(self, got: float | None) -> Finding:
        """Return the check of a value; None: not known yet."""
        is_met = got is not None and abs(got - self.value) <= 1e-6 * max(1.0, abs(self.value))
        if self.is_most and got is not None:
            is_met = 0.0 < got <= self.value
        return Finding(
            subject=self.name,
            expected=f"{'at most ' if self.is_most else ''}{self.value:g}",
            got="" if got is None else f"{got:g}",
            is_met=is_met,
            reason=self.reason,
        )


# With the parameters below, the throttle of a message is a force as a share of the largest one: the
# autopilot itself takes the root for its outputs.


def throttle_of(thrust_N: float, largest_N: float) -> float:
    """Return the throttle of a setpoint, 0 to 1, with which a vehicle makes a thrust."""
    return min(max(thrust_N / largest_N, 0.0), 1.0)


def thrust_of(throttle: float, largest_N: float) -> float:
    """Return the thrust of a throttle that an autopilot tells, N."""
    return throttle * largest_N


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """One autopilot's use of MAVLink.

    Attributes:
        name: Name on the command line.
        parameters: Those that this project depends on, whatever the vehicle.
        guided, hold, land: Modes as base and custom mode of SET_MODE's command.
        health: Message that tells the health of the estimate.
        is_healthy: Whether that message says that attitude, velocity and position are valid.
        imu: Message with the specific force, and its unit, m/s^2.
    """

    name: str
    parameters: tuple[Parameter, ...]
    guided: tuple[int, int, int]
    hold: tuple[int, int, int]
    land: tuple[int, int, int]
    custom_of: Callable[[int, int], int]
    modes: Mapping[int, str]
    health: str
    is_healthy: Callable[[Any], bool]
    imu: str
    imu_mps2: float

    def is_guided(self, custom_mode: int) -> bool:
        """Return whether a mode is the one that obeys setpoints."""
        return custom_mode == self.custom_of(*self.guided[1:])

    def mode_name(self, custom_mode: int) -> str:
        """Return the name of a mode."""
        return self.modes.get(custom_mode, f"mode {custom_mode}")


def _ekf_is_healthy(message: Any) -> bool:
    needed = _ATTITUDE | _VELOCITY | _POSITION
    return message.flags & needed == needed and not message.flags & _CONSTANT_POSITION


def _estimator_is_healthy(message: Any) -> bool:
    needed = _ATTITUDE | _VELOCITY | _POSITION
    return bool(message.flags & needed == needed)


def _px4_mode(main: int, sub: int) -> int:
    return main << 16 | sub << 24


def ardupilot(setpoint_timeout_s: float) -> Dialect:
    """Return the dialect of ArduCopter 4.5 or newer; setpoints end after a time, s."""
    return Dialect(
        name="ardupilot",
        parameters=(
            Parameter(name="GUID_OPTIONS", value=8, reason="thrust of a setpoint is thrust"),
            Parameter(
                name="GUID_TIMEOUT",
                value=setpoint_timeout_s,
                reason="levels soon after the last setpoint",
                is_most=True,
            ),
            Parameter(name="MOT_THST_EXPO", value=1, reason="thrust follows the squared output"),
            Parameter(name="MOT_SPIN_MIN", value=0, reason="no thrust is added to a setpoint's"),
            Parameter(name="MOT_SPIN_MAX", value=1, reason="full throttle is the largest thrust"),
            Parameter(name="ATC_ANGLE_BOOST", value=0, reason="thrust is not raised with the tilt"),
            Parameter(
                name="EK3_POS_I_GATE",
                value=200,
                reason="a sudden shift of the satellite position is refused, not blended in",
                is_most=True,
            ),
        ),
        guided=(1, 4, 0),
        hold=(1, 17, 0),
        land=(1, 9, 0),
        custom_of=lambda main, _: main,
        modes={0: "STABILIZE", 4: "GUIDED", 5: "LOITER", 9: "LAND", 17: "BRAKE"},
        health="EKF_STATUS_REPORT",
        is_healthy=_ekf_is_healthy,
        imu="SCALED_IMU",
        imu_mps2=9.80665e-3,  # thousandths of standard gravity
    )


def px4(setpoint_timeout_s: float) -> Dialect:
    """Return the dialect of PX4 1.14 or newer, by its documentation."""
    return Dialect(
        name="px4",
        parameters=(
            Parameter(
                name="COM_OF_LOSS_T",
                value=setpoint_timeout_s,
                reason="leaves offboard soon after the last setpoint",
                is_most=True,
            ),
            Parameter(name="COM_OBL_RC_ACT", value=5, reason="then holds its place"),
            Parameter(name="THR_MDL_FAC", value=1, reason="thrust follows the squared output"),
        ),
        guided=(1, 6, 0),
        hold=(1, 4, 3),
        land=(1, 4, 6),
        custom_of=_px4_mode,
        modes={
            _px4_mode(6, 0): "OFFBOARD",
            _px4_mode(4, 3): "HOLD",
            _px4_mode(4, 6): "LAND",
            _px4_mode(3, 0): "POSCTL",
        },
        health="ESTIMATOR_STATUS",
        is_healthy=_estimator_is_healthy,
        imu="HIGHRES_IMU",
        imu_mps2=1.0,
    )


DIALECTS = {"ardupilot": ardupilot, "px4": px4}
