"""ArduCopter itself, which ARDUCOPTER names: its checks, its signatures, and each failure in flight."""

import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.support.commands import settings, start, transport, wait_for
from tests.support.relay import Relay
from tests.support.standing import Standing
from tests.system.test_autopilots import LOW, NO_ARDUCOPTER, TIMEOUT_S, Flown, meet_failures
from tests.system.test_operate import invoke
from transport.flight.local_processes import free_udp_ports
from transport.log.run_log import read_log
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages, read_key
from transport.protocol.wire.messages import PlantState

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("ARDUCOPTER" not in os.environ, reason=NO_ARDUCOPTER),
]
SPEED = 0.25
# Of its navigation, in real time on a machine that bears it.
READY_S = 150.0
GUIDED = 4
FORCED = (400, 1, 21196)  # the command that arms without any check
SIGNS_SINCE_S = 1_420_070_400  # 2015-01-01
SHIFT_DEG = 2.0 / 111_319.49  # of its satellite position: 2 m to the north
# A battery whose current is told by `BATT_AMP_OFFSET`, in volts of 17 A each.
BATTERY = "vehicles.parameters={BATT_MONITOR=4.0,BATT_CAPACITY=1000.0}"


@pytest.fixture
def stand() -> Iterator[Standing]:
    """Four ArduCopters on a stand, ready to arm."""
    with Standing() as standing:
        yield standing


def check(port: int, folder: Path, *options: str) -> tuple[int, str]:
    """Exit code and output of the check of UAV 1."""
    link = ("--link", f"udp:127.0.0.1:{port}")
    result = transport(
        "vehicle", "--scenario", "flight", "--uav", "1", *link, "--check", *options, cwd=folder
    )
    return result.returncode, result.stdout


def passes(port: int, folder: Path, *options: str) -> bool:
    """Whether the check passes once its navigation is ready."""
    return wait_for(lambda: check(port, folder, *options)[0] == 0, READY_S)


def test_the_check_names_what_to_set(tmp_path: Path) -> None:
    """One parameter that does not fit is named, with the value to set; all others are those of the project."""
    with Standing(GUID_TIMEOUT=3.0) as stand:
        assert wait_for(lambda: "estimate: valid" in check(stand.port, tmp_path)[1], READY_S)
        code, text = check(stand.port, tmp_path)
    assert code == 9
    failed = [line for line in text.splitlines() if line.startswith("failed")]
    assert len(failed) == 1
    assert "GUID_TIMEOUT: expected at most 0.5, got 3" in failed[0]


def test_strangers_change_nothing(stand: Standing, tmp_path: Path) -> None:
    """With a key from SETUP_SIGNING it obeys no packet without the signature, and the check believes no other key."""
    key, other = tmp_path / "key", tmp_path / "other"
    key.write_text("5a" * 32)
    other.write_text("a5" * 32)
    assert passes(stand.port, tmp_path)

    m = messages()
    at = Endpoint(False, "127.0.0.1", stand.port)
    owner = MavlinkLink(at, (255, 191), 1)
    assert wait_for(lambda: bool(owner.receive(0.2)))
    since = int((time.time() - SIGNS_SINCE_S) * 1e5)
    owner.send(m.MAVLink_setup_signing_message(1, 1, list(read_key(key)), since))
    owner.close()
    assert passes(stand.port, tmp_path, "--key", str(key))
    assert check(stand.port, tmp_path, "--key", str(other))[0] == 9
    assert "no answer yet" in check(stand.port, tmp_path)[1]

    stranger = MavlinkLink(at, (255, 191), 1)
    assert wait_for(lambda: bool(stranger.receive(0.2)))  # its packets are not secret
    for _ in range(5):
        for command, *numbers in ((m.MAV_CMD_DO_SET_MODE, 1, GUIDED), FORCED):
            seven = [*map(float, numbers), *[0.0] * 7][:7]
            stranger.send(m.MAVLink_command_long_message(1, 1, command, 0, *seven))
        stranger.send(
            m.MAVLink_set_attitude_target_message(0, 1, 1, 128, [1, 0, 0, 0], 0, 0, 0, 0.9)
        )
        time.sleep(0.5)
        assert stand.bank.thrusts_N.max() == 0.0
    until_s = time.monotonic() + 3.0
    beats = []
    while time.monotonic() < until_s:
        beats += [heard for heard in stranger.receive(0.2) if heard.get_type() == "HEARTBEAT"]
    stranger.close()
    assert beats
    assert not any(beat.base_mode & m.MAV_MODE_FLAG_SAFETY_ARMED for beat in beats)
    assert not any(beat.custom_mode == GUIDED for beat in beats)


# ArduCopter with its link moved from the ports of the vehicles to those of a relay.
BEHIND_RELAY = """#!{python}
import os, sys
arguments = sys.argv[1:]
at = arguments.index("--serial1") + 1
host, _, port = arguments[at].rpartition(":")
arguments[at] = f"{{host}}:{{int(port) + {inner} - {outer}}}"
os.execv({program!r}, [{program!r}, *arguments])
"""


def test_each_failure_is_handled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped agent and vehicle, silent link, reset estimate, low battery: as the table of docs/record/guarantees.md.

    All in one flight, one after the other. Its filter refuses a satellite position that shifts by 2 m for
    10 s, then resets its position to it: a jump, which the vehicle takes out. No setpoint that passes to
    an autopilot is by knowledge older than a plan's 0.4 s, its tick before, and the delay of a busy machine.
    """
    monkeypatch.chdir(tmp_path)
    inner, outer = free_udp_ports(4), free_udp_ports(4)
    moved = tmp_path / "arducopter"
    program = str(Path(os.environ["ARDUCOPTER"]).resolve())
    text = BEHIND_RELAY.format(python=sys.executable, program=program, inner=inner, outer=outer)
    moved.write_text(text)
    moved.chmod(0o755)
    monkeypatch.setenv("ARDUCOPTER", str(moved))
    out = tmp_path / "runs" / "failures"
    speed = f"clock.speed={SPEED}"
    changes = ("plant.autopilot=ardupilot", speed, LOW, BATTERY, f"network.vehicle_port={outer}")
    with Relay(4, inner, outer) as relay:
        options = (*settings(*changes), "--out", "runs/failures", "--no-figures")
        run = start("run", "flight", *options, cwd=tmp_path)
        team = Flown(out / "run.mcap")
        try:
            assert wait_for((out / "run.mcap").exists)
            assert wait_for(lambda: team.follows(2, 10), READY_S), run.communicate(timeout=10)

            meet_failures(team, relay, ("SIM_GPS1_GLTCH_X", SHIFT_DEG))

            relay.set_parameter(1, "BATT_AMP_OFFSET", -20.0)
            assert wait_for(lambda: team.says("battery of UAV1 at 1"), READY_S)
            assert wait_for(lambda: invoke("release")[0] == 0)
            _, errors = run.communicate(timeout=60)
        finally:
            run.kill()
    assert run.returncode == 0, errors
    summary = json.loads((out / "summary.json").read_text())
    assert summary["attitude_max_deg"] < 10.0
    last = list(read_log(out / "run.mcap").of(PlantState))[-1]
    assert last.x[2] == pytest.approx(-0.275, abs=0.2)
    for passed in relay.setpoints.values():
        arrived_s, known_s = np.array([pair for pair in passed if pair[1] > 0.0]).T
        assert np.ptp(SPEED * arrived_s - known_s) < TIMEOUT_S + 0.25
