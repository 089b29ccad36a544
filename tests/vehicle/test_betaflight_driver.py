"""The driver of Betaflight above a firmware that answers MSP and records its receiver's channels."""

import math
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.bench import free_udp_port
from tests.support.commands import wait_for
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages
from transport.vehicle.betaflight_driver import (
    BetaflightAutopilot,
    BetaflightSettings,
    _armed_and_flags,
    _delay_fits,
    _procedure_fits,
    _rates_fit,
    _sensed,
    _throttle_fits,
    _unit_of,
)
from transport.vehicle.msp import MspLink, framed

LARGEST_N = 34.2
RATES = (3.0, 3.0, 1.0)
NOTHING_AGAINST, RECEIVER_LOST = 0, 0b100
ARMED = 1


def rates(*, roll: int, pitch: int, yaw: int, throttle_limit: int = 0) -> bytes:
    """Return MSP_RC_TUNING: type ACTUAL, linear, in 10 deg/s, no expo of the throttle."""
    about = bytes([roll, 0, roll, pitch, yaw, 0, 50, 0, 0, 0, 0, yaw, pitch, 0, throttle_limit])
    return about + bytes(7) + bytes([3])


class Firmware:
    """Answers of a firmware over TCP; its flags and settings are those of a test.

    Attributes:
        channels: Channels of the newest MSP_SET_RAW_RC.
        frames: Number of them.
        asked: Number of requests by command.
    """

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self.flags, self.modes = NOTHING_AGAINST, 0
        self.channels: tuple[int, ...] = ()
        self.frames = 0
        self.asked: Counter[int] = Counter()
        self.answers = {
            111: rates(roll=18, pitch=20, yaw=6),
            44: struct.pack("<BHHH", 0, 1900, 1500, 1050),
            75: struct.pack("<BBHBHB", 5, 60, 1480, 0, 100, 0),
            90: struct.pack("<BBBBHH", 1, 1, 0, 0, 480, 550) + bytes(8),
        }
        # 1 g up at rest, of a sensor with 2048 for it; 100 deg/s about the axis forward.
        self.imu = struct.pack("<9h", 0, 0, 2048, round(100 / 2000 * 32768), 0, 0, 0, 0, 0)
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        """Answer one client until it has gone."""
        with self._server, self._server.accept()[0] as connection, suppress(ConnectionError):
            self._answer(connection)

    def _answer(self, connection: socket.socket) -> None:
        received = b""
        while data := connection.recv(4096):
            received += data
            while len(received) >= 6 and len(received) >= 6 + received[3]:
                command, payload = received[4], received[5 : 5 + received[3]]
                received = received[6 + received[3] :]
                self.asked[command] += 1
                if command == 200:
                    self.channels = struct.unpack("<8H", payload)
                    self.frames += 1
                    continue
                status = struct.pack("<HHHIBHBBB", 0, 0, 0, self.modes, 0, 0, 3, 0, 0)
                status += struct.pack("<BI", 29, self.flags)
                answers = {**self.answers, 102: self.imu, 150: status}
                connection.sendall(framed(b"$M>", command, answers[command]))


@pytest.fixture
def firmware() -> Firmware:
    """A firmware whose settings fit."""
    return Firmware()


@pytest.fixture
def driver(firmware: Firmware) -> Iterator[BetaflightAutopilot]:
    """The driver, with the pose of a motion capture, level and turned to the east."""
    port = free_udp_port()
    settings = BetaflightSettings(thrust_N=LARGEST_N, rates_rads=RATES, setpoint_timeout_s=0.5)
    pose = MavlinkLink(Endpoint(False, "127.0.0.1", port), (255, 191), 1)
    made = BetaflightAutopilot(MspLink(f"tcp:127.0.0.1:{firmware.port}"), pose, settings)
    camera = MavlinkLink(Endpoint(True, "127.0.0.1", port), (1, 197), 0)
    m = messages()
    half = math.sqrt(0.5)
    camera.send(
        m.MAVLink_odometry_message(
            *(2_500_000, 1, 1, 1.0, 2.0, -3.0, [half, 0.0, 0.0, half], 0.1, 0.2, 0.3),
            *(0.0, 0.0, 0.0, [math.nan] + [0.0] * 20, [math.nan] + [0.0] * 20),
        )
    )
    assert wait_for(lambda: (state := made.state()) is not None and state.sensed is not None)
    yield made
    made.close()
    camera.close()


def test_measurements_are_in_the_common_frame(
    firmware: Firmware, driver: BetaflightAutopilot
) -> None:
    """Place, velocity and attitude of the motion capture; rates and specific force of the firmware, turned."""
    state = driver.state()
    assert state is not None
    assert state.sensed is not None
    expected = [1.0, 2.0, -3.0, 0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2]
    np.testing.assert_allclose(state.sensed[:9], expected, atol=1e-6)
    np.testing.assert_allclose(state.sensed[9:12], [math.radians(100), 0, 0], atol=1e-3)
    np.testing.assert_allclose(state.sensed[12:], [0, 0, -9.80665], atol=1e-9)
    assert (state.position_s, state.armed, state.says) == (2.5, False, "")
    # Twice as much in flight is no other unit.
    firmware.imu = struct.pack("<9h", 0, 0, 4096, *[0] * 6)
    twice = pytest.approx(-2 * 9.80665)
    assert wait_for(
        lambda: (
            (now := driver.state()) is not None
            and now.sensed is not None
            and now.sensed[14] == twice
        )
    )


def test_settings_are_checked(firmware: Firmware, driver: BetaflightAutopilot) -> None:
    """Those that fit are met; one that does not is named, with what is expected."""
    assert wait_for(lambda: all(finding.got for finding in driver.findings()))
    assert all(finding.is_met for finding in driver.findings())

    other = Firmware()
    other.answers[75] = struct.pack("<BBHBHB", 15, 60, 1480, 0, 100, 1)
    other.answers[111] = rates(roll=18, pitch=17, yaw=18, throttle_limit=1)
    other.answers[90] = struct.pack("<BBBBHH", 1, 1, 0, 0, 480, 550) + bytes([0, 0, 0, 1] * 2)
    settings = BetaflightSettings(thrust_N=LARGEST_N, rates_rads=RATES, setpoint_timeout_s=0.5)
    pose = MavlinkLink(Endpoint(False, "127.0.0.1", free_udp_port()), (255, 191), 1)
    made = BetaflightAutopilot(MspLink(f"tcp:127.0.0.1:{other.port}"), pose, settings)
    assert wait_for(lambda: all(finding.got for finding in made.findings()))
    unmet = [str(finding) for finding in made.findings() if not finding.is_met]
    made.close()
    assert unmet == [
        "rates: expected ACTUAL, linear, at least 172, 172, 57 deg/s, got type 3, linear, "
        "180, 170, 180 deg/s (channels are body rates)",
        "throttle: expected no expo, no limit, got expo 0, limit 1 (thrust follows the channel)",
        "failsafe_procedure: expected AUTO-LAND, got DROP (it levels without setpoints)",
        "failsafe_delay: expected at most 5, got 15 (tenths of a second until then)",
        "gyro_high_fsr: expected OFF, got ON (unit of the body rates)",
    ]


def test_it_arms_once_nothing_is_against_it(
    firmware: Firmware, driver: BetaflightAutopilot
) -> None:
    """The throttle is low; the switch goes up only when asked, half a second after the last reason against it."""
    firmware.flags = RECEIVER_LOST
    assert wait_for(lambda: (state := driver.state()) is not None and "receiver" in state.says)
    driver.arm()
    for ms in range(0, 2000, 20):
        driver.attend(ms * 10**6)
    assert wait_for(lambda: firmware.frames >= 90)
    assert firmware.channels[:5] == (1500, 1500, 1000, 1500, 1000)

    firmware.flags = NOTHING_AGAINST
    assert wait_for(lambda: (state := driver.state()) is not None and not state.says)
    assert firmware.frames == 100  # one each 20 ms
    driver.attend(2_400 * 10**6)
    driver.attend(2_419 * 10**6)
    assert wait_for(lambda: firmware.frames == 101)
    assert firmware.channels[4] == 1000
    driver.attend(2_600 * 10**6)
    assert wait_for(lambda: firmware.channels[4] == 2000)
    assert firmware.channels[2] == 1000
    assert firmware.frames == 102


def test_thrust_and_rates_become_channels(firmware: Firmware, driver: BetaflightAutopilot) -> None:
    """The output of a rotor is the root of the share of thrust, above idle; full sticks are 180, 200 and 60 deg/s."""
    assert wait_for(lambda: all(finding.got for finding in driver.findings()))
    share = 0.64
    driver.command(share * LARGEST_N, np.radians([90.0, 100.0, -60.0]), 0.0)
    assert wait_for(lambda: firmware.frames == 1)
    roll, pitch, throttle, yaw, switch, *_ = firmware.channels
    assert (roll, pitch, yaw, switch) == (1750, 1250, 1000, 2000)
    # The firmware's way back: idle + (1 - idle) (throttle - 1050) / 950.
    output = 0.055 + 0.945 * (throttle - 1.9 - 1050) / 950
    assert output**2 == pytest.approx(share, abs=2e-3)


def test_no_frame_without_a_setpoint(firmware: Firmware, driver: BetaflightAutopilot) -> None:
    """In flight, and by a process that returns to a flying UAV, only setpoints are sent; none after the release."""
    assert wait_for(lambda: all(finding.got for finding in driver.findings()))
    firmware.modes = ARMED
    assert wait_for(lambda: (state := driver.state()) is not None and state.armed)
    driver.attend(10**9)
    driver.command(20.0, np.zeros(3), 0.0)
    assert wait_for(lambda: firmware.frames == 1)
    firmware.modes = 0
    assert wait_for(lambda: (state := driver.state()) is not None and not state.armed)
    driver.attend(2 * 10**9)
    driver.hold()
    driver.command(20.0, np.zeros(3), 0.0)
    driver.close()
    assert firmware.frames == 1


def test_the_status_says_what_is_against_arming(
    firmware: Firmware, driver: BetaflightAutopilot
) -> None:
    """By the bits of fc/runtime_config.h; setpoints are of use unless the receiver has failed."""

    def is_said(text: str) -> bool:
        state = driver.state()
        return state is not None and state.says == text

    for bits, says, is_heard in (
        ((2, 7, 28), "receiver lost, throttle, arm switch", False),
        ((1,), "failsafe", False),
        ((0, 3, 8, 12, 21), "no gyro, not disarmed, angle, calibrating, reboot required", True),
    ):
        firmware.flags = sum(1 << bit for bit in bits)
        assert wait_for(partial(is_said, says))
        state = driver.state()
        assert state is not None
        assert (state.takes_setpoints, state.mode) == (is_heard, "not armed")
    firmware.modes = ARMED
    assert wait_for(lambda: (now := driver.state()) is not None and now.armed)
    state = driver.state()
    assert state is not None
    assert (state.mode, state.battery, state.thrust_N) == ("armed", -1.0, None)
    # Modes beyond the first 32, whose number is in the lower half of a byte, stand before the flags.
    status = struct.pack("<HHHIBHBBB", 0, 0, 0, 0b10, 0, 0, 3, 0, 0xF2)
    assert _armed_and_flags(status + b"\xff\xff" + struct.pack("<BI", 29, 5)) == (False, 5)


def test_it_is_silent_two_seconds_after_the_last_answer(
    driver: BetaflightAutopilot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of its status or its sensors; a pose alone is none of the firmware. Age is that of the older one."""
    s = 10**9
    driver._is_closed = True
    for thread in driver._threads:
        thread.join()
    assert driver._odometry is not None
    driver._odometry = driver._odometry[0], 7 * s
    for status_s, imu_s in ((3, 4), (4, 3)):
        driver._answers[150] = driver._answers[150][0], status_s * s
        driver._answers[102] = driver._answers[102][0], imu_s * s
        monkeypatch.setattr(time, "monotonic_ns", lambda: 6 * s)
        state = driver.state()
        assert state is not None
        assert (state.position_ns, state.attitude_ns) == (7 * s, imu_s * s)
        monkeypatch.setattr(time, "monotonic_ns", lambda: 6 * s + 1)
        assert driver.state() is None
    assert driver.silence() == "no sign of life from the autopilot"


def test_axes_of_the_firmware_are_forward_left_up() -> None:
    """Left and up become right and down; roll, pitch and yaw are those of the motion capture's attitude."""
    quaternion = Rotation.from_euler("ZYX", [1.1, -0.2, 0.3]).as_quat(scalar_first=True)
    odometry = SimpleNamespace(x=1.0, y=2.0, z=-3.0, vx=0.1, vy=0.2, vz=0.3, q=quaternion)
    imu = struct.pack("<9h", 512, 1024, 2048, 1638, 3277, -4915, 0, 0, 0)
    sensed = _sensed(odometry, imu, 2048.0)
    np.testing.assert_allclose(sensed[:9], [1.0, 2.0, -3.0, 0.1, 0.2, 0.3, 0.3, -0.2, 1.1])
    rates = np.radians([100.0, -200.0, 300.0])  # of 2000 deg/s at 32768
    np.testing.assert_allclose(sensed[9:12], rates, atol=1e-3)
    np.testing.assert_allclose(sensed[12:], 9.80665 * np.array([0.25, -0.5, -1.0]))


@pytest.mark.parametrize(
    ("reading", "unit"),
    [(250, 256), (370, 512), (1100, 1024), (2048, 2048), (4500, 4096), (0, 256)],
)
def test_the_unit_of_the_accelerometer_is_the_nearest_one(reading: int, unit: float) -> None:
    """By the size of the specific force of a vehicle at rest, whichever way it lies."""
    assert _unit_of(struct.pack("<9h", 0, -reading, 0, *[0] * 6)) == unit


def test_rates_have_to_be_linear_and_large_enough() -> None:
    """Each byte of MSP_RC_TUNING on which they depend is looked at; a rate that is exactly enough is."""
    fitting = rates(roll=18, pitch=17, yaw=6)
    least_deg_s = np.array([180.0, 170.0, 60.0])
    assert _rates_fit(fitting, least_deg_s) == (True, "type 3, linear, 180, 170, 60 deg/s")
    for axis in range(3):
        assert not _rates_fit(fitting, least_deg_s + 0.1 * np.eye(3)[axis])[0]
    # Rates at the centre, expo, and largest rates, about roll, pitch and yaw; the type.
    changed = {at: bytes([*fitting[:at], fitting[at] + 1, *fitting[at + 1 :]]) for at in range(23)}
    wrong = [at for at, tuning in changed.items() if not _rates_fit(tuning, least_deg_s)[0]]
    assert wrong == [0, 1, 2, 3, 4, 10, 11, 12, 13, 22]
    assert _rates_fit(changed[13], least_deg_s)[1] == "type 3, not linear, 180, 170, 60 deg/s"
    assert [at for at, tuning in changed.items() if not _throttle_fits(tuning)[0]] == [7, 14]
    assert _throttle_fits(changed[7])[1] == "expo 1, limit 0"


@pytest.mark.parametrize(("tenths", "fits"), [(4, True), (5, True), (6, False)])
def test_the_fail_safe_begins_in_time_and_lands(tenths: int, fits: bool) -> None:
    """Its delay in tenths of a second, and its procedure by name."""
    failsafe = struct.pack("<BBHBHB", tenths, 60, 1480, 0, 100, 2)
    assert _delay_fits(failsafe, 5.0) == (fits, str(tenths))
    assert _procedure_fits(failsafe) == (False, "GPS-RESCUE")


def test_settings_are_asked_for_until_they_are_known(
    firmware: Firmware, driver: BetaflightAutopilot
) -> None:
    """Those that have no answer yet do not fit, and have no value; sensors and status are asked for on."""
    answers, driver._answers = driver._answers, {}
    unknown = driver.findings()
    driver._answers = answers
    assert {(one.got, one.is_met) for one in unknown} == {("", False)}
    assert wait_for(lambda: {44, 90} <= answers.keys())
    for missing in (44, 90):
        driver._answers = {key: each for key, each in answers.items() if key != missing}
        assert driver.findings()[-1].got == ""
    driver._answers = answers
    assert wait_for(lambda: all(finding.got for finding in driver.findings()))
    before = dict(firmware.asked)
    assert wait_for(lambda: firmware.asked[102] >= before[102] + 70)  # 0.7 s; settings each 0.5 s
    assert {before[command] == firmware.asked[command] for command in (111, 44, 75, 90)} == {True}
    sensors, status = (firmware.asked[command] - before[command] for command in (102, 150))
    assert 5 < sensors / status < 20  # 100 and 10 times a second


def test_setpoints_are_cut_to_what_channels_can_tell(
    firmware: Firmware, driver: BetaflightAutopilot
) -> None:
    """Thrust between idle and full, rates of full sticks; none before the settings are known or after a landing."""
    answers, driver._answers = driver._answers, {}
    driver.command(20.0, np.zeros(3), 0.0)
    assert not driver._has_flown
    driver._answers = answers
    assert wait_for(lambda: all(finding.got for finding in driver.findings()))
    given: list[tuple[int, ...]] = []
    for thrust_N, rate in ((-1.0, -9.0), (0.0, 0.0), (2.0 * LARGEST_N, 9.0)):
        driver.command(thrust_N, np.full(3, rate), 0.0)
        assert wait_for(lambda: firmware.frames == len(given) + 1)
        given.append(firmware.channels)
    assert given == [
        (1000, 2000, 1052, 1000, 2000, 1000, 1000, 1000),
        (1500, 1500, 1052, 1500, 2000, 1000, 1000, 1000),
        (2000, 1000, 2000, 2000, 2000, 1000, 1000, 1000),
    ]
    driver.land()
    driver.command(20.0, np.zeros(3), 0.0)
    driver.close()
    assert firmware.frames == 3
