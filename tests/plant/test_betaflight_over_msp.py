"""Betaflights on their links, above firmwares with given outputs: sensors, motion capture and settings."""

import math
import select
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.plant.test_betaflight import Packets
from tests.support.bench import free_udp_port
from transport.flight.roles import plant_run
from transport.model.physics.rotations import rotation
from transport.model.state import SENSED
from transport.plant.autopilot import betaflight_over_msp
from transport.plant.autopilot.betaflight_over_msp import Betaflights
from transport.plant.firmware.firmware_process import FirmwareError
from transport.plant.firmware.tuning import rotors_of
from transport.plant.inner_loops import checked_firmware
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.network.mavlink import Endpoint, MavlinkLink
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup

TIMEOUT_S = 0.47


def plant(*settings: str) -> PlantRun:
    """Return the plant of the ready scenario above Betaflights."""
    path = find_scenario("flight")
    changed = "plant.autopilot=betaflight", f"vehicles.setpoint_timeout_s={TIMEOUT_S}", *settings
    return plant_run(Setup.of(read_scenario(path, changed), str(path)))


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[str]]:
    """Start no firmwares; return the lines of settings that are made."""
    lines: list[Sequence[str]] = []

    def settings(given: Sequence[str], step_s: float) -> bytes:
        assert step_s == 1e-3
        lines.append(given)
        return b""

    monkeypatch.setattr(Packets, "started", [])
    monkeypatch.setattr(betaflight_over_msp, "Process", Packets)
    monkeypatch.setattr(betaflight_over_msp, "eeprom_after", settings)
    return lines


@pytest.fixture
def bank(made: list[Sequence[str]], poses: MavlinkLink) -> Betaflights:
    """The firmwares."""
    return Betaflights(plant(), PORT)


PORT = free_udp_port()


@pytest.fixture
def poses() -> Iterator[MavlinkLink]:
    """The end of the motion capture of UAV 1."""
    link = MavlinkLink(Endpoint(False, "127.0.0.1", PORT), (255, 191), 1)
    yield link
    link.close()


def test_rotors_push_by_the_square_of_their_outputs(bank: Betaflights) -> None:
    """Thrust and moments are those of (56) for thrusts T_max o^2; none after a failure, which is told."""
    Packets.started[1].given = (0.6, 0.2, 1.2, -0.1)
    found = bank.inputs().reshape(-1, 4)
    expected = [[0.5**2] * 4, [0.36, 0.04, 1.0, 0.0], [0.5**2] * 4, [0.5**2] * 4]
    for inputs, squares, rotors in zip(found, expected, rotors_of(plant()), strict=True):
        thrusts_N = rotors.thrust_N[1] * np.array(squares)
        np.testing.assert_allclose(inputs, Rotors(rotors).mixing @ thrusts_N, atol=1e-12)

    Packets.started[2].given = ()
    assert not bank.inputs().any()
    assert bank.failure == "a firmware has not answered"


@pytest.mark.parametrize("Theta", [(0.4, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.4)])
def test_sensors_have_the_signs_of_the_firmware(bank: Betaflights, Theta: Sequence[float]) -> None:
    """Force about forward, left, up negated; the attitude turns these axes in a world north, west, up."""
    sensed = np.zeros((4, SENSED))
    sensed[:, 6:] = [*Theta, 0.1, 0.2, 0.3, 1.0, 2.0, -9.0]
    bank.sense(0.0, sensed.reshape(-1))
    flipped = np.diag([1.0, -1.0, -1.0])
    for each in Packets.started:
        np.testing.assert_allclose(each.sensors[:6], [0.1, 0.2, 0.3, -1.0, 2.0, -9.0])
        w, *x_y_z = each.sensors[6:]
        turned = Rotation.from_quat([*x_y_z, w]).as_matrix()
        np.testing.assert_allclose(
            turned, flipped @ rotation(np.array(Theta)) @ flipped, atol=1e-12
        )


def test_the_motion_capture_tells_places_a_hundred_times_a_second(
    bank: Betaflights, poses: MavlinkLink
) -> None:
    """Each 10 ms: position and velocity in the common frame, attitude, and the time of the physics."""
    sensed = np.zeros((4, SENSED))
    sensed[0, :12] = [1.0, 2.0, -3.0, 0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2, 0.4, 0.5, 0.6]
    for step in range(21):
        bank.sense(2.0 + step * bank.step_s, sensed.reshape(-1))
    told = []
    while select.select([poses], [], [], 0.2)[0]:
        told += list(poses.receive(0.0))
    assert [one.time_usec for one in told] == [2_000_000, 2_010_000, 2_020_000]
    half = math.sqrt(0.5)
    for one in told:
        assert [one.x, one.y, one.z] == pytest.approx([1.0, 2.0, -3.0])
        assert [one.vx, one.vy, one.vz] == pytest.approx([0.1, 0.2, 0.3])
        assert [one.rollspeed, one.pitchspeed, one.yawspeed] == pytest.approx([0.4, 0.5, 0.6])
        assert one.q == pytest.approx([half, 0.0, 0.0, half], abs=1e-7)


def test_without_setpoints_a_firmware_levels_at_the_throttle_of_hover(
    bank: Betaflights, made: list[Sequence[str]]
) -> None:
    """After the time-out, in whole tenths of a second; equal UAVs share their settings."""
    assert bank.failure == ""
    (lines,) = made
    settings = dict(line.removeprefix("set ").split(" = ") for line in lines if " = " in line)
    assert settings["failsafe_procedure"] == "AUTO-LAND"
    assert settings["failsafe_delay"] == "4"
    setup = plant()
    output = math.sqrt(setup.run.hover.u[0] / (4.0 * rotors_of(setup)[0].thrust_N[1]))
    at_hover_us = 1050 + 950 * (output - 0.055) / 0.945  # between idle and full output
    assert int(settings["failsafe_throttle"]) == round(at_hover_us)


def test_each_firmware_has_its_settings_and_its_links(
    made: list[Sequence[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """UAV i has the i-th port of both, and the gains of its own inertia."""
    started: list[tuple[int, str]] = []

    class Started(Packets):
        def __init__(self, folder: Path, step_s: float, listener: socket.socket) -> None:
            super().__init__()
            assert (step_s, listener.getblocking()) == (1e-3, False)
            port = listener.getsockname()[1]
            started.append((port, (folder / "eeprom.bin").read_text()))

    def settings(given: Sequence[str], _: float) -> bytes:
        made.append(given)
        return str(len(made)).encode()

    monkeypatch.setattr(betaflight_over_msp, "Process", Started)
    monkeypatch.setattr(betaflight_over_msp, "eeprom_after", settings)
    bank = Betaflights(plant("system.uav.3.inertia_kgm2=[0.03,0.03,0.04]"), PORT)
    assert started == [(PORT, "1"), (PORT + 1, "1"), (PORT + 2, "2"), (PORT + 3, "1")]
    assert [link._socket.getpeername()[1] for link in bank._poses] == [PORT + i for i in range(4)]
    systems = [(link._mav.srcSystem, link._mav.srcComponent) for link in bank._poses]
    assert systems == [(i, 197) for i in (1, 2, 3, 4)]
    assert [each.exchanges for each in Packets.started] == [1] * 4
    assert [len(each.all_channels) for each in Packets.started] == [1] * 4
    processes, links = Packets.started, bank._poses
    del bank
    assert [each.ended for each in processes] == [1] * 4
    assert [link.fileno() for link in links] == [-1] * 4


def test_a_port_in_use_is_told(made: list[Sequence[str]]) -> None:
    """Of the scenario's key that starts them."""
    refused = pytest.raises(ScenarioError, match=r"plant\.autopilot: .*in use")
    with socket.create_server(("127.0.0.1", PORT)), refused:
        Betaflights(plant(), PORT)
    assert made


def test_the_first_failure_counts(bank: Betaflights, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that does not take its sensors ends the run, in its own words; no firmware is asked after it."""
    gone = ["has ended: first", "has ended: second"]

    def refuse(*_: object) -> None:
        raise FirmwareError(gone.pop(0))

    monkeypatch.setattr(Packets.started[3], "give", refuse)
    for _ in range(2):
        bank.sense(0.0, np.zeros(4 * SENSED))
    assert bank.failure == "has ended: first"
    before = Packets.started[0].exchanges
    assert not bank.inputs().any()
    assert Packets.started[0].exchanges == before


@pytest.mark.parametrize(("timeout_s", "tenths"), [(0.1, 1), (0.47, 4), (3.0, 30)])
def test_links_and_fail_safe(timeout_s: float, tenths: int) -> None:
    """Channels by MSP in every turn of the firmware; the throttle of hover is held until it levels."""
    assert list(betaflight_over_msp._links(timeout_s, 0.055)) == [
        "set serial_update_rate_hz = 1000",
        f"set failsafe_delay = {tenths}",
        "set failsafe_procedure = AUTO-LAND",
        "set failsafe_throttle = 1050",
        "set failsafe_recovery_delay = 1",
        "rxfail 3 h",
    ]


def test_the_version_is_that_of_the_firmware(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """By the name of its program; without it the error names the key."""
    monkeypatch.setattr(betaflight_over_msp, "executable", lambda: tmp_path / "betaflight_4_SITL")
    monkeypatch.setattr(betaflight_over_msp, "virtual_time", lambda: tmp_path)
    assert checked_firmware(plant()) == "betaflight on its links, betaflight_4_SITL"

    def missing() -> Path:
        raise FirmwareError("no firmware")

    monkeypatch.setattr(betaflight_over_msp, "executable", missing)
    with pytest.raises(ScenarioError, match=r"plant\.autopilot: no firmware"):
        checked_firmware(plant())
