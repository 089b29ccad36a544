"""Betaflights on their links, above firmwares with given outputs: sensors, motion capture and settings."""

import math
import select
from collections.abc import Iterator, Sequence

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
from transport.plant.firmware.tuning import rotors_of
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.network.mavlink import Endpoint, MavlinkLink
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup

TIMEOUT_S = 0.47


def plant() -> PlantRun:
    """Return the plant of the ready scenario above Betaflights."""
    path = find_scenario("flight")
    changed = "plant.autopilot=betaflight", f"vehicles.setpoint_timeout_s={TIMEOUT_S}"
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
    sensed[0, :9] = [1.0, 2.0, -3.0, 0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2]
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
