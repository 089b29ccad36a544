"""The stand-in autopilot: its estimate, its frame, and the messages that it sends and obeys."""

import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.bench import free_udp_port
from transport.plant.autopilot import stand_in
from transport.plant.autopilot.copter_control import GUIDED
from transport.plant.autopilot.stand_in import StandIn, Wandering
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages

# 10 m to the north and to the east of 47 deg N, 8 deg E on a sphere of 6,378,137 m, in 1e-7 deg:
# 10 / 111,319.49, and that divided by cos 47 deg = 0.6819984.
NORTH, EAST = 470_000_898, 80_001_317
# Roll 0.3, pitch -0.2, yaw 1.1 rad, scalar first.
TILTED = Rotation.from_euler("ZYX", [1.1, -0.2, 0.3]).as_quat(scalar_first=True).tolist()


class Told:
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def send(self, message: Any) -> None:
        """Keep a message."""
        self.sent.append(message)

    def last(self, name: str) -> Any:
        """Return the newest message of a name."""
        return next(one for one in reversed(self.sent) if one.msgname == name)


@pytest.fixture
def copter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIn]:
    """A stand-in without errors of its estimate, at 47 deg N, 8 deg E, with a link that keeps."""
    monkeypatch.chdir(tmp_path)
    exact = {name: (0.0, time_s) for name, (_, time_s) in stand_in._ERRORS.items()}
    monkeypatch.setattr(stand_in, "_ERRORS", exact)
    made = StandIn(stand_in._options(["--serial1", "udpclient:127.0.0.1:9"]))
    made.link.close()
    made.link = Told()  # type: ignore[assignment]
    yield made
    made._record.close()


def physics(time_s: float, place: tuple[float, float, float] = (12.0, 13.0, -20.0)) -> bytes:
    """Return what the physics tells."""
    told = {
        "timestamp": time_s, "position": place, "velocity": [1.0, 2.0, 3.0], "quaternion": TILTED,
        "imu": {"gyro": [0.1, 0.2, 0.3], "accel_body": [0.980665, 1.96133, -9.80665]},
    }  # fmt: skip
    return json.dumps(told).encode()


def ask(copter: StandIn, name: str) -> Any:
    """Return the message that it sends when asked for one by name; None without."""
    sent: list[Any] = copter.link.sent  # type: ignore[attr-defined]
    before = len(sent)
    copter._tell(name)
    return sent[-1] if len(sent) > before else None


def command(copter: StandIn, number: int, first: float, second: float = 0.0) -> int:
    """Return the acknowledged result of a command."""
    m = messages()
    copter._take(m.MAVLink_command_long_message(1, 1, number, 0, first, second, 0, 0, 0, 0, 0))
    ack = copter.link.last("COMMAND_ACK")  # type: ignore[attr-defined]
    assert ack.command == number
    return int(ack.result)


def test_errors_wander_with_their_size_and_correlation() -> None:
    """They have the deviation named, and a share exp(-1) is left after the time named."""
    expected = {
        "position": (0.05, 5.0), "velocity": (0.03, 2.0), "attitude": (0.004, 10.0), "gyro": (0.004, 0.02),
        "force": (0.05, 0.02),
    }  # fmt: skip
    for name, (size, time_s) in expected.items():
        errors = Wandering(1)
        seen = []
        for _ in range(1_000):
            errors.advance(time_s)
            seen.append(errors.values[name])
        values = np.array(seen)
        assert np.sqrt(np.mean(values**2)) == pytest.approx(size, rel=0.1), name
        left = np.mean(values[1:] * values[:-1]) / np.mean(values**2)
        assert left == pytest.approx(0.368, abs=0.1), name


def test_its_place_is_in_the_frame_of_a_given_origin(copter: StandIn) -> None:
    """With an origin 10 m north-east of the home and 5 m above, 12 m and 13 m become 2 m and 3 m."""
    m = messages()
    copter._take(m.MAVLink_set_gps_global_origin_message(1, NORTH, EAST, 5_000))
    copter.step(physics(2.5))
    told = ask(copter, "LOCAL_POSITION_NED")
    assert (told.x, told.y, told.z) == pytest.approx((2.0, 3.0, -15.0), abs=0.02)
    assert (told.vx, told.vy, told.vz) == (1.0, 2.0, 3.0)
    origin = ask(copter, "GPS_GLOBAL_ORIGIN")
    assert (origin.latitude, origin.longitude, origin.altitude) == (NORTH, EAST, 5_000)
    copter._take(m.MAVLink_set_gps_global_origin_message(1, 0, 0, 0))  # the first one holds
    assert ask(copter, "GPS_GLOBAL_ORIGIN").latitude == NORTH


def test_it_chooses_an_origin_when_it_is_ready(copter: StandIn) -> None:
    """The place where it is after 2 s; before it tells neither a place nor an origin."""
    copter.step(physics(1.9))
    assert ask(copter, "LOCAL_POSITION_NED") is None
    assert ask(copter, "GPS_GLOBAL_ORIGIN") is None
    assert ask(copter, "EKF_STATUS_REPORT").flags == 128 + 1  # constant position, attitude
    copter.step(physics(2.0, (10.0, 10.0, -20.0)))
    copter.step(physics(2.1, (11.0, 13.0, -24.0)))
    told = ask(copter, "LOCAL_POSITION_NED")
    assert (told.x, told.y, told.z) == pytest.approx((1.0, 3.0, -4.0), abs=1e-6)
    origin = ask(copter, "GPS_GLOBAL_ORIGIN")
    assert (origin.latitude, origin.longitude, origin.altitude) == (NORTH, EAST, 20_000)
    # All but the height above ground, 64, and constant position, 128.
    assert ask(copter, "EKF_STATUS_REPORT").flags == 1 + 2 + 4 + 8 + 16 + 32 + 256 + 512


def test_it_arms_once_it_is_ready(copter: StandIn) -> None:
    """Before 2 s it refuses and says why; the heartbeat tells mode and arming."""
    m = messages()
    assert command(copter, m.MAV_CMD_DO_SET_MODE, 1.0, GUIDED) == m.MAV_RESULT_ACCEPTED
    assert command(copter, m.MAV_CMD_DO_SET_MODE, 1.0, 99.0) == m.MAV_RESULT_DENIED
    copter.step(physics(1.9))
    assert command(copter, m.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == m.MAV_RESULT_FAILED
    said = copter.link.last("STATUSTEXT")  # type: ignore[attr-defined]
    assert (said.severity, said.text) == (4, "Arm: Need Position Estimate")
    assert ask(copter, "HEARTBEAT").base_mode == 1
    copter.step(physics(2.0))
    assert command(copter, m.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == m.MAV_RESULT_ACCEPTED
    beat = ask(copter, "HEARTBEAT")
    told = beat.type, beat.autopilot, beat.base_mode, beat.custom_mode, beat.system_status
    assert told == (2, 3, 128 + 1, 4, 4)  # quadrotor, ArduPilot, armed, GUIDED, active
    assert command(copter, m.MAV_CMD_COMPONENT_ARM_DISARM, 0.0) == m.MAV_RESULT_ACCEPTED
    assert ask(copter, "HEARTBEAT").base_mode == 1


def test_what_it_measures_is_told(copter: StandIn) -> None:
    """Attitude in rad, specific force in thousandths of 9.80665 m/s^2, battery in %, thrust as a share."""
    copter.step(physics(2.5))
    attitude = ask(copter, "ATTITUDE")
    angles = attitude.roll, attitude.pitch, attitude.yaw
    assert angles == pytest.approx((0.3, -0.2, 1.1), abs=1e-12)
    assert attitude.time_boot_ms == 2500
    assert (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed) == (0.1, 0.2, 0.3)
    force = ask(copter, "SCALED_IMU")
    assert (force.xacc, force.yacc, force.zacc) == (100, 200, -1000)
    battery = ask(copter, "SYS_STATUS")
    told = battery.voltage_battery, battery.current_battery, battery.battery_remaining
    assert told == (16_000, 500, 90)
    copter._outputs = (0.25, 0.36, 0.49, 0.64)
    target = ask(copter, "ATTITUDE_TARGET")
    assert target.thrust == pytest.approx((0.25 + 0.36 + 0.49 + 0.64) / 4)
    assert target.q == pytest.approx(TILTED)


def test_pulses_are_square_roots_of_thrusts(copter: StandIn) -> None:
    """Packets of outputs are counted, with pulses of 1,000 to 2,000 us; 12 channels are not used."""
    copter._outputs = (0.25, 0.36, 0.49, 1.0)
    for count in (1, 2):
        expected = 18458, 400, count, 1500, 1600, 1700, 2000, *[0] * 12
        assert struct.unpack("<HHI16H", copter.servos()) == expected


def test_parameters_and_setpoints_are_taken(copter: StandIn, tmp_path: Path) -> None:
    """A parameter that is set is told back; obeyed setpoints are recorded with both clocks."""
    m = messages()
    copter._take(m.MAVLink_param_set_message(1, 1, b"STAND_BATTERY", 35.0, 9))
    value = copter.link.last("PARAM_VALUE")  # type: ignore[attr-defined]
    assert (value.param_id, value.param_value) == ("STAND_BATTERY", 35.0)
    assert ask(copter, "SYS_STATUS").battery_remaining == 35
    setpoint = m.MAVLink_set_attitude_target_message(
        1500, 1, 1, 128, [1, 0, 0, 0], 0.1, 0.2, 0.3, 0.6
    )
    copter._take(setpoint)  # not armed: not obeyed
    copter.step(physics(2.5))
    assert copter.control.change_mode(GUIDED)
    assert not copter.control.arm("")
    copter._take(setpoint)
    text = (tmp_path / "setpoints.csv").read_text(encoding="ascii")
    assert text == "2.5000,1.5000,0.6000,0.1000,0.2000,0.3000\n"


def test_rotations() -> None:
    """Products and angles are those of scipy."""
    a, b = Rotation.random(2, rng=np.random.default_rng(3))
    first, second = (tuple(one.as_quat(scalar_first=True).tolist()) for one in (a, b))
    product = stand_in._multiplied(first, second)
    assert Rotation.from_quat(product, scalar_first=True).approx_equal(a * b, atol=1e-12)
    assert stand_in._euler(first) == pytest.approx(a.as_euler("ZYX")[::-1], abs=1e-12)


def test_errors_begin_with_their_size() -> None:
    """The first errors of many autopilots have the deviation named: each autopilot has its own ones."""
    first = [Wandering(seed).values for seed in range(200)]
    expected = {"position": 0.05, "velocity": 0.03, "attitude": 0.004, "gyro": 0.004, "force": 0.05}
    for name, size in expected.items():
        values = np.array([one[name] for one in first])
        assert np.sqrt(np.mean(values**2)) == pytest.approx(size, rel=0.15), name
        assert len(np.unique(values)) == values.size


def test_its_estimate_is_the_state_of_the_physics_with_errors(
    copter: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each quantity has its own error; a shift that is asked for is to the north."""
    turned = 0.002, -0.004, 0.006
    monkeypatch.setattr(copter._errors, "advance", lambda _: None)
    copter._errors.values = {
        "position": (0.1, 0.2, 0.3), "velocity": (0.01, 0.02, 0.03), "attitude": turned,
        "gyro": (0.04, 0.05, 0.06), "force": (0.07, 0.08, 0.09),
    }  # fmt: skip
    copter.parameters["STAND_JUMP"] = 5.0
    copter.step(physics(2.5))
    own = copter._estimate
    assert own.position == pytest.approx((5.1, 0.2, 0.3), abs=1e-6)
    assert own.velocity == pytest.approx((1.01, 2.02, 3.03))
    assert own.gyro == pytest.approx((0.14, 0.25, 0.36))
    assert copter._force == pytest.approx((1.050665, 2.04133, -9.71665))
    expected = Rotation.from_quat(TILTED, scalar_first=True) * Rotation.from_rotvec(turned)
    assert Rotation.from_quat(own.attitude, scalar_first=True).approx_equal(expected, atol=1e-6)


def test_it_goes_on_by_the_time_of_the_physics(
    copter: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a step of 1/400 s at its start, after a gap of more than 1 s, and where time does not go on."""
    steps_s: list[float] = []
    monkeypatch.setattr(copter._errors, "advance", steps_s.append)
    for time_s in (2.5, 2.75, 2.75, 3.75, 5.0, 4.5):
        copter.step(physics(time_s))
        assert copter.time_s == time_s
    assert steps_s == [0.0025, 0.25, 0.0025, 1.0, 0.0025, 0.0025]


def test_a_pilot_arms_it_once_it_is_ready(copter: StandIn) -> None:
    """In GUIDED, if one is asked for; each time that it is disarmed."""
    copter.step(physics(2.0))
    assert not copter.control.is_armed
    copter.parameters["STAND_PILOT"] = 1.0
    copter.step(physics(1.9))
    assert not copter.control.is_armed
    for time_s in (2.0, 2.1):
        copter.control.is_armed = False
        copter.step(physics(time_s))
        assert (copter.control.is_armed, copter.control.mode) == (True, GUIDED)


def test_messages_come_at_their_intervals(copter: StandIn) -> None:
    """HEARTBEAT and SYS_STATUS each second, others as asked for; after a gap two are made up for at most."""
    m = messages()
    copter._origin = [47.0, 8.0, 0.0]

    def told(*times_s: float) -> list[str]:
        sent: list[Any] = copter.link.sent  # type: ignore[attr-defined]
        sent.clear()
        for copter.time_s in times_s:
            copter.tell()
        return [one.msgname for one in sent]

    both = ["HEARTBEAT", "SYS_STATUS"]
    assert [told(time_s) for time_s in (0.0, 0.75, 1.0)] == [both, [], both]
    every_250_ms = m.MAVLINK_MSG_ID_ATTITUDE, 250_000.0
    accepted = command(copter, m.MAV_CMD_SET_MESSAGE_INTERVAL, *every_250_ms)
    assert accepted == m.MAV_RESULT_ACCEPTED
    found = [told(time_s) for time_s in (1.0, 1.125, 1.25, 1.5)]
    assert found == [["ATTITUDE"], [], ["ATTITUDE"], ["ATTITUDE"]]
    assert told(*[4.625] * 6).count("ATTITUDE") == 3
    for never in (0.0, -1.0):
        command(copter, m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_ATTITUDE, never)
        assert "ATTITUDE" not in told(9.0)


def test_a_message_or_parameter_is_told_once_when_asked_for(copter: StandIn) -> None:
    """A command that it does not know is unsupported, a parameter that it does not have is neither told nor set."""
    m = messages()
    asked = command(copter, m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_SYS_STATUS)
    sent: list[Any] = copter.link.sent  # type: ignore[attr-defined]
    assert (asked, [one.msgname for one in sent]) == (0, ["SYS_STATUS", "COMMAND_ACK"])
    assert command(copter, m.MAV_CMD_NAV_LAND, 0.0) == m.MAV_RESULT_UNSUPPORTED
    copter._take(m.MAVLink_param_request_read_message(1, 1, b"GUID_TIMEOUT", -1))
    told = sent[-1]
    assert (told.param_id, told.param_value, told.param_type) == ("GUID_TIMEOUT", 3.0, 9)
    before = len(sent), dict(copter.parameters)
    copter._take(m.MAVLink_param_request_read_message(1, 1, b"NONE", -1))
    copter._take(m.MAVLink_param_set_message(1, 1, b"NONE", 1.0, 9))
    assert (len(sent), copter.parameters) == before


def test_it_hears_what_is_for_its_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or for all, on a link with the key of its options; its packets have its number."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "key").write_text("ab" * 32)
    port = free_udp_port()
    key = bytes.fromhex("ab" * 32)
    companion = MavlinkLink(Endpoint(False, "127.0.0.1", port), (255, 191), 3, key)
    link = f"udpclient:127.0.0.1:{port}"
    options = ["--sysid", "3", "--serial1", link, "--signing-key", "key"]
    copter = StandIn(stand_in._options(options))
    copter._say("here")
    (heard,) = companion.receive(1.0)
    assert (heard.get_srcSystem(), heard.get_srcComponent(), heard.text) == (3, 1, "here")
    for system, charge, taken in ((3, 50.0, 50.0), (7, 20.0, 50.0), (0, 40.0, 40.0)):
        for value in (charge + 1.0, charge):  # all messages that have come
            companion.send(
                messages().MAVLink_param_set_message(system, 1, b"STAND_BATTERY", value, 9)
            )
        copter.hear()
        assert copter.parameters["STAND_BATTERY"] == taken
    companion.close()
    copter.close()


def test_outputs_are_sent_again_until_the_physics_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same packet; each answer brings the next one, and what the companion asks for; without physics it ends."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stand_in, "_AGAIN_S", 0.05)
    monkeypatch.setattr(stand_in, "_ORPHAN_S", 0.5)
    m = messages()
    port = free_udp_port()
    companion = MavlinkLink(Endpoint(False, "127.0.0.1", port), (255, 191), 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as world:
        world.bind(("127.0.0.1", 0))
        world.settimeout(5.0)
        own_port = str(world.getsockname()[1])
        options = ["--sim-port-out", own_port, "--serial1", f"udpclient:127.0.0.1:{port}"]
        copter = threading.Thread(target=stand_in.main, args=(options,), daemon=True)
        copter.start()
        numbers, told = [], []
        for _ in range(2):
            packet, there = world.recvfrom(4096)
            numbers.append(struct.unpack_from("<HHI", packet)[2])
        begun_s = time.monotonic()
        step = 0
        while time.monotonic() < begun_s + 0.7:
            step += 1
            world.sendto(physics(0.0025 * step), there)
            while numbers[-1] == step:
                numbers.append(struct.unpack_from("<HHI", world.recv(4096))[2])
            told += [one.msgname for one in companion.receive(0.1)]
            if step == 1:
                ask = m.MAVLink_param_request_read_message(1, 1, b"GUID_TIMEOUT", -1)
                companion.send(ask)
        assert copter.is_alive()
        copter.join(5.0)
    companion.close()
    assert not copter.is_alive()
    assert numbers[:2] == [1, 1]
    assert numbers[-1] == step + 1
    assert told == ["HEARTBEAT", "SYS_STATUS", "PARAM_VALUE"]


def test_options_are_those_of_ardupilots_simulator(tmp_path: Path) -> None:
    """With its defaults; others are ignored. A file has a parameter a line, with a space or a comma."""
    own = stand_in._options(["--wipe", "-I", "3", "--speedup", "100"])
    assert vars(own) == {
        "sysid": 1, "home": "47.0,8.0,0,0", "defaults": None, "sim_address": "127.0.0.1",
        "sim_port_out": 9002, "serial1": "udpclient:127.0.0.1:14550", "signing_key": None,
    }  # fmt: skip
    path = tmp_path / "defaults.parm"
    path.write_text("GUID_TIMEOUT 0.5\n\nMOT_THST_HOVER,0.25\n", encoding="ascii")
    assert stand_in._read_parameters(path) == {"GUID_TIMEOUT": 0.5, "MOT_THST_HOVER": 0.25}
    assert stand_in._read_parameters(None) == {}
