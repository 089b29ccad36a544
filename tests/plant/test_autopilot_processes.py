"""The physics side of ArduPilot's JSON interface, and the options with which autopilots start."""

import json
import math
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from transport.flight.roles import plant_run
from transport.model.state import INPUTS, SENSED
from transport.plant.autopilot import autopilot_processes
from transport.plant.autopilot.autopilot_processes import (
    FOLDER,
    PROGRAM,
    Autopilots,
    program,
    version,
)
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "flight.toml"
LARGEST_N = 34.2  # four rotors of 8.55 N at a pulse of 2 ms
# As ArduCopter does it: from a port that it has not told, every packet again, as if the physics were late.
COPTER = f"""#!{sys.executable}
import json, pathlib, socket, struct, sys
pathlib.Path("options.json").write_text(json.dumps(sys.argv[1:]))
there = "127.0.0.1", int(sys.argv[sys.argv.index("--sim-port-out") + 1])
physics = socket.socket(type=socket.SOCK_DGRAM)
for number in range(10):
    pulses = [1000 + 100 * number] * 4 + [0] * 12
    for again in range(2):
        physics.sendto(struct.pack("<HHI16H", 18458, 400, number, *pulses), there)
    packet = physics.recv(4096)
pathlib.Path("packet.json").write_bytes(packet)
print("\\nno more steps", flush=True)
sys.exit(3)
"""
STEPS = 10
HOME = "vehicles.origin=[46.5,7.5,400.0]"
Start = Callable[[str], Autopilots]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Start:
    """Return how the autopilots start as a program, in folders below that of the test."""
    monkeypatch.setenv(FOLDER, str(tmp_path))

    def started(text: str) -> Autopilots:
        program = tmp_path / "copter"
        program.write_text(text)
        program.chmod(0o755)
        monkeypatch.setenv(PROGRAM, str(program))
        scenario = read_scenario(SCENARIO, ("plant.autopilot=ardupilot", HOME))
        return Autopilots(plant_run(Setup.of(scenario, str(SCENARIO))), 14550)

    return started


def test_each_step_is_answered_once(start: Start, tmp_path: Path) -> None:
    """Motors act on the pulses of the newest step, also after packets that came twice; an end is told."""
    bank = start(COPTER)
    sensed = np.arange(4.0 * SENSED) / 100.0
    for number in range(STEPS):
        thrusts_N = bank.inputs()[::INPUTS]
        np.testing.assert_allclose(thrusts_N, LARGEST_N * (0.1 * number) ** 2, atol=1e-9)
        bank.sense(number * bank.step_s, sensed)
    assert bank.failure == ""
    assert not bank.inputs().any()
    assert bank.failure == "the autopilot of UAV1 ended with code 3: no more steps"

    told = json.loads((tmp_path / "uav3" / "packet.json").read_bytes())
    own = sensed[2 * SENSED : 3 * SENSED]
    assert told["timestamp"] == pytest.approx((STEPS - 1) * bank.step_s)
    assert [*told["position"], *told["velocity"]] == pytest.approx(own[:6], abs=1e-5)
    assert [*told["imu"]["gyro"], *told["imu"]["accel_body"]] == pytest.approx(own[9:], abs=1e-5)
    w, x, y, z = told["quaternion"]
    turned = [
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(2.0 * (w * y - z * x)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    ]
    assert turned == pytest.approx(own[6:9], abs=1e-5)


def test_each_autopilot_has_its_own_link_and_number(start: Start, tmp_path: Path) -> None:
    """UAV i has system i and the i-th port, sensors from a port of its own, and parameters in its folder."""
    bank = start(COPTER)
    bank.inputs()
    ports = set()
    for i in range(4):
        words = json.loads((tmp_path / f"uav{i + 1}" / "options.json").read_text())
        options = dict(zip(words[1::2], words[2::2], strict=True))
        assert words[0] == "--wipe"
        numbers = options["-I"], options["--sysid"], options["--serial1"]
        assert numbers == (str(i), str(i + 1), f"udpclient:127.0.0.1:{14550 + i}")
        assert options["--home"] == "46.5,7.5,400.0,0"
        ports.add(options["--sim-port-out"])
        lines = (tmp_path / f"uav{i + 1}" / options["--defaults"]).read_text().splitlines()
        assert "GUID_OPTIONS 8" in lines
    assert len(ports) == 4


def test_options_and_parameters_are_those_of_a_simulated_copter(
    start: Start, tmp_path: Path
) -> None:
    """Physics at 800 Hz decide its pace; it has one link, and the other serial lines go nowhere."""
    bank = start(COPTER)
    assert bank.step_s == 1.0 / 800.0
    bank.inputs()
    words = json.loads((tmp_path / "uav2" / "options.json").read_text())
    options = dict(zip(words[1::2], words[2::2], strict=True))
    assert int(options.pop("--sim-port-out")) > 1023
    assert options == {
        "--model": "JSON:127.0.0.1", "-I": "1", "--sysid": "2", "--home": "46.5,7.5,400.0,0",
        "--speedup": "100", "--defaults": "defaults.parm", "--sim-address": "127.0.0.1",
        "--serial0": "udpclient:127.0.0.1:9", "--serial1": "udpclient:127.0.0.1:14551",
        "--serial2": "udpclient:127.0.0.1:9",
    }  # fmt: skip
    lines = (tmp_path / "uav2" / "defaults.parm").read_text(encoding="ascii").splitlines()
    assert "SIM_RATE_HZ 800" in lines
    # A quarter of the hover's thrust, (2 + 3 / 4) kg g, over 8.55 N.
    assert f"MOT_THST_HOVER {2.75 * 9.81 / 34.2:.9g}" in lines


def test_one_that_does_not_answer_ends_the_run(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After its time, without thrust; the others are not waited for."""
    monkeypatch.setattr(autopilot_processes, "_LOOK_S", 0.05)
    monkeypatch.setattr(autopilot_processes, "_PATIENCE_S", 0.1)
    bank = start(f"#!{sys.executable} -IS\nimport time\ntime.sleep(60)\n")
    assert not bank.inputs().any()
    assert bank.failure == "the autopilot of UAV1 has not answered for 0.1 s"
    monkeypatch.setattr(bank, "_received", None)
    assert not bank.inputs().any()


@pytest.mark.parametrize("is_kept", [True, False])
def test_autopilots_end_with_their_plant(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_kept: bool
) -> None:
    """A folder of their own is removed, one that is given stays."""
    made = tmp_path / "made"
    made.mkdir()
    monkeypatch.setattr(tempfile, "mkdtemp", lambda prefix: str(made))
    if not is_kept:
        monkeypatch.delenv(FOLDER)
    bank = start(f"#!{sys.executable} -IS\nimport time\ntime.sleep(60)\n")
    processes = bank._processes
    assert (made / "uav1").exists() == (not is_kept)
    del bank
    assert [process.returncode for process in processes] == [-signal.SIGKILL] * 4
    assert (tmp_path / "uav1").exists() == is_kept
    assert made.exists() == is_kept


def test_what_is_missing_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that is not there, by the variable that names it, or the package of its messages."""
    copter, stand_in = (
        plant_run(Setup.of(read_scenario(SCENARIO, (f"plant.autopilot={name}",)), str(SCENARIO)))
        for name in ("ardupilot", "stand_in")
    )
    expected = r"plant\.autopilot: expected the environment variable ARDUCOPTER to name .*, got "
    monkeypatch.delenv(PROGRAM, raising=False)
    with pytest.raises(ScenarioError, match=f"{expected}none; build it"):
        version(copter)
    monkeypatch.setenv(PROGRAM, "/nowhere/copter")
    with pytest.raises(ScenarioError, match=f"{expected}'/nowhere/copter'"):
        version(copter)
    path = tmp_path / "copter"
    path.write_text("")
    path.chmod(0o755)
    monkeypatch.setenv(PROGRAM, str(path))
    assert version(copter) == "autopilots ardupilot, copter"
    assert program(stand_in) == [sys.executable, "-m", "transport.plant.autopilot.stand_in"]
    monkeypatch.setattr(autopilot_processes, "find_spec", lambda _: None)
    with pytest.raises(
        ScenarioError, match=r"expected the package pymavlink, got none; pip install"
    ):
        version(stand_in)
