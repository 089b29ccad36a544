"""A stand-in for ArduCopter's simulator target, started with the same options.

It speaks ArduPilot's JSON interface to the physics and MAVLink to a companion computer, and does
what ArduCopter was measured to do (docs/flight.md). It is for tests and for trying the chain
without the firmware; it shows nothing about a firmware.

Its estimate is the truth with slowly wandering errors, in a frame of its own: unless an origin is
set before its navigation is ready, it chooses the place where it is then.
"""

import argparse
import json
import math
import random
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from transport.plant.autopilot.copter_control import (
    GUIDED,
    CopterControl,
    CopterEstimate,
    CopterSetpoint,
    Quaternion,
    Vector,
)
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages, read_key

# Packet of outputs to the physics: magic, steps a second, number, pulses in us.
_SERVO = struct.Struct("<HHI16H")
_MAGIC = 18458
_READY_S = 2.0  # from its start, until navigation is ready
_AGAIN_S = 1.0  # after which outputs are sent again: the physics may not be there yet
_ORPHAN_S = 30.0  # without physics it ends
_MOST_BYTES = 4096
_METRES_PER_DEGREE = 111_319.49
_GRAVITY = 9.80665  # a unit of SCALED_IMU, m/s^2
_BATTERY_MV, _CURRENT_CA = 16_000, 500  # a battery of 16 V, 5 A
_VARIANCE = 0.1  # of the estimate, as EKF_STATUS_REPORT tells it: far below its limit, 1
_NO_SENSORS = [0] * 4  # of SYS_STATUS: bits of sensors, and load
_NO_ERRORS = [0] * 6  # of SYS_STATUS: lost packets and other errors
_NO_GYRO_OR_COMPASS = [0] * 6  # of SCALED_IMU
_TEXT_BYTES = 50  # of STATUSTEXT
_MAVLINK_VERSION = 3  # in HEARTBEAT, also of MAVLink 2
# Errors of the estimate: standard deviation and correlation time, s. Those of a satellite
# receiver with an inertial filter, as ArduCopter's own were in simulation.
_ERRORS = {
    "position": (0.05, 5.0),
    "velocity": (0.03, 2.0),
    "attitude": (0.004, 10.0),
    "gyro": (0.004, 0.02),
    "force": (0.05, 0.02),
}
# Intervals until others are asked for, s.
_INTERVALS = {"HEARTBEAT": 1.0, "SYS_STATUS": 1.0, "GPS_GLOBAL_ORIGIN": 0.0}
_DEFAULTS = {
    "GUID_OPTIONS": 0.0,
    "GUID_TIMEOUT": 3.0,
    "MOT_THST_EXPO": 0.65,
    "MOT_SPIN_MIN": 0.15,
    "MOT_SPIN_MAX": 0.95,
    "MOT_THST_HOVER": 0.35,
    "ATC_ANGLE_BOOST": 1.0,
    "EK3_POS_I_GATE": 500.0,
    "ATC_ANG_RLL_P": 4.5,
    "ATC_ANG_PIT_P": 4.5,
    "ATC_ANG_YAW_P": 4.5,
    "ATC_RAT_RLL_P": 0.135,
    "ATC_RAT_PIT_P": 0.135,
    "ATC_RAT_YAW_P": 0.18,
    "ATC_RAT_RLL_I": 0.135,
    "ATC_RAT_PIT_I": 0.135,
    "ATC_RAT_YAW_I": 0.018,
    "ATC_ACCEL_R_MAX": 110_000.0,
    "ATC_ACCEL_P_MAX": 110_000.0,
    "ATC_ACCEL_Y_MAX": 27_000.0,
    "SIM_RATE_HZ": 400.0,
    # Of the stand-in alone: whether a pilot arms it in GUIDED once it is ready, charge, %, and a
    # shift of the estimate to the north, m.
    "STAND_PILOT": 0.0,
    "STAND_BATTERY": 90.0,
    "STAND_JUMP": 0.0,
}


class Wandering:
    """Errors of the estimate: first-order Gauss-Markov processes, three axes each."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)  # noqa: S311  # an error, no secret
        self.values = {name: self._drawn(size) for name, (size, _) in _ERRORS.items()}

    def advance(self, step_s: float) -> None:
        """Let all errors go on by a step."""
        for name, (size, time_s) in _ERRORS.items():
            decay = math.exp(-step_s / time_s)
            fresh = self._drawn(size * math.sqrt(1.0 - decay * decay))
            before = self.values[name]
            x, y, z = (decay * old + new for old, new in zip(before, fresh, strict=True))
            self.values[name] = x, y, z

    def _drawn(self, size: float) -> Vector:
        """Return three normal numbers of a standard deviation."""
        gauss = self._random.gauss
        return gauss(0.0, size), gauss(0.0, size), gauss(0.0, size)


class StandIn:
    """One stand-in autopilot, with its sockets."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.parameters = {**_DEFAULTS, **_read_parameters(options.defaults)}
        self.control = CopterControl(self.parameters)
        key = read_key(options.signing_key) if options.signing_key else None
        endpoint = Endpoint.of(options.serial1, "--serial1")
        self.link = MavlinkLink(endpoint, (options.sysid, 1), 0, key)
        self._system = options.sysid
        self._home = [float(part) for part in options.home.split(",")[:3]]
        self._errors = Wandering(options.sysid)
        self._origin: list[float] | None = None  # latitude, longitude, height
        self._intervals = dict(_INTERVALS)
        self._due = dict.fromkeys(self._intervals, 0.0)
        self._record = Path("setpoints.csv").open("w", encoding="ascii", buffering=1)  # noqa: SIM115
        self.time_s = 0.0
        self._step_s = 1.0 / self.parameters["SIM_RATE_HZ"]
        self._count = 0
        self._estimate = CopterEstimate((0.0,) * 3, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3)
        self._force: Vector = (0.0, 0.0, -9.8)
        self._outputs: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    def close(self) -> None:
        """Close the link and the record of setpoints."""
        self.link.close()
        self._record.close()

    @property
    def _is_ready(self) -> bool:
        """Whether navigation is ready: it has an origin, and arming is allowed."""
        return self.time_s >= _READY_S

    def servos(self) -> bytes:
        """Return the packet of outputs: the thrust of a rotor follows the squared pulse."""
        pulses = [1000 + round(1000 * math.sqrt(share)) for share in self._outputs]
        self._count += 1
        rate = round(1.0 / self._step_s)
        return _SERVO.pack(_MAGIC, rate, self._count, *pulses, *[0] * 12)

    def step(self, packet: bytes) -> None:
        """Take in the sensors of the physics, and compute the outputs that follow."""
        told = json.loads(packet)
        step_s = max(told["timestamp"] - self.time_s, 0.0)
        self.time_s = told["timestamp"]
        if step_s == 0.0 or step_s > 1.0:
            step_s = self._step_s
        self._errors.advance(step_s)
        self._sense(told)
        if self._is_ready and self.parameters["STAND_PILOT"] and not self.control.is_armed:
            self.control.change_mode(GUIDED)
            self.control.arm("")
        self._outputs = self.control.outputs(self.time_s, step_s, self._estimate)

    def _sense(self, told: dict[str, Any]) -> None:
        """Renew the estimate from what the physics tells."""
        off = self._errors.values
        if self._origin is None and self._is_ready:
            self._origin = self._geodetic(told["position"])  # its own
        shift = self._local(self._origin) if self._origin is not None else (0.0, 0.0, 0.0)
        place = [
            true + error - of
            for true, error, of in zip(told["position"], off["position"], shift, strict=True)
        ]
        place[0] += self.parameters["STAND_JUMP"]
        tilt = off["attitude"]
        error = 1.0, tilt[0] / 2, tilt[1] / 2, tilt[2] / 2
        w, x, y, z = told["quaternion"]
        attitude = _multiplied((w, x, y, z), error)
        self._estimate = CopterEstimate(
            (place[0], place[1], place[2]),
            _sum(told["velocity"], off["velocity"]),
            attitude,
            _sum(told["imu"]["gyro"], off["gyro"]),
        )
        self._force = _sum(told["imu"]["accel_body"], off["force"])

    def _geodetic(self, place: Sequence[float]) -> list[float]:
        """Return latitude and longitude, degrees, and height, m, of a place in the frame of the physics.

        The frame, north, east, down, m, begins at the home; it is flat.
        """
        latitude, longitude, height = self._home
        east = _METRES_PER_DEGREE * math.cos(math.radians(latitude))
        return [
            latitude + place[0] / _METRES_PER_DEGREE,
            longitude + place[1] / east,
            height - place[2],
        ]

    def _local(self, origin: Sequence[float]) -> Vector:
        """Return the place of an origin in the frame of the physics: the inverse of `_geodetic`."""
        latitude, longitude, height = self._home
        east = _METRES_PER_DEGREE * math.cos(math.radians(latitude))
        return (
            (origin[0] - latitude) * _METRES_PER_DEGREE,
            (origin[1] - longitude) * east,
            height - origin[2],
        )

    # The companion computer

    def hear(self) -> None:
        """Take in all messages that have come."""
        while select.select([self.link], [], [], 0.0)[0]:
            for message in self.link.receive(0.0):
                if getattr(message, "target_system", self._system) in (0, self._system):
                    self._take(message)

    def _take(self, message: Any) -> None:
        """Obey one message; ignore those that it does not know."""
        m = messages()
        match message.get_type():
            case "SET_ATTITUDE_TARGET":
                rates = message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate
                taken = self.control.take(CopterSetpoint(message.thrust, rates, self.time_s))
                numbers = self.time_s, message.time_boot_ms / 1e3, message.thrust, *rates
                if taken:
                    self._record.write(",".join(f"{value:.4f}" for value in numbers) + "\n")
            case "PARAM_REQUEST_READ":
                self._tell_parameter(message.param_id)
            case "PARAM_SET":
                if message.param_id in self.parameters:
                    self.parameters[message.param_id] = message.param_value
                    self._tell_parameter(message.param_id)
            case "SET_GPS_GLOBAL_ORIGIN":
                if self._origin is None:
                    self._origin = [
                        message.latitude / 1e7,
                        message.longitude / 1e7,
                        message.altitude / 1e3,
                    ]
            case "COMMAND_LONG":
                result = self._do(message)
                self.link.send(m.MAVLink_command_ack_message(message.command, result))

    def _do(self, message: Any) -> Any:
        """Obey a command; return the result of its acknowledgement."""
        m = messages()
        accepted, denied = m.MAV_RESULT_ACCEPTED, m.MAV_RESULT_DENIED
        match message.command:
            case m.MAV_CMD_DO_SET_MODE:
                return accepted if self.control.change_mode(round(message.param2)) else denied
            case m.MAV_CMD_COMPONENT_ARM_DISARM if message.param1 == 0.0:
                self.control.is_armed = False
                return accepted
            case m.MAV_CMD_COMPONENT_ARM_DISARM:
                problem = "" if self._is_ready else "Need Position Estimate"
                problem = self.control.arm(problem)
                if problem:
                    self._say(f"Arm: {problem}")
                return m.MAV_RESULT_FAILED if problem else accepted
            case m.MAV_CMD_SET_MESSAGE_INTERVAL:
                name = m.mavlink_map[round(message.param1)].msgname
                self._intervals[name] = message.param2 / 1e6
                self._due[name] = self.time_s
                return accepted
            case m.MAV_CMD_REQUEST_MESSAGE:
                self._tell(m.mavlink_map[round(message.param1)].msgname)
                return accepted
        return m.MAV_RESULT_UNSUPPORTED

    def tell(self) -> None:
        """Send the messages that are due."""
        for name, interval_s in self._intervals.items():
            if interval_s > 0.0 and self.time_s >= self._due[name]:
                self._due[name] = max(self._due[name] + interval_s, self.time_s - interval_s)
                self._tell(name)

    def _tell_parameter(self, name: str) -> None:
        """Send the value of a parameter; nothing if there is none of that name."""
        if name in self.parameters:
            m = messages()
            value = self.parameters[name]
            self.link.send(
                m.MAVLink_param_value_message(
                    name.encode(), value, m.MAV_PARAM_TYPE_REAL32, len(self.parameters), 0
                )
            )

    def _say(self, text: str) -> None:
        """Send a warning to people, cut to the length of its message."""
        m = messages()
        warning = m.MAVLink_statustext_message(m.MAV_SEVERITY_WARNING, text.encode()[:_TEXT_BYTES])
        self.link.send(warning)

    def _tell(self, name: str) -> None:
        """Send one message by its name."""
        m = messages()
        ms = round(self.time_s * 1e3)
        own = self._estimate
        message: Any = None
        match name:
            case "HEARTBEAT":
                armed = m.MAV_MODE_FLAG_SAFETY_ARMED if self.control.is_armed else 0
                mode = m.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed
                kind = m.MAV_TYPE_QUADROTOR, m.MAV_AUTOPILOT_ARDUPILOTMEGA
                message = m.MAVLink_heartbeat_message(
                    *kind, mode, self.control.mode, m.MAV_STATE_ACTIVE, _MAVLINK_VERSION
                )
            case "ATTITUDE":
                message = m.MAVLink_attitude_message(ms, *_euler(own.attitude), *own.gyro)
            case "LOCAL_POSITION_NED" if self._origin is not None:
                message = m.MAVLink_local_position_ned_message(ms, *own.position, *own.velocity)
            case "SCALED_IMU":
                milli = [round(1e3 * part / _GRAVITY) for part in self._force]
                message = m.MAVLink_scaled_imu_message(ms, *milli, *_NO_GYRO_OR_COMPASS)
            case "EKF_STATUS_REPORT":
                flags = _ready_flags(m) if self._is_ready else m.EKF_ATTITUDE | m.EKF_CONST_POS_MODE
                message = m.MAVLink_ekf_status_report_message(flags, *[_VARIANCE] * 5)
            case "ATTITUDE_TARGET":
                share = sum(self._outputs) / len(self._outputs)
                message = m.MAVLink_attitude_target_message(
                    ms, 0, list(own.attitude), 0.0, 0.0, 0.0, share
                )
            case "SYS_STATUS":
                charge = round(self.parameters["STAND_BATTERY"])
                battery = _BATTERY_MV, _CURRENT_CA, charge
                message = m.MAVLink_sys_status_message(*_NO_SENSORS, *battery, *_NO_ERRORS)
            case "GPS_GLOBAL_ORIGIN" if self._origin is not None:
                latitude, longitude, height = self._origin
                message = m.MAVLink_gps_global_origin_message(
                    round(latitude * 1e7), round(longitude * 1e7), round(height * 1e3)
                )
        if message is not None:
            self.link.send(message)


def _ready_flags(m: Any) -> int:
    """Return the bits of an estimate that is complete: attitude, velocity, and position."""
    velocity = m.EKF_VELOCITY_HORIZ | m.EKF_VELOCITY_VERT
    position = m.EKF_POS_HORIZ_REL | m.EKF_POS_HORIZ_ABS | m.EKF_POS_VERT_ABS
    predicted = m.EKF_PRED_POS_HORIZ_REL | m.EKF_PRED_POS_HORIZ_ABS
    return int(m.EKF_ATTITUDE | velocity | position | predicted)


def _sum(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _multiplied(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return a rotation after a small one about the body's axes."""
    w = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    x = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    y = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    z = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]
    size = math.sqrt(w * w + x * x + y * y + z * z)
    return w / size, x / size, y / size, z / size


def _euler(q: Quaternion) -> Vector:
    """Return roll, pitch and yaw of an attitude, rad."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


def _read_parameters(path: Path | None) -> dict[str, float]:
    """Return the parameters in a file: a name and a number on each line."""
    if path is None:
        return {}
    lines = path.read_text(encoding="ascii").split("\n")
    pairs = (line.replace(",", " ").split() for line in lines if line.strip())
    return {name: float(value) for name, value, *_ in pairs}


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options, named as those of ArduPilot's simulator; others are ignored."""
    parser = argparse.ArgumentParser("stand-in", description=__doc__)
    parser.add_argument("--sysid", type=int, default=1)
    parser.add_argument("--home", default="47.0,8.0,0,0")
    parser.add_argument("--defaults", type=Path)
    parser.add_argument("--sim-address", default="127.0.0.1")
    parser.add_argument("--sim-port-out", type=int, default=9002)
    parser.add_argument("--serial1", default="udpclient:127.0.0.1:14550")
    parser.add_argument("--signing-key", type=Path)
    known, _ = parser.parse_known_args(arguments)
    return known


def main(arguments: Sequence[str]) -> None:
    """Run until the physics are gone."""
    options = _options(arguments)
    physics = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with closing(StandIn(options)) as copter, physics:
        physics.settimeout(_AGAIN_S)
        there = options.sim_address, options.sim_port_out
        heard_s = time.monotonic()
        outputs = copter.servos()
        while time.monotonic() < heard_s + _ORPHAN_S:
            physics.sendto(outputs, there)
            try:
                packet = physics.recv(_MOST_BYTES)
            except TimeoutError:
                continue
            heard_s = time.monotonic()
            copter.step(packet)
            copter.hear()
            copter.tell()
            outputs = copter.servos()


if __name__ == "__main__":
    main(sys.argv[1:])
