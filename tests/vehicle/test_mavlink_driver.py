"""Driver of an autopilot that speaks MAVLink, above a link whose other end is played."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tests.support.bench import free_udp_port
from tests.support.commands import wait_for
from transport.mpc.settings_period_horizon_weights import Limits
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages
from transport.protocol.scenario.sections.vehicles_section import VehiclesSection
from transport.vehicle.autopilot import Autopilot
from transport.vehicle.link_opening_and_check import LinkOptions, open_autopilot

LARGEST_N = 30.0
ORIGIN = (47.0, 8.0, 400.0)
METRES_PER_DEGREE = 111_319.49
SECTION = VehiclesSection(origin=ORIGIN, parameters={"OWN": 3.0})
GUIDED, ARMED = 4, 128
READY = 1 | 2 | 16  # attitude, velocity, position


@dataclass
class Flight:
    """A driver and the autopilot at the other end of its link, system 1 unless it is another one."""

    driver: Autopilot
    port: int
    link: MavlinkLink

    def tell(self, *told: Any, until: Callable[[], bool], system: int = 1) -> None:
        """Send messages again and again until the driver has taken them in."""
        link = self.link if system == 1 else self._of(system)

        def has_come() -> bool:
            for message in told:
                link.send(message)
            return until()

        assert wait_for(has_come)
        if link is not self.link:
            link.close()

    def _of(self, system: int) -> MavlinkLink:
        return MavlinkLink(Endpoint(True, "127.0.0.1", self.port), (system, 1), 0)

    def asked(self, later_s: float) -> list[Any]:
        """Return the messages that the driver sends when attended a time from now."""
        self.sent()
        self.driver.attend(time.monotonic_ns() + round(1e9 * later_s))
        return self.sent()

    def sent(self) -> list[Any]:
        """Return the messages that have come from the driver."""
        sent: list[Any] = []
        while received := list(self.link.receive(0.02)):
            sent += received
        return sent

    def in_mode(self, mode: int, flags: int = 0) -> None:
        """Tell a mode, with flags of the heartbeat."""
        self.tell(
            messages().MAVLink_heartbeat_message(2, 3, flags, mode, 0, 3),
            until=lambda: (
                (state := self.driver.state()) is not None
                and state.takes_setpoints == (mode == GUIDED)
                and state.armed == bool(flags)
            ),
        )


@pytest.fixture
def flight() -> Iterator[Flight]:
    """A driver for UAV 1, above an ArduPilot that has not spoken yet."""
    port = free_udp_port()
    links = LinkOptions(link=f"udp:127.0.0.1:{port}")
    driver = open_autopilot(SECTION, Limits(thrust_N=(0.0, LARGEST_N)), 1, links)
    link = MavlinkLink(Endpoint(True, "127.0.0.1", port), (1, 1), 0)
    yield Flight(driver, port, link)
    link.close()
    driver.close()


def test_an_autopilot_with_another_system_id_is_named(flight: Flight) -> None:
    """The system id must be the number of the UAV: the ids that are heard instead are told."""
    driver = flight.driver
    assert driver.silence() == "no sign of life from the autopilot"
    heartbeat = messages().MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3)
    flight.tell(heartbeat, until=lambda: "heard" in driver.silence(), system=7)
    assert "expected system 1, the number of the UAV, heard 7 (MAV_SYSID" in driver.silence()
    assert driver.state() is None


def motion() -> list[Any]:
    """Return place, attitude, force and origin of an autopilot north-east of the common origin, and 10 m above."""
    m = messages()
    return [
        m.MAVLink_gps_global_origin_message(470_001_000, 80_002_000, 410_000),
        m.MAVLink_local_position_ned_message(2_500, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3),
        m.MAVLink_attitude_message(2_500, 0.01, 0.02, 0.03, 0.4, 0.5, 0.6),
        m.MAVLink_scaled_imu_message(2_500, 10, -20, -1_000, *[0] * 6),
    ]


def test_measurements_are_in_the_common_frame(flight: Flight) -> None:
    """Places are from the common origin; specific force is in thousandths of standard gravity."""
    flight.in_mode(GUIDED, ARMED)
    state = flight.driver.state()
    assert state is not None
    assert (state.sensed, state.battery, state.thrust_N, state.is_healthy) == (
        None,
        -1,
        None,
        False,
    )
    m = messages()
    flight.tell(
        *motion(),
        m.MAVLink_ekf_status_report_message(READY, *[0.0] * 5),
        m.MAVLink_sys_status_message(*[0] * 4, 16_000, 500, 85, *[0] * 6),
        m.MAVLink_attitude_target_message(0, 0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.25),
        m.MAVLink_statustext_message(4, b"a warning"),
        until=lambda: (state := flight.driver.state()) is not None and bool(state.says),
    )
    state = flight.driver.state()
    assert state is not None
    assert state.sensed is not None
    north = 1.0 + 1e-4 * METRES_PER_DEGREE
    east = 2.0 + 2e-4 * METRES_PER_DEGREE * math.cos(math.radians(47.0))
    place = [north, east, -3.0 - 10.0, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(state.sensed[:6], place, atol=1e-5)
    np.testing.assert_allclose(state.sensed[6:12], [0.01, 0.02, 0.03, 0.4, 0.5, 0.6], atol=1e-6)
    force = 9.80665 * np.array([0.01, -0.02, -1.0])
    np.testing.assert_allclose(state.sensed[12:], force, atol=1e-9)
    told = state.position_s, state.armed, state.is_healthy, state.battery, state.thrust_N
    assert told == (2.5, True, True, 0.85, 0.25 * LARGEST_N)
    assert (state.mode, state.says) == ("GUIDED", "a warning")
    assert 0 < state.position_ns <= time.monotonic_ns()
    assert "10.00 m" not in str(flight.driver.findings())  # away by its three distances
    away_m = float(np.linalg.norm([north - 1.0, east - 2.0, 10.0]))
    assert f"its own, {away_m:.2f} m from the common one" in str(flight.driver.findings()[-1])


def test_an_autopilot_that_is_silent_has_no_state(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two seconds after the last message of any kind."""
    flight.in_mode(GUIDED)
    monkeypatch.setattr("transport.vehicle.mavlink_driver._SILENT_NS", 0)
    assert flight.driver.state() is None


def test_a_setpoint_is_a_share_of_the_largest_thrust_and_body_rates(flight: Flight) -> None:
    """The attitude is ignored; the time is that of the knowledge; thrusts beyond the largest one are cut."""
    flight.in_mode(GUIDED, ARMED)
    flight.sent()
    for thrust_N in (7.5, 60.0, -1.0):
        flight.driver.command(thrust_N, np.array([0.1, -0.2, 0.3]), 1.25)
    given = flight.sent()
    assert [one.get_type() for one in given] == ["SET_ATTITUDE_TARGET"] * 3
    assert [one.thrust for one in given] == [0.25, 1.0, 0.0]
    first = given[0]
    rates = first.body_roll_rate, first.body_pitch_rate, first.body_yaw_rate
    assert rates == pytest.approx((0.1, -0.2, 0.3))
    assert (first.time_boot_ms, first.target_system, first.type_mask) == (1250, 1, 128)


def test_it_asks_for_the_mode_then_to_arm(flight: Flight) -> None:
    """By commands with their numbers, to its system; nothing more once it is armed in GUIDED."""
    m = messages()
    asked = []
    for mode, flags in [(0, 0), (GUIDED, 0), (GUIDED, ARMED)]:
        flight.in_mode(mode, flags)
        flight.sent()
        flight.driver.arm()
        asked.append([(one.command, one.param1, one.param2) for one in flight.sent()])
    assert asked == [
        [(m.MAV_CMD_DO_SET_MODE, 1.0, 4.0)],
        [(m.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, 0.0)],
        [],
    ]
    flight.driver.hold()
    flight.driver.land()
    modes = [(one.target_system, one.command, one.param2) for one in flight.sent()]
    assert modes == [(1, m.MAV_CMD_DO_SET_MODE, 17.0), (1, m.MAV_CMD_DO_SET_MODE, 9.0)]


def test_it_asks_for_what_it_lacks(flight: Flight) -> None:
    """Messages at their rates, parameters and the origin, until they are told; nothing before a sign of life.

    Any message is one: a process that returns in flight asks for the heartbeat, which tells the mode.
    """
    m = messages()
    assert not flight.asked(0.0)
    flight.tell(
        m.MAVLink_attitude_message(0, *[0.0] * 6),
        until=lambda: any(one.get_type() == "COMMAND_LONG" for one in flight.asked(0.0)),
    )
    first = flight.asked(0.6)
    commands = [
        (one.command, one.param1, round(one.param2))
        for one in first
        if one.get_type() == "COMMAND_LONG"
    ]
    assert (m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_HEARTBEAT, 0.0) in commands
    assert (m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, 0.0) in commands
    every_us = round(1e6 / (2.0 * SECTION.setpoint_hz))
    place = m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_LOCAL_POSITION_NED, every_us
    assert place in commands
    assert m.MAVLINK_MSG_ID_ATTITUDE not in [number for _, number, _ in commands]  # it comes
    origins = [one for one in first if one.get_type() == "SET_GPS_GLOBAL_ORIGIN"]
    where = [(one.latitude, one.longitude, one.altitude) for one in origins]
    assert where == [(470_000_000, 80_000_000, 400_000)]
    wanted = {one.param_id for one in first if one.get_type() == "PARAM_REQUEST_READ"}
    assert {"GUID_OPTIONS", "GUID_TIMEOUT", "OWN"} <= wanted
    assert not any(finding.is_met for finding in flight.driver.findings())

    values = {"GUID_OPTIONS": 8.0, "GUID_TIMEOUT": 0.1, "OWN": 4.0}
    flight.tell(
        m.MAVLink_gps_global_origin_message(470_000_000, 80_000_000, 400_000),
        *(
            m.MAVLink_param_value_message(name.encode(), value, 9, 3, 0)
            for name, value in values.items()
        ),
        m.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3),
        until=lambda: sum(bool(one.got) for one in flight.driver.findings()) == 4,
    )
    is_met = {one.subject: one.is_met for one in flight.driver.findings() if one.got}
    assert is_met == {"GUID_OPTIONS": True, "GUID_TIMEOUT": True, "OWN": False, "origin": True}
    again = flight.asked(1.2)
    assert "SET_GPS_GLOBAL_ORIGIN" not in {one.get_type() for one in again}
    left = {one.param_id for one in again if one.get_type() == "PARAM_REQUEST_READ"}
    assert left == wanted - values.keys()


@pytest.fixture
def later(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Hold the clock of the driver, and return how it goes on by a time, s."""
    now_ns = time.monotonic_ns()

    def move(seconds: float) -> None:
        nonlocal now_ns
        now_ns += round(1e9 * seconds)

    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns)
    return move


def test_any_message_is_a_sign_of_life(flight: Flight, later: Callable[[float], None]) -> None:
    """There is a state until 2 s after the last message of any kind; place and attitude have their own times."""
    start_ns = time.monotonic_ns()
    sent = [messages().MAVLink_heartbeat_message(2, 3, 0, GUIDED, 0, 3), *motion()]
    for message in sent:
        flight.link.send(message)
    assert wait_for(lambda: (now := flight.driver.state()) is not None and now.sensed is not None)
    later(1.5)
    flight.link.send(messages().MAVLink_attitude_message(4_000, *[0.0] * 6))
    assert wait_for(
        lambda: (now := flight.driver.state()) is not None and now.attitude_ns > start_ns
    )
    state = flight.driver.state()
    assert state is not None
    assert (state.position_ns, state.attitude_ns) == (start_ns, start_ns + 1_500_000_000)
    later(2.0)
    assert flight.driver.state() is not None
    later(1e-9)
    assert flight.driver.state() is None


def test_other_components_are_not_the_autopilot(flight: Flight) -> None:
    """A camera or gimbal of the same system changes nothing."""
    flight.in_mode(GUIDED)
    gimbal = MavlinkLink(Endpoint(True, "127.0.0.1", flight.port), (1, 154), 0)
    gimbal.send(messages().MAVLink_heartbeat_message(26, 8, ARMED, 0, 0, 3))
    said = messages().MAVLink_statustext_message(4, b"after the gimbal")
    flight.tell(said, until=lambda: (now := flight.driver.state()) is not None and bool(now.says))
    gimbal.close()
    state = flight.driver.state()
    assert state is not None
    assert (state.takes_setpoints, state.armed) == (True, False)


def test_it_is_an_onboard_computer_that_lives(flight: Flight) -> None:
    """One heartbeat a second; questions each half second."""
    flight.in_mode(GUIDED)
    kinds = [{one.get_type() for one in flight.asked(s)} for s in (0.0, 0.1, 0.6, 1.2)]
    assert ["HEARTBEAT" in each for each in kinds] == [True, False, False, True]
    assert ["PARAM_REQUEST_READ" in each for each in kinds] == [True, False, True, True]
    (beat,) = (one for one in flight.asked(3.0) if one.get_type() == "HEARTBEAT")
    told = beat.get_srcSystem(), beat.get_srcComponent(), beat.type, beat.autopilot
    assert told == (255, 191, 18, 8)  # onboard controller, no autopilot


def test_messages_are_asked_for_again_once_they_do_not_come(flight: Flight) -> None:
    """Each at its rate, until it comes, and again after 2 s without."""
    m = messages()
    flight.in_mode(GUIDED)
    flight.tell(
        *motion(),
        until=lambda: (now := flight.driver.state()) is not None and now.sensed is not None,
    )

    def rates_hz(later_s: float) -> dict[int, float]:
        asked = flight.asked(later_s)
        commands = [one for one in asked if one.get_type() == "COMMAND_LONG"]
        assert {(one.target_system, one.target_component) for one in commands} == {(1, 1)}
        return {
            round(one.param1): 1e6 / one.param2
            for one in commands
            if one.command == m.MAV_CMD_SET_MESSAGE_INTERVAL
        }

    others = {
        m.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5.0,
        m.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
        m.MAVLINK_MSG_ID_ATTITUDE_TARGET: 10.0,
    }
    assert rates_hz(0.0) == pytest.approx(others)
    fast = dict.fromkeys(
        (
            m.MAVLINK_MSG_ID_ATTITUDE,
            m.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            m.MAVLINK_MSG_ID_SCALED_IMU,
        ),
        2.0 * SECTION.setpoint_hz,
    )
    assert rates_hz(2.5) == pytest.approx(others | fast, rel=1e-6)


@pytest.mark.parametrize(
    ("away_mm", "where"), [(0, "the common one"), (40, "the common one"), (60, "its own")]
)
def test_an_origin_of_its_own_is_told(flight: Flight, away_mm: int, where: str) -> None:
    """Known is enough; within 5 cm it is the common one."""
    flight.in_mode(GUIDED)
    assert str(flight.driver.findings()[-1]) == (
        "origin: expected known, got no answer yet (positions of all UAVs need one frame)"
    )
    height_mm = round(1e3 * ORIGIN[2]) + away_mm
    origin = messages().MAVLink_gps_global_origin_message(470_000_000, 80_000_000, height_mm)
    flight.tell(origin, until=lambda: flight.driver.findings()[-1].is_met)
    got = flight.driver.findings()[-1].got
    assert got == f"{where}, {away_mm / 1e3:.2f} m from the common one"


@pytest.mark.parametrize(("remaining", "battery"), [(-1, -1.0), (0, 0.0), (100, 1.0)])
def test_the_battery_is_a_share(flight: Flight, remaining: int, battery: float) -> None:
    """An empty one is not one that is not known."""
    flight.in_mode(GUIDED)
    m = messages()
    status = m.MAVLink_sys_status_message(*[0] * 4, 16_000, 500, remaining, *[0] * 6)
    said = m.MAVLink_statustext_message(4, b"told")
    flight.tell(
        status, said, until=lambda: (now := flight.driver.state()) is not None and bool(now.says)
    )
    state = flight.driver.state()
    assert state is not None
    assert state.battery == battery


def test_knowledge_from_before_tick_0_has_a_time(flight: Flight) -> None:
    """Times of setpoints are of 32 bits: -50 ms is 2^32 - 50 ms."""
    flight.in_mode(GUIDED, ARMED)
    flight.sent()
    flight.driver.command(7.5, np.zeros(3), -0.05)
    (given,) = flight.sent()
    assert given.time_boot_ms == 2**32 - 50
