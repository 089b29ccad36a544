"""The physics side of ArduPilot's JSON interface: each step of an autopilot is answered once."""

import sys
from pathlib import Path

import numpy as np
import pytest

from transport.flight.roles import plant_run
from transport.model.state import INPUTS, SENSED
from transport.plant.autopilot.autopilot_processes import PROGRAM, Autopilots
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup

SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "flight.toml"
LARGEST_N = 34.2  # four rotors of 8.55 N at a pulse of 2 ms
# As ArduCopter does it: from a port that it has not told, every packet again, as if the physics were late.
COPTER = f"""#!{sys.executable}
import socket, struct, sys
there = "127.0.0.1", int(sys.argv[sys.argv.index("--sim-port-out") + 1])
physics = socket.socket(type=socket.SOCK_DGRAM)
for number in range(10):
    pulses = [1000 + 100 * number] * 4 + [0] * 12
    for again in range(2):
        physics.sendto(struct.pack("<HHI16H", 18458, 400, number, *pulses), there)
    physics.recv(4096)
"""


def test_each_step_is_answered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Motors act on the pulses of the newest step, also after packets that came twice."""
    program = tmp_path / "copter"
    program.write_text(COPTER)
    program.chmod(0o755)
    monkeypatch.setenv(PROGRAM, str(program))
    scenario = read_scenario(SCENARIO, ("plant.autopilot=ardupilot",))
    bank = Autopilots(plant_run(Setup.of(scenario, str(SCENARIO))), 14550)

    for number in range(10):
        thrusts_N = bank.inputs()[::INPUTS]
        np.testing.assert_allclose(thrusts_N, LARGEST_N * (0.1 * number) ** 2, atol=1e-9)
        bank.sense(number * bank.step_s, np.zeros(4 * SENSED))
    assert bank.failure == ""
