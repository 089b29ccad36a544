"""Agents above autopilots: separate processes, MAVLink and the simulator interface over real sockets."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.bench import Bench
from tests.support.commands import processes_of, settings, transport
from tests.support.runs import SCENARIOS
from transport.flight.local_processes import free_udp_ports
from transport.log.run_log import read_log
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages
from transport.protocol.wire.messages import PlantState, VehicleStatus

SHORT = (
    "maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=4.0,displacement_m=[0,0,-1.0]}]"
)
# Half of real time where a machine with two busy cores bears it, else a quarter.
SPEEDS = (0.5, 0.25)
BEHIND = "lower clock.speed"
FAILURES = (
    "faults.event=[{at_s=1.5,do='kill',target='vehicle2'},{at_s=2.0,do='restart',target='vehicle2'},"
    "{at_s=3.0,do='kill',target='coordinator'},{at_s=4.0,do='restart',target='coordinator'}]"
)
WHOLE_M = 0.10  # payload error of the whole maneuver, rms
TIMEOUT_S = 0.5  # `vehicles.setpoint_timeout_s`
NO_ARDUCOPTER = "ARDUCOPTER does not name ArduCopter's simulator program"
PROGRAMS = [
    "stand_in",
    pytest.param(
        "ardupilot",
        marks=pytest.mark.skipif("ARDUCOPTER" not in os.environ, reason=NO_ARDUCOPTER),
    ),
]


def flown(
    folder: Path, *changes: str, monkeypatch: pytest.MonkeyPatch, speeds: Sequence[float] = SPEEDS
) -> tuple[dict[str, Any], list[VehicleStatus]]:
    """Summary and statuses of a completed run of `flight`, at the first of the speeds that the machine bears."""
    monkeypatch.setenv("TRANSPORT_AUTOPILOTS", str(folder / "autopilots"))
    for speed in speeds:
        out = f"above-{speed:g}"
        options = settings(f"clock.speed={speed:g}", *changes)
        result = transport("run", "flight", *options, "--out", out, "--no-figures", cwd=folder)
        assert processes_of(out) == {}
        if BEHIND not in result.stderr:
            break
    assert result.returncode == 0, result.stderr
    summary: dict[str, Any] = json.loads((folder / out / "summary.json").read_text())
    assert summary["outcome"] == "completed"
    return summary, list(read_log(folder / out / "run.mcap").of(VehicleStatus))


def setpoints(folder: Path, uav: int) -> np.ndarray:
    """Setpoints that a stand-in obeyed in the run: its time, that of their knowledge, and the rest."""
    rows = np.loadtxt(folder / "autopilots" / f"uav{uav}" / "setpoints.csv", delimiter=",")
    return np.asarray(rows[rows[:, 1] > 0.0])


def test_a_team_flies_through_the_loss_of_a_vehicle_and_of_the_coordinator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four agents, four vehicles and four stand-ins: a vehicle ends and returns, then the coordinator.

    docs/flight.md: the team goes on, the vehicle from its own law to the plans, and no setpoint is by
    knowledge older than a plan's 0.4 s, its tick before, and the offset of the clocks.
    """
    # At a quarter of real time a busy machine starts the vehicle again while the team still bears it.
    summary, statuses = flown(tmp_path, SHORT, FAILURES, monkeypatch=monkeypatch, speeds=[0.25])
    assert summary["attitude_max_deg"] < 10.0
    assert summary["payload_tracking"]["rms_m"] < 0.3

    of_two = [status for status in statuses if status.uav == 2]
    assert len({status.incarnation for status in of_two}) == 2
    back = [status for status in of_two if status.incarnation > 0 and status.phase == "flying"]
    assert back[-1].plan_tick >= 0
    # Ticks go on while there is no coordinator, 3 to 4 s.
    without = {status.tick for status in statuses if status.uav == 1 and 62 <= status.tick < 78}
    assert len(without) > 12

    for uav in (1, 3, 4):
        rows = setpoints(tmp_path, uav)
        age_s = rows[:, 0] - rows[:, 1]
        assert np.ptp(age_s) < TIMEOUT_S + 0.25
        assert len(rows) > 0.7 * 60 * 6.0


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS)
def test_the_whole_maneuver(program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the autopilots' estimates the payload keeps within 10 cm, with 200 ms and 30 % loss."""
    late = ("links.delay_s=0.2", "links.loss=0.3")
    summary, _ = flown(tmp_path, f"plant.autopilot={program}", *late, monkeypatch=monkeypatch)
    assert summary["payload_tracking"]["rms_m"] < WHOLE_M


@pytest.mark.slow
def test_a_run_without_a_plant(tmp_path: Path) -> None:
    """Autopilots that hover by themselves outside of the run: its vehicles engage them without a jump.

    No process of the run simulates: measurements, ticks and the end are those of vehicles and coordinator.
    """
    scenario = tmp_path / "outside.toml"
    text = (SCENARIOS / "flight.toml").read_text(encoding="utf-8")
    scenario.write_text(text.replace('autopilot = "stand_in"', 'kind = "vehicles"'))
    port = free_udp_ports(4)
    world = subprocess.Popen(
        [sys.executable, "-m", "tests.support.outside", str(scenario), str(port), "0.5"],
        env={**os.environ, "TRANSPORT_AUTOPILOTS": str(tmp_path / "autopilots")},
    )
    try:
        result = transport(
            "run",
            str(scenario),
            *settings(f"clock.speed={SPEEDS[0]:g}", SHORT, f"network.vehicle_port={port}"),
            *("--out", "without", "--no-figures"),
            cwd=tmp_path,
        )
    finally:
        world.kill()
        world.wait()
    assert result.returncode == 0, result.stderr
    log = read_log(tmp_path / "without" / "run.mcap")
    assert not list(log.of(PlantState))
    statuses = list(log.of(VehicleStatus))
    assert {status.phase for status in statuses} >= {"ready", "flying"}
    # Jumps of 5 cm between two ticks would be 1 m/s: the maneuver takes 0.5.
    for uav in range(1, 5):
        places = np.array([s.position for s in statuses if s.uav == uav and s.phase == "flying"])
        ticks = [s.tick for s in statuses if s.uav == uav and s.phase == "flying"]
        assert ticks[0] == 0
        moved_m = np.linalg.norm(places - places[0], axis=1)
        assert moved_m[: len(moved_m) // 4].max() < 0.5
        assert places[-1, 2] - places[0, 2] == pytest.approx(-1.0, abs=0.4)


def checked(bench: Bench, *options: str) -> Any:
    """Result of the check of an autopilot on a bench."""
    link = ("--link", f"udp:127.0.0.1:{bench.port}")
    return transport(
        "vehicle",
        "--scenario",
        "flight",
        "--uav",
        "1",
        *link,
        "--check",
        *options,
        cwd=bench.folder,
    )


def test_the_check_passes_or_names_what_to_set(tmp_path: Path) -> None:
    """Fitting parameters pass; one that does not fit is named, with the value to set and its reason."""
    with Bench(tmp_path) as bench:
        result = checked(bench)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "failed" not in result.stdout

    with Bench(tmp_path, GUID_TIMEOUT=3.0) as bench:
        result = checked(bench)
    assert result.returncode == 9
    assert "GUID_TIMEOUT: expected at most 0.5, got 3" in result.stdout


def test_strangers_change_nothing(tmp_path: Path) -> None:
    """With a key neither side believes a packet without it.

    The autopilot does not arm for a stranger, and the check does not hear a stranger's autopilot.
    """
    key = tmp_path / "key"
    key.write_text("5a" * 32)
    other = tmp_path / "other"
    other.write_text("a5" * 32)
    with Bench(tmp_path, key=key) as bench:
        stranger = MavlinkLink(Endpoint(False, "127.0.0.1", bench.port), (255, 191), 1)
        time.sleep(1.0)
        heard = [stranger.receive(0.2) for _ in range(20)]
        m = messages()
        for command, *numbers in ((m.MAV_CMD_DO_SET_MODE, 1, 4), (400, 1)):
            seven = [*map(float, numbers), *[0.0] * 7][:7]
            stranger.send(m.MAVLink_command_long_message(1, 1, command, 0, *seven))
        stranger.send(
            m.MAVLink_set_attitude_target_message(0, 1, 1, 128, [1, 0, 0, 0], 0, 0, 0, 0.9)
        )
        time.sleep(0.5)
        assert any(heard)  # it hears the autopilot, whose packets are not secret
        assert bench.thrusts.max() == 0.0
        assert bench.setpoints == []
        stranger.close()
        assert checked(bench, "--key", str(other)).returncode == 9
        assert checked(bench, "--key", str(key)).returncode == 0


def test_a_port_in_use_is_told(tmp_path: Path) -> None:
    """A link whose port another process has ends the command in one line."""
    with socket.socket(type=socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        link = f"udp:127.0.0.1:{taken.getsockname()[1]}"
        result = transport(
            "vehicle", "--scenario", "flight", "--uav", "1", "--link", link, "--check", cwd=tmp_path
        )
    assert result.returncode == 2
    assert "Address already in use" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_missing_program_is_told_before_any_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without ArduCopter the run is refused, with the variable that names it; nothing is left behind."""
    monkeypatch.delenv("ARDUCOPTER", raising=False)
    result = transport(
        "run", "flight", *settings("plant.autopilot=ardupilot"), "--out", "none", cwd=tmp_path
    )
    assert result.returncode == 3
    assert "environment variable ARDUCOPTER" in result.stderr
    assert not (tmp_path / "none").exists()
