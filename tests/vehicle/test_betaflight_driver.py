"""The driver of Betaflight above a firmware that answers MSP and records its receiver's channels."""

import math
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import pytest

from tests.support.bench import free_udp_port
from tests.support.commands import wait_for
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages
from transport.vehicle.betaflight_driver import BetaflightAutopilot, BetaflightSettings
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
    """

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self.flags, self.modes = NOTHING_AGAINST, 0
        self.channels: tuple[int, ...] = ()
        self.frames = 0
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


def test_measurements_are_in_the_common_frame(driver: BetaflightAutopilot) -> None:
    """Place, velocity and attitude of the motion capture; rates and specific force of the firmware, turned."""
    state = driver.state()
    assert state is not None
    assert state.sensed is not None
    expected = [1.0, 2.0, -3.0, 0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2]
    np.testing.assert_allclose(state.sensed[:9], expected, atol=1e-6)
    np.testing.assert_allclose(state.sensed[9:12], [math.radians(100), 0, 0], atol=1e-3)
    np.testing.assert_allclose(state.sensed[12:], [0, 0, -9.80665], atol=1e-9)
    assert (state.position_s, state.armed, state.says) == (2.5, False, "")


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
    driver.attend(2_400 * 10**6)
    driver.attend(2_600 * 10**6)
    assert wait_for(lambda: firmware.channels[4] == 2000)
    assert firmware.channels[2] == 1000


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
