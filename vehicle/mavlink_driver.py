"""Driver of an autopilot that speaks MAVLink: states in, SET_ATTITUDE_TARGET out.

Frames are those of this project: the world north, east, down, the body forward, right, down,
radians. A thread reads the link, so that the time of arrival of each message is known.
"""

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.protocol.network.mavlink import MavlinkLink, messages
from transport.vehicle.ardupilot_and_px4 import Dialect, Parameter, throttle_of, thrust_of
from transport.vehicle.autopilot import AutopilotState, Finding

_AUTOPILOT = 1  # component of every autopilot
# Component of this process: an onboard computer.
_OWN_COMPONENT = 191
# Times between two of each, ns.
_HEARTBEAT_NS = 1_000_000_000
_ASK_NS = 500_000_000
_SILENT_NS = 2_000_000_000
_WAIT_S = 0.2  # of the thread, for a packet
# Degrees of latitude to metres, on the sphere of WGS 84's equator; origins are a few metres apart.
_METRES_PER_DEGREE = 111_319.49
_SAME_ORIGIN_M = 0.05  # resolution of an origin in messages is 1 cm
_NOT_FORCED = 0.0  # arm with the autopilot's own checks


@dataclass(frozen=True, slots=True, kw_only=True)
class MavlinkSettings:
    """Numbers of one vehicle on its link.

    Attributes:
        system: System of the autopilot: the number of the UAV.
        thrust_N: Thrust at full throttle.
        origin: Latitude, longitude, degrees, and height, m, of the common frame.
        parameters: Further parameters that the autopilot must have.
        stream_hz: Messages of each kind of motion a second.
    """

    system: int
    thrust_N: float
    origin: Sequence[float]
    parameters: Mapping[str, float] = field(default_factory=dict)
    stream_hz: float = 100.0


class MavlinkAutopilot:
    """One autopilot on a link; an `Autopilot`."""

    tells_thrust = True  # ATTITUDE_TARGET

    def __init__(self, link: MavlinkLink, dialect: Dialect, settings: MavlinkSettings) -> None:
        self._link = link
        self._dialect = dialect
        self._settings = settings
        own = [
            Parameter(name=name, value=value, reason="of the vehicle's file")
            for name, value in settings.parameters.items()
        ]
        self._wanted = {each.name: each for each in (*dialect.parameters, *own)}
        self._values: dict[str, float] = {}
        self._newest: dict[str, tuple[Any, int]] = {}  # by type, with the time of arrival, ns
        self._says = ""
        self._origin: tuple[float, float, float] | None = None  # of the autopilot's own frame
        self._heartbeat_ns = 0
        self._ask_ns = 0
        self._lock = threading.Lock()
        self._is_closed = False
        self._thread = threading.Thread(target=self._read, name="mavlink", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and close the link."""
        self._is_closed = True
        self._thread.join()
        self._link.close()

    @property
    def refused(self) -> int:
        """Number of packets on the link that did not count."""
        return self._link.refused

    # What comes

    def _read(self) -> None:
        """Keep the newest message of each type, on a thread."""
        while not self._is_closed:
            for message in self._link.receive(_WAIT_S):
                if message.get_srcComponent() != _AUTOPILOT:
                    continue
                with self._lock:
                    self._take(message, time.monotonic_ns())

    def _take(self, message: Any, now_ns: int) -> None:
        kind = message.get_type()
        self._newest[kind] = message, now_ns
        match kind:
            case "STATUSTEXT":
                self._says = message.text
            case "PARAM_VALUE":
                self._values[message.param_id] = float(message.param_value)
            case "GPS_GLOBAL_ORIGIN":
                self._origin = (
                    message.latitude / 1e7,
                    message.longitude / 1e7,
                    message.altitude / 1e3,
                )

    def silence(self) -> str:
        """Return in words that it has not been heard, and which other systems have been."""
        text = "no sign of life from the autopilot"
        if not self._link.others:
            return text
        expected = f"expected system {self._settings.system}, the number of the UAV"
        heard = ", ".join(map(str, sorted(self._link.others)))
        return (
            f"{text}: {expected}, heard {heard} (MAV_SYSID, before SYSID_THISMAV; PX4 MAV_SYS_ID)"
        )

    def state(self) -> AutopilotState | None:
        """Return what it has told."""
        with self._lock:
            newest = dict(self._newest)
            says = self._says
        heartbeat, _ = newest.get("HEARTBEAT", (None, 0))
        # Any message is a sign of life: in a slow simulation heartbeats are seconds apart.
        heard_ns = max((at_ns for _, at_ns in newest.values()), default=0)
        if heartbeat is None or time.monotonic_ns() > heard_ns + _SILENT_NS:
            return None
        health, _ = newest.get(self._dialect.health, (None, 0))
        system, _ = newest.get("SYS_STATUS", (None, 0))
        place, place_ns = newest.get("LOCAL_POSITION_NED", (None, 0))
        target, _ = newest.get("ATTITUDE_TARGET", (None, 0))
        remaining = -1 if system is None else system.battery_remaining
        return AutopilotState(
            sensed=self._sensed(newest),
            position_ns=place_ns,
            attitude_ns=newest.get("ATTITUDE", (None, 0))[1],
            position_s=0.0 if place is None else place.time_boot_ms / 1e3,
            armed=bool(heartbeat.base_mode & messages().MAV_MODE_FLAG_SAFETY_ARMED),
            takes_setpoints=self._dialect.is_guided(heartbeat.custom_mode),
            is_healthy=health is not None and self._dialect.is_healthy(health),
            thrust_N=None
            if target is None
            else thrust_of(float(target.thrust), self._settings.thrust_N),
            battery=-1.0 if remaining < 0 else remaining / 100.0,
            mode=self._dialect.mode_name(heartbeat.custom_mode),
            says=says,
        )

    def _sensed(self, newest: Mapping[str, tuple[Any, int]]) -> Array | None:
        """Return the measurements in the common frame, (15,), None before all are there."""
        kinds = ("LOCAL_POSITION_NED", "ATTITUDE", self._dialect.imu)
        if self._origin is None or any(kind not in newest for kind in kinds):
            return None
        place, attitude, imu = (newest[kind][0] for kind in kinds)
        own = np.array([place.x, place.y, place.z]) + self._shift()
        force = self._dialect.imu_mps2 * np.array([imu.xacc, imu.yacc, imu.zacc])
        return np.concatenate(
            [
                own,
                [place.vx, place.vy, place.vz],
                [attitude.roll, attitude.pitch, attitude.yaw],
                [attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed],
                force,
            ]
        )

    def _shift(self) -> Array:
        """Return the autopilot's own origin in the common frame, (3,), m."""
        if self._origin is None:
            return np.zeros(3)
        latitude, longitude, height = self._settings.origin
        north = (self._origin[0] - latitude) * _METRES_PER_DEGREE
        east = self._origin[1] - longitude
        east *= _METRES_PER_DEGREE * np.cos(np.radians(latitude))
        return np.array([north, east, height - self._origin[2]])

    # What goes

    def attend(self, now_ns: int) -> None:
        """Send the sign of life, and ask for what is missing."""
        if now_ns >= self._heartbeat_ns:
            self._heartbeat_ns = now_ns + _HEARTBEAT_NS
            m = messages()
            self._send(
                m.MAVLink_heartbeat_message(
                    m.MAV_TYPE_ONBOARD_CONTROLLER, m.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
                )
            )
        if now_ns >= self._ask_ns and self._newest:
            self._ask_ns = now_ns + _ASK_NS
            self._ask(now_ns)

    def _ask(self, now_ns: int) -> None:
        """Ask for messages that do not come, parameters that are not known, and the origin."""
        m = messages()
        wanted = {
            "ATTITUDE": self._settings.stream_hz,
            "LOCAL_POSITION_NED": self._settings.stream_hz,
            self._dialect.imu: self._settings.stream_hz,
            self._dialect.health: 5.0,
            "SYS_STATUS": 2.0,
            "ATTITUDE_TARGET": 10.0,
        }
        if "HEARTBEAT" not in self._newest:  # a second is long for a process that returns in flight
            self._do(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_HEARTBEAT)
        for kind, hz in wanted.items():
            if now_ns > self._newest.get(kind, (None, 0))[1] + _SILENT_NS:
                number = getattr(m, f"MAVLINK_MSG_ID_{kind}")
                self._do(m.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / hz)
        for name in self._wanted.keys() - self._values.keys():
            self._send(
                m.MAVLink_param_request_read_message(
                    self._settings.system, _AUTOPILOT, name.encode(), -1
                )
            )
        if self._origin is None:
            # Before its own estimator chooses one; later the autopilot keeps what it has.
            latitude, longitude, height = self._settings.origin
            where = round(latitude * 1e7), round(longitude * 1e7), round(height * 1e3)
            self._send(m.MAVLink_set_gps_global_origin_message(self._settings.system, *where, 0))
            self._do(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)

    def findings(self) -> Sequence[Finding]:
        """Return the checks of parameters and of the origin."""
        found = [each.finding(self._values.get(name)) for name, each in self._wanted.items()]
        away_m = float(np.linalg.norm(self._shift()))
        is_known = self._origin is not None
        where = "its own" if away_m > _SAME_ORIGIN_M else "the common one"
        found.append(
            Finding(
                subject="origin",
                expected="known",
                got=f"{where}, {away_m:.2f} m from the common one" if is_known else "",
                is_met=is_known,
                reason="positions of all UAVs need one frame",
            )
        )
        return found

    def command(self, thrust_N: float, rates_rads: Array, since_s: float) -> None:
        """Send a setpoint: thrust and body rates, the attitude ignored."""
        m = messages()
        self._send(
            m.MAVLink_set_attitude_target_message(
                round(since_s * 1e3) & 0xFFFFFFFF,
                self._settings.system,
                _AUTOPILOT,
                m.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE,
                [1.0, 0.0, 0.0, 0.0],
                *(float(rate) for rate in rates_rads),
                throttle_of(thrust_N, self._settings.thrust_N),
            )
        )

    def arm(self) -> None:
        """Ask for the mode of setpoints, then to arm."""
        state = self.state()
        if state is not None and not state.takes_setpoints:
            self._mode(self._dialect.guided)
        elif state is not None and not state.armed:
            self._do(messages().MAV_CMD_COMPONENT_ARM_DISARM, 1.0, _NOT_FORCED)

    def hold(self) -> None:
        """Ask for the mode that holds the place."""
        self._mode(self._dialect.hold)

    def land(self) -> None:
        """Ask for the mode that lands."""
        self._mode(self._dialect.land)

    def _mode(self, mode: tuple[int, int, int]) -> None:
        self._do(messages().MAV_CMD_DO_SET_MODE, *mode)

    def _do(self, command: int, *numbers: float) -> None:
        """Send a command with its numbers."""
        seven = [*map(float, numbers), *[0.0] * 7][:7]
        self._send(
            messages().MAVLink_command_long_message(
                self._settings.system, _AUTOPILOT, command, 0, *seven
            )
        )

    def _send(self, message: Any) -> None:
        self._link.send(message)
