"""Agents above autopilots: separate processes, MAVLink and the simulator interface over real sockets."""

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.plant.test_betaflight import installed
from tests.support.bench import Bench
from tests.support.commands import (
    PATIENCE_S,
    forks,
    free_base,
    processes_of,
    settings,
    start,
    transport,
    wait_for,
)
from tests.support.live_log import LiveLog
from tests.support.relay import Relay
from tests.support.runs import SCENARIOS
from tests.system.test_operate import invoke, succeed
from transport.flight.local_processes import free_udp_ports
from transport.log.run_log import read_log
from transport.protocol.network.mavlink import Endpoint, MavlinkLink, messages
from transport.protocol.wire.messages import PlantState, Roster, Target, VehicleStatus

SHORT = (
    "maneuver.phase=[{name='hover',duration_s=2.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=4.0,displacement_m=[0,0,-1.0]}]"
)
CLIMB_AND_TRANSLATE = (
    "maneuver.phase=[{name='hover',duration_s=1.0,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=5.0,displacement_m=[0,0,-2.5]},"
    "{name='translate',duration_s=5.0,displacement_m=[2.5,0,0]},"
    "{name='hover',duration_s=1.0,displacement_m=[0,0,0]}]"
)
# Half of real time where a machine with two busy cores bears it, else a quarter.
SPEEDS = (0.5, 0.25)
BEHIND = "lower clock.speed"
# Low above the ground, to a target on the side, and then there for longer than any test.
SIDEWAYS_M = 0.3
LOW = (
    "maneuver={start_m=[0.0,0.0,-1.2],profile='ramp',"
    "phase=[{name='hover',duration_s=60.0,displacement_m=[0,0,0]}],"
    f"target=[{{at_s=1.0,points_m=[[{SIDEWAYS_M},0.0,-1.2]]}}]}}"
)
FAILURES = (
    "faults.event=[{at_s=1.5,do='kill',target='vehicle2'},{at_s=2.0,do='restart',target='vehicle2'},"
    "{at_s=3.0,do='kill',target='coordinator'},{at_s=6.0,do='restart',target='coordinator'}]"
)
ASKS_S = 0.5  # between two questions to the coordinator, each of which opens a session
RETURNS_S = 240.0  # of wall time: ArduCopter's start, and 7 s at a quarter of real time
# 200 ms and 30 % loss, and the payload error with them, rms.
LATE = ("links.delay_s=0.2", "links.loss=0.3")
LATE_M = 0.10
# `transport` on a host whose clock is 50 ms ahead.
AHEAD = """
import runpy, time
actual = time.time_ns
time.time_ns = lambda: actual() + 50_000_000
runpy.run_module("transport", run_name="__main__")
"""
TIMEOUT_S = 0.5  # `vehicles.setpoint_timeout_s`
NO_ARDUCOPTER = "ARDUCOPTER does not name ArduCopter's simulator program"
with_arducopter = pytest.mark.skipif("ARDUCOPTER" not in os.environ, reason=NO_ARDUCOPTER)
PROGRAMS = [
    "stand_in",
    pytest.param("ardupilot", marks=[pytest.mark.slow, with_arducopter]),
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


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_team_flies_through_failures_and_lands(
    program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four agents, vehicles and autopilots: a vehicle ends and returns, then the coordinator, which lands the team.

    docs/flight.md: the team goes on, the vehicle from its own law to the plans, the target of the first
    coordinator stays in force without one, for longer than Zenoh's timeout of 10 s, and no setpoint is by
    knowledge older than a plan's 0.4 s, its tick before, and the offset of the clocks. Nothing ends the
    run but the release. Above stand-ins all this is on a late network, and the payload keeps within 10 cm.
    """
    links, most_m = (LATE, LATE_M) if program == "stand_in" else ((), 0.3)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRANSPORT_AUTOPILOTS", str(tmp_path / "autopilots"))
    # At a quarter of real time a busy machine starts the vehicle again while the team still bears it.
    options = settings(f"plant.autopilot={program}", "clock.speed=0.25", LOW, FAILURES, *links)
    run = start("run", "flight", *options, "--out", "runs/low", "--no-figures", cwd=tmp_path)
    so_far = LiveLog(tmp_path / "runs" / "low" / "run.mcap")
    try:
        assert wait_for(
            lambda: any(
                "coordinator has returned" in roster.reason for roster in so_far.of(Roster)
            ),
            RETURNS_S,
        )
        assert "in flight" in invoke("release")[2]
        assert "landing from tick" in succeed("land")
        assert "expected a team at rest" in invoke("release")[2]
        assert wait_for(lambda: run.poll() is not None or invoke("release")[0] == 0, every_s=ASKS_S)
        _, errors = run.communicate(timeout=60)
    finally:
        run.kill()
    assert run.returncode == 0, errors

    summary = json.loads((tmp_path / "runs/low/summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert summary["attitude_max_deg"] < 10.0
    assert summary["payload_tracking"]["rms_m"] < most_m
    log = read_log(tmp_path / "runs" / "low" / "run.mcap")
    assert [target.number for target in log.of(Target) if not target.lands] != []
    landing = [target for target in log.of(Target) if target.lands]
    assert {target.number for target in landing} == {2}
    last = list(log.of(PlantState))[-1]
    assert last.x[2] == pytest.approx(landing[0].points[-1, 2], abs=0.15)
    assert last.x[0] == pytest.approx(SIDEWAYS_M, abs=0.15)

    statuses = list(log.of(VehicleStatus))
    of_two = [status for status in statuses if status.uav == 2]
    assert len({status.incarnation for status in of_two}) == 2
    back = [status for status in of_two if status.incarnation > 0 and status.phase == "flying"]
    assert back[-1].plan_tick >= 0
    # Ticks go on while there is no coordinator, 3 to 6 s at a quarter of real time.
    ticks = {status.tick for status in statuses if status.uav == 3}
    assert len(ticks & set(range(65, 115))) > 46
    if program != "stand_in":
        return  # tests.system.test_arducopter reads the setpoints on their way
    for uav in (1, 3, 4):
        rows = setpoints(tmp_path, uav)
        age_s = rows[:, 0] - rows[:, 1]
        assert np.ptp(age_s) < TIMEOUT_S + 0.25
        assert len(rows) > 0.7 * 60 * 10.0


@pytest.mark.slow
@with_arducopter
def test_a_late_network_above_arducopter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the autopilots' estimates the payload keeps within 10 cm, with 200 ms and 30 % loss."""
    options = ("plant.autopilot=ardupilot", *LATE, CLIMB_AND_TRANSLATE)
    summary, _ = flown(tmp_path, *options, monkeypatch=monkeypatch)
    assert summary["payload_tracking"]["rms_m"] < LATE_M


@contextmanager
def outside(
    folder: Path, port: int, speed: float, *changes: str
) -> Iterator[tuple[Path, subprocess.Popen[bytes]]]:
    """Autopilots that hover by themselves and call ports from one on; yields the scenario of their run."""
    scenario = folder / "outside.toml"
    text = (SCENARIOS / "flight.toml").read_text(encoding="utf-8")
    scenario.write_text(text.replace("[plant]", '[plant]\nkind = "vehicles"'))
    arguments = [str(scenario), str(port), f"{speed:g}", *changes]
    world = subprocess.Popen(
        [sys.executable, "-m", "tests.support.outside", *arguments],
        env={**os.environ, "TRANSPORT_AUTOPILOTS": str(folder / "autopilots")},
    )
    try:
        yield scenario, world
    finally:
        world.kill()
        world.wait()


@installed
def test_betaflight_over_its_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MSP and motion capture: 200 ms and 30 % loss, and a vehicle process that ends and returns.

    Meanwhile the firmware's own fail-safe keeps its UAV level, at the throttle of a hover.
    """
    ends = (
        "faults.event=[{at_s=2.0,do='kill',target='vehicle2'},"
        "{at_s=2.5,do='restart',target='vehicle2'}]"
    )
    options = ("plant.autopilot=betaflight", SHORT, *LATE, ends)
    # The physics take a step of a millisecond for each exchange with the firmwares.
    summary, statuses = flown(tmp_path, *options, monkeypatch=monkeypatch, speeds=(0.25, 0.1))
    assert summary["payload_tracking"]["rms_m"] < 0.05
    assert summary["attitude_max_deg"] < 3.0
    back = [status for status in statuses if status.uav == 2 and status.incarnation > 0]
    assert back[-1].plan_tick >= 0


def by_hand(port: int) -> dict[str, list[str]]:
    """Commands of plant, agents and vehicles by name, whose autopilots call ports from one on."""
    commands = {"plant": ["plant"]}
    for n in range(1, 5):
        link = f"udp:127.0.0.1:{port + n - 1}"
        commands[f"agent{n}"] = ["agent", "--id", str(n)]
        commands[f"vehicle{n}"] = ["vehicle", "--stands", "--uav", str(n), "--link", link]
    return commands


@pytest.mark.slow
def test_a_recorder_is_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of processes started by hand the recorder ends and returns: the others fly on, and the new log has the path."""
    monkeypatch.chdir(tmp_path)
    port, base = free_udp_ports(4), free_base()
    given = ("clock.speed=0.25", LOW, f"network.base_port={base}", f"network.vehicle_port={port}")
    common = ["--run", "by-hand", "--scenario", "flight", "--join-timeout", "100"]
    options = [*common, *settings(*given)]
    record = ("record", "--no-figures", "--out")
    roles = [["coordinator", "--observer", "recorder"], *by_hand(port).values()]
    with forks() as begin:
        first, *_ = begin([*record, "first", *options], *([*role, *options] for role in roles))
        before = LiveLog(tmp_path / "first" / "run.mcap")
        assert wait_for((tmp_path / "first" / "run.mcap").exists)
        assert wait_for(lambda: any(target.number == 1 for target in before.of(Target)))
        first.kill()
        begin([*record, "again", *options])
        after = LiveLog(tmp_path / "again" / "run.mcap")
        assert wait_for((tmp_path / "again" / "run.mcap").exists)
        assert wait_for(lambda: len(after.of(VehicleStatus)) > 40)
        assert [target.number for target in after.of(Target)] == [1]
        assert any("recorder has returned" in roster.reason for roster in after.of(Roster))
        assert after.of(VehicleStatus)[-1].tick > before.of(VehicleStatus)[-1].tick


@pytest.mark.slow
@pytest.mark.parametrize("program", PROGRAMS)
def test_a_clock_that_is_off_is_refused(
    program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The team does not start with a vehicle whose clock is 50 ms ahead: its offset is told, and all end."""
    monkeypatch.chdir(tmp_path)
    port, base = free_udp_ports(4), free_base()
    ready_s = 12.0 if program == "stand_in" else 120.0
    given = (
        f"plant.autopilot={program}",
        f"vehicles.ready_s={ready_s}",
        f"network.base_port={base}",
        f"network.vehicle_port={port}",
    )
    common = ["--run", "clocks", "--scenario", "flight", "--join-timeout", "100"]
    options = [*common, *settings(*given)]
    roles = by_hand(port)
    # Vehicles are judged in their order: of the others none has to be ready in time.
    ahead = [sys.executable, "-c", AHEAD, *roles.pop("vehicle1"), *options]
    coordinator = start("coordinator", *options, cwd=tmp_path)
    vehicle = subprocess.Popen(ahead, stderr=subprocess.DEVNULL)
    try:
        with forks() as begin:
            others = begin(*([*role, *options] for role in roles.values()))
            _, errors = coordinator.communicate(timeout=ready_s + PATIENCE_S)
            assert coordinator.returncode == 4
            refusal = re.search(r"vehicle1: clock: expected .*, got (.*) ms \+- (.*) ms", errors)
            assert refusal is not None, errors
            assert float(refusal[1]) == pytest.approx(50.0, abs=float(refusal[2]) + 1.0)
            for process in (vehicle, *others):
                process.wait(timeout=30.0)
    finally:
        for process in (coordinator, vehicle):
            process.kill()
            process.wait()


class Flown:
    """A team above autopilots outside of its run, as its log has it so far."""

    def __init__(self, path: Path) -> None:
        self._log = LiveLog(path)

    def statuses(self) -> list[VehicleStatus]:
        """All statuses so far."""
        return list(self._log.of(VehicleStatus))

    def is_at(self, tick: int, world: subprocess.Popen[bytes]) -> bool:
        """Whether it flies past a tick, or its world has ended."""
        is_past = any(s.tick > tick for s in self.statuses() if s.phase == "flying")
        return is_past or world.poll() is not None

    def newest(self, uav: int) -> VehicleStatus | None:
        """The newest status of a vehicle in flight."""
        told = [s for s in self._log.of(VehicleStatus) if s.uav == uav and s.phase == "flying"]
        return told[-1] if told else None

    def follows(self, uav: int, since: int) -> bool:
        """Whether a UAV follows a plan of its agent that is newer than a tick."""
        told = self.newest(uav)
        return told is not None and told.plan_tick > since

    def flies(self, ticks: int) -> int:
        """Wait until a number of ticks have passed; return the newest."""
        told = self.newest(1) or self.newest(4)
        begin = 0 if told is None else told.tick
        assert wait_for(
            lambda: any(s.tick >= begin + ticks for s in self._log.of(VehicleStatus)),
        )
        return max(s.tick for s in self._log.of(VehicleStatus))

    def says(self, text: str) -> bool:
        """Whether the coordinator has told something."""
        return any(text in roster.reason for roster in self._log.of(Roster))


def meet_failures(team: Flown, relay: Relay, jump: tuple[str, float]) -> None:
    """Stop an agent and a vehicle, silence a link, let an estimate jump by 2 m; the team is as before after each.

    `jump` is the parameter of an autopilot that lets its estimate jump, and its value.
    """
    succeed("fault", "stop", "agent2")
    assert wait_for(lambda: team.follows(2, -3) and team.newest(2).plan_tick == -2)  # type: ignore[union-attr]
    now = team.flies(10)
    succeed("fault", "continue", "agent2")
    assert wait_for(lambda: team.follows(2, now))

    succeed("fault", "stop", "vehicle3")
    now = team.flies(12)
    succeed("fault", "continue", "vehicle3")
    assert wait_for(lambda: team.follows(3, now))

    relay.silent.add(1)
    assert wait_for(lambda: team.newest(1).plan_tick == -3)  # type: ignore[union-attr]
    assert "state" in team.newest(1).problem  # type: ignore[union-attr]
    relay.silent.clear()
    now = team.flies(1)
    assert wait_for(lambda: team.follows(1, now))

    before = team.newest(4).position  # type: ignore[union-attr]
    relay.set_parameter(4, *jump)
    assert wait_for(lambda: "jumped by" in team.newest(4).problem)  # type: ignore[union-attr]
    now = team.flies(10)
    assert np.linalg.norm(team.newest(4).position - before) < 0.5  # type: ignore[union-attr]


@pytest.mark.slow
def test_each_failure_is_handled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped agent, stopped vehicle, silent link, a jump of 2 m, a low battery: as the table of docs/flight.md.

    All in one flight, one after the other: the load stays within 1 m and 15 deg by the truth outside, and lands.
    The autopilots hover by themselves outside of the run, whose vehicles engage them without a jump. No
    process of the run simulates: measurements, ticks and the end are those of vehicles and coordinator.
    A signal in the air lands the team faster, and the run ends with its release.
    """
    monkeypatch.chdir(tmp_path)
    inner, outer = free_udp_ports(4), free_udp_ports(4)
    with (
        Relay(4, inner, outer) as relay,
        outside(tmp_path, inner, 0.25, LOW) as (scenario, world),
    ):
        options = settings("clock.speed=0.25", LOW, f"network.vehicle_port={outer}")
        out = ("--out", "runs/failures", "--no-figures")
        run = start("run", str(scenario), *options, *out, cwd=tmp_path)
        team = Flown(tmp_path / "runs" / "failures" / "run.mcap")
        try:
            assert wait_for((tmp_path / "runs" / "failures" / "run.mcap").exists)
            assert wait_for(lambda: team.follows(2, 10)), run.communicate(timeout=10)

            meet_failures(team, relay, ("STAND_JUMP", 2.0))

            relay.set_parameter(1, "STAND_BATTERY", 10.0)
            assert wait_for(lambda: team.says("battery of UAV1 at 10%: the team lands"))
            run.terminate()
            assert wait_for(lambda: invoke("release")[0] == 0, every_s=ASKS_S)
            _, errors = run.communicate(timeout=60)
        finally:
            run.kill()
        assert world.poll() is None, (
            "this machine is too busy for a world at a quarter of real time"
        )
        assert run.returncode == 130, errors
        assert team.says("the team lands, and waits for `transport release`")
    truth = np.loadtxt(tmp_path / "autopilots" / "truth.csv", delimiter=",")
    assert np.abs(truth[:, 4]).max() < 15.0
    assert np.linalg.norm(truth[:, 1:3] - [0.0, 0.0], axis=1).max() < 1.0
    assert truth[-1, 3] == pytest.approx(-0.275, abs=0.2)
    for passed in relay.setpoints.values():
        arrival_s, known_s = np.array([one for one in passed if one[1] > 0.0]).T
        # By the steady clock, which paces the run: that of a world falls behind on a busy machine.
        assert np.ptp(0.25 * arrival_s - known_s) < TIMEOUT_S + 0.25

    log = read_log(tmp_path / "runs" / "failures" / "run.mcap")
    assert not list(log.of(PlantState))
    statuses = list(log.of(VehicleStatus))
    assert {status.phase for status in statuses} >= {"ready", "flying"}
    # Jumps of 5 cm between two ticks would be 1 m/s, twice the speed of the way to the target.
    for uav in range(1, 5):
        flying = [status for status in statuses if status.uav == uav and status.phase == "flying"]
        assert flying[0].tick == 0
        moved_m = [np.linalg.norm(status.position - flying[0].position) for status in flying[:30]]
        assert max(moved_m) < 0.5


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
