"""Driver of Betaflight: rates and thrust as channels of its receiver, by MSP; its place by motion capture.

The firmware has no estimate of its place, so a motion capture tells position, velocity and attitude, as MAVLink
ODOMETRY in the common frame; gyroscope and accelerometer are its own. It cannot hover by itself: the UAV
stands until tick 0, and after its release, or without setpoints, the firmware's own fail-safe levels it and sinks.

    MSP_RAW_IMU, MSP_STATUS_EX    from the firmware: measurements; armed, and why not
    MSP_SET_RAW_RC                to it: roll, pitch, throttle, yaw, AUX1, which arms
"""

import math
import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.protocol.network.mavlink import MavlinkLink
from transport.vehicle.autopilot import AutopilotState, Finding
from transport.vehicle.msp import MspLink

_RC_TUNING, _RX_CONFIG, _FAILSAFE, _ADVANCED = 111, 44, 75, 90
_STATUS_EX, _RAW_IMU, _SET_RAW_RC = 150, 102, 200
_SETTINGS = (_RC_TUNING, _RX_CONFIG, _FAILSAFE, _ADVANCED)
# Requests a second; settings until they are known.
_RATES_HZ = {_RAW_IMU: 100.0, _STATUS_EX: 10.0, **dict.fromkeys(_SETTINGS, 2.0)}
_WAIT_S = 0.005  # of the threads
_SILENT_NS = 2_000_000_000
_IDLE_NS = 20_000_000  # between two frames of a receiver that does not fly
# Channels: ends and middle, us. The throttle is raised by what the firmware truncates on the way
# to the outputs (`plant.firmware.betaflight`).
_LOW_US, _MIDDLE_US, _HIGH_US = 1000, 1500, 2000
_TRUNCATED_US = 1.9
_ACTUAL = 3  # type of rates whose largest one is the setting times this unit
_RATE_UNIT_DEG_S = 10.0
_ROUNDING = 1e-6  # of limits in the units of settings
_AUTO_LANDING = 0  # procedure of the fail-safe
_UNARMED_HELD_NS = 500_000_000  # of a low switch, before it arms
_GRAVITY = 9.80665
# Unit of the gyroscope's reading: full scale of 2000 deg/s (`gyro_high_fsr` off).
_GYRO_RADS = math.radians(2000.0 / 32768.0)
_READINGS = (256.0, 512.0, 1024.0, 2048.0, 4096.0)  # of accelerometers for 1 g
# Reasons against arming, by their bits (the firmware's fc/runtime_config.h).
_FLAGS = (
    *("no gyro", "failsafe", "receiver lost", "not disarmed", "failsafe switch", "runaway"),
    *("crash", "throttle", "angle", "boot grace", "no prearm", "load", "calibrating", "CLI", "CMS"),
    *("BST", "MSP", "paralyzed", "GPS", "rescue switch", "DSHOT telemetry", "reboot required"),
    *("DSHOT bitbang", "accelerometer", "motor protocol", "crash flip", "altitude hold"),
    *("position hold", "arm switch"),
)
_FAILED_RECEIVER = 0b110  # failsafe, receiver lost


@dataclass(frozen=True, slots=True, kw_only=True)
class BetaflightSettings:
    """Numbers of one vehicle.

    Attributes:
        thrust_N: Thrust at full throttle.
        rates_rads: Largest rates that are commanded, (3,).
        setpoint_timeout_s: Time without setpoints after which the firmware levels.
    """

    thrust_N: float
    rates_rads: Sequence[float]
    setpoint_timeout_s: float


class BetaflightAutopilot:
    """One Betaflight and its motion capture; an `Autopilot`."""

    tells_thrust = False

    def __init__(self, link: MspLink, pose: MavlinkLink, settings: BetaflightSettings) -> None:
        self._link = link
        self._pose = pose
        self._settings = settings
        self._lock = threading.Lock()
        self._answers: dict[int, tuple[bytes, int]] = {}  # by command, with the time of arrival, ns
        self._odometry: tuple[Any, int] | None = None
        self._unit = 0.0  # reading of the accelerometer for 1 g; 0 before one has come
        self._wants_to_arm = False
        self._low_since_ns = 0  # when the switch was low, with nothing against arming
        self._has_flown = False  # whether setpoints have been sent: no frame goes without one then
        self._is_released = False
        self._idle_ns = 0
        self._is_closed = False
        self._threads = [
            threading.Thread(target=target, name=name, daemon=True)
            for name, target in (("msp", self._talk), ("pose", self._hear))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the threads and close the links."""
        self._is_closed = True
        for thread in self._threads:
            thread.join()
        self._link.close()
        self._pose.close()

    # What comes

    def _talk(self) -> None:
        """Ask for what is due, and keep the newest answers, on a thread."""
        due_s = dict.fromkeys(_RATES_HZ, 0.0)
        while not self._is_closed:
            now_s = time.monotonic()
            for command, hz in _RATES_HZ.items():
                is_known = command in _SETTINGS and command in self._answers
                if now_s >= due_s[command] and not is_known:
                    due_s[command] = now_s + 1.0 / hz
                    self._link.send(command)
            for command, payload in self._link.receive(_WAIT_S):
                with self._lock:
                    self._answers[command] = payload, time.monotonic_ns()

    def _hear(self) -> None:
        """Keep the newest pose, on a thread."""
        while not self._is_closed:
            for message in self._pose.receive(10 * _WAIT_S):
                if message.get_type() == "ODOMETRY":
                    with self._lock:
                        self._odometry = message, time.monotonic_ns()

    def silence(self) -> str:
        """Return in words that it has not been heard."""
        return "no sign of life from the autopilot"

    def state(self) -> AutopilotState | None:
        """Return what firmware and motion capture have told."""
        with self._lock:
            status, status_ns = self._answers.get(_STATUS_EX, (b"", 0))
            imu, imu_ns = self._answers.get(_RAW_IMU, (b"", 0))
            odometry = self._odometry
        if not status or time.monotonic_ns() > max(status_ns, imu_ns) + _SILENT_NS:
            return None
        armed, flags = _armed_and_flags(status)
        sensed = None
        if odometry is not None and imu:
            self._unit = self._unit or _unit_of(imu)
            sensed = _sensed(odometry[0], imu, self._unit)
        reasons = [name for bit, name in enumerate(_FLAGS) if flags >> bit & 1]
        pose, pose_ns = odometry or (None, 0)
        return AutopilotState(
            sensed=sensed,
            position_ns=pose_ns,
            attitude_ns=min(pose_ns, imu_ns),
            position_s=0.0 if pose is None else pose.time_usec / 1e6,
            armed=armed,
            takes_setpoints=not flags & _FAILED_RECEIVER,
            is_healthy=sensed is not None,
            battery=-1.0,
            thrust_N=None,
            mode="armed" if armed else "not armed",
            says=", ".join(reasons),
        )

    def findings(self) -> Sequence[Finding]:
        """Return the checks of the settings on which channels and fail-safe depend."""
        with self._lock:
            answers = {command: self._answers.get(command, (b"", 0))[0] for command in _SETTINGS}
        rates = answers[_RC_TUNING]
        failsafe = answers[_FAILSAFE]
        motors = answers[_ADVANCED]
        least_deg_s = np.degrees(self._settings.rates_rads)
        most_tenths = 10.0 * self._settings.setpoint_timeout_s
        is_known = bool(answers[_RX_CONFIG] and motors)
        return [
            _finding(
                "rates",
                f"ACTUAL, linear, at least {_by_axis(least_deg_s)}",
                _rates_fit(rates, least_deg_s) if rates else None,
                "channels are body rates",
            ),
            _finding(
                "throttle",
                "no expo, no limit",
                _throttle_fits(rates) if rates else None,
                "thrust follows the channel",
            ),
            _finding(
                "failsafe_procedure",
                "AUTO-LAND",
                _procedure_fits(failsafe) if failsafe else None,
                "it levels without setpoints",
            ),
            _finding(
                "failsafe_delay",
                f"at most {most_tenths:.0f}",
                _delay_fits(failsafe, most_tenths) if failsafe else None,
                "tenths of a second until then",
            ),
            _finding(
                "gyro_high_fsr",
                "OFF",
                _gyro_fits(motors) if motors else None,
                "unit of the body rates",
            ),
            _finding(
                "min_check, motor_idle",
                "known",
                (True, "known") if is_known else None,
                "thrust of the throttle's channel",
            ),
        ]

    # What goes

    def attend(self, now_ns: int) -> None:
        """Be a receiver with a low throttle until the first setpoint, so that the firmware may arm."""
        state = self.state()
        is_flying = self._has_flown or (state is not None and state.armed)
        if state is None or is_flying or now_ns < self._idle_ns:
            return
        self._idle_ns = now_ns + _IDLE_NS
        with self._lock:
            _, flags = _armed_and_flags(self._answers[_STATUS_EX][0])
        if flags:  # also of the switch itself, which has to be low first
            self._low_since_ns = now_ns
        is_on = self._wants_to_arm and now_ns > self._low_since_ns + _UNARMED_HELD_NS
        self._send_channels(_LOW_US, (0.0, 0.0, 0.0), is_on=is_on)

    def command(self, thrust_N: float, rates_rads: Array, since_s: float) -> None:  # noqa: ARG002
        """Send thrust and body rates as channels: the output of a rotor is the root of its share of thrust."""
        if self._is_released:
            return
        with self._lock:
            receiver, motors = (
                self._answers.get(kind, (b"", 0))[0] for kind in (_RX_CONFIG, _ADVANCED)
            )
            tuning = self._answers.get(_RC_TUNING, (b"", 0))[0]
        if not (receiver and motors and tuning):
            return
        self._has_flown = True
        least_us = struct.unpack_from("<H", receiver, 5)[0]
        idle = struct.unpack_from("<H", motors, 6)[0] * 1e-4
        output = math.sqrt(min(max(thrust_N / self._settings.thrust_N, 0.0), 1.0))
        above = max((output - idle) / (1.0 - idle), 0.0)
        throttle_us = least_us + (_HIGH_US - least_us) * above + _TRUNCATED_US
        shares = np.clip(np.degrees(rates_rads) / _largest_deg_s(tuning), -1.0, 1.0)
        self._send_channels(throttle_us, shares.tolist(), is_on=True)

    def _send_channels(self, throttle_us: float, shares: Sequence[float], *, is_on: bool) -> None:
        """Send roll, pitch, throttle, yaw and the switch that arms; a pitch stick forward is nose down."""
        roll, pitch, yaw = shares
        span_us = _HIGH_US - _MIDDLE_US
        channels = (
            _MIDDLE_US + span_us * roll,
            _MIDDLE_US - span_us * pitch,
            min(throttle_us, _HIGH_US),
            _MIDDLE_US + span_us * yaw,
            _HIGH_US if is_on else _LOW_US,
            *[_LOW_US] * 3,
        )
        self._link.send(_SET_RAW_RC, struct.pack("<8H", *(round(value) for value in channels)))

    def arm(self) -> None:
        """Ask it to arm, once nothing is against it."""
        self._wants_to_arm = True

    def hold(self) -> None:
        """Leave the UAV to the firmware's fail-safe: it has no place to hold."""
        self._is_released = True

    def land(self) -> None:
        """Leave the UAV to the firmware's fail-safe, which levels it and sinks."""
        self._is_released = True


def _armed_and_flags(status: bytes) -> tuple[bool, int]:
    """Return whether the motors run, and the reasons against arming, bit by bit."""
    modes = struct.unpack_from("<I", status, 6)[0]
    further = status[15] & 0x0F
    flags: int = struct.unpack_from("<I", status, 17 + further)[0]
    return bool(modes & 1), flags


def _finding(subject: str, expected: str, judged: tuple[bool, str] | None, reason: str) -> Finding:
    """Return a check of the settings: whether they fit, and they in words; None before they are known."""
    is_met, got = judged or (False, "")
    return Finding(subject=subject, expected=expected, got=got, is_met=is_met, reason=reason)


# Answers to MSP requests, by the bytes of the firmware's msp/msp.c.


def _throttle_fits(rc_tuning: bytes) -> tuple[bool, str]:
    """Return whether the throttle is passed on as it comes, and its settings in words."""
    expo = rc_tuning[7]
    limit = rc_tuning[14]  # type of the limit, 0 for none
    return expo == 0 and limit == 0, f"expo {expo}, limit {limit}"


def _procedure_fits(failsafe: bytes) -> tuple[bool, str]:
    """Return whether the fail-safe levels and lands, and its procedure by name."""
    procedure = failsafe[7]
    return procedure == _AUTO_LANDING, ("AUTO-LAND", "DROP", "GPS-RESCUE")[procedure]


def _delay_fits(failsafe: bytes, most_tenths: float) -> tuple[bool, str]:
    """Return whether the fail-safe begins in time, and its delay in words; tenths of a second."""
    delay = failsafe[0]
    return delay <= most_tenths + _ROUNDING, str(delay)


def _gyro_fits(advanced: bytes) -> tuple[bool, str]:
    """Return whether the gyroscope has the full scale of 2000 deg/s, and `gyro_high_fsr` in words."""
    is_high = advanced[11] != 0
    return not is_high, "ON" if is_high else "OFF"


def _largest_deg_s(rc_tuning: bytes) -> Array:
    """Return the rates of full sticks about roll, pitch and yaw, (3,)."""
    return _RATE_UNIT_DEG_S * np.array([rc_tuning[2], rc_tuning[3], rc_tuning[4]])


def _rates_fit(rc_tuning: bytes, least_deg_s: Array) -> tuple[bool, str]:
    """Return whether full sticks are body rates, linear and large enough about each axis; and the rates in words."""
    centre = rc_tuning[0], rc_tuning[12], rc_tuning[11]
    most = rc_tuning[2], rc_tuning[3], rc_tuning[4]
    expo = rc_tuning[1], rc_tuning[13], rc_tuning[10]
    kind = rc_tuning[22]
    largest_deg_s = _largest_deg_s(rc_tuning)
    is_linear = centre == most and not any(expo)
    are_enough = bool((largest_deg_s >= least_deg_s - _ROUNDING).all())
    linear = "linear" if is_linear else "not linear"
    got = f"type {kind}, {linear}, {_by_axis(largest_deg_s)}"
    return kind == _ACTUAL and is_linear and are_enough, got


def _by_axis(deg_s: Array) -> str:
    """Return rates about roll, pitch and yaw in words."""
    return "{:.0f}, {:.0f}, {:.0f} deg/s".format(*deg_s)


def _unit_of(imu: bytes) -> float:
    """Return the reading of an accelerometer for 1 g, by one at rest or in a hover: it differs between sensors."""
    reading = max(float(np.linalg.norm(struct.unpack_from("<3h", imu))), 1.0)
    return min(_READINGS, key=lambda unit: abs(math.log(reading / unit)))


def _sensed(odometry: Any, imu: bytes, unit: float) -> Array:
    """Return the measurements in the common frame, (15,): the firmware's axes are forward, left, up."""
    w, x, y, z = odometry.q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    ax, ay, az, gx, gy, gz = struct.unpack_from("<6h", imu)
    force = _GRAVITY / unit * np.array([ax, -ay, -az])
    return np.array(
        [
            *(odometry.x, odometry.y, odometry.z),
            *(odometry.vx, odometry.vy, odometry.vz),
            *(roll, pitch, yaw),
            *(_GYRO_RADS * np.array([gx, -gy, -gz])),
            *force,
        ]
    )
