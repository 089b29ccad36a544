"""The signals campaign: runs are drawn from numbers, each kind of problem is found, and four runs succeed."""

import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest

from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.setup import Setup
from tests.campaigns import inspection, signals
from tests.campaigns.inspection import processes_below
from tests.campaigns.signal_runs import COMMAND, FORK_SERVER, KINDS, RESUMED_S, Injection, SignalRun, random_run
from tests.campaigns.signals import execute

ROOT = Path(__file__).parents[2]
MANY = 400
HOVER = ("maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]",)
REFUSED = ("controller.horizon=0",)
# Its first eight runs have every kind and every target, and no long stop.
SEED = "296"
# Eight runs, two at a time, on a slow machine: each may wait ten seconds until the network gives up a process.
PATIENCE_S = 240.0


def test_runs_are_drawn_from_their_number() -> None:
    """Equal seed and number give the same run, different ones different runs."""
    runs = [random_run(seed, number) for seed in (0, 1) for number in range(50)]
    assert runs == [random_run(seed, number) for seed in (0, 1) for number in range(50)]
    assert len({(run.settings, run.injections) for run in runs}) == len(runs)


def test_every_process_gets_every_signal() -> None:
    """Many runs send every signal to every process, freeze for a time and for good, and affect one or two processes."""
    runs = [random_run(0, number) for number in range(MANY)]
    injections = [injection for run in runs for injection in run.injections]
    names = {"coordinator", "plant", "agent1", "agent2", "agent3", "agent4", COMMAND, FORK_SERVER}
    assert {(injection.target, injection.kind) for injection in injections} == {(n, k) for n in names for k in KINDS}
    assert {injection.since for injection in injections} == {"start", "first tick"}
    stops = Counter(injection.resumed_s for injection in injections if injection.kind == "STOP")
    assert set(stops) == set(RESUMED_S)
    assert min(stops.values()) > 10
    assert all(injection.resumed_s is None for injection in injections if injection.kind != "STOP")
    assert {len(run.injections) for run in runs} == {1, 2}
    settings = [setting for run in runs for setting in run.settings]
    for given in (
        "on_agent_loss=abort",
        "on_agent_loss=continue",
        "mode=realtime",
        "exchange=direct",
        "negotiation_iterations=2",
        "links",
    ):
        assert any(given in setting for setting in settings)


def test_every_run_is_a_valid_scenario() -> None:
    """All settings that can be drawn are accepted."""
    path = find_scenario("resilient")
    for settings in {random_run(0, number).settings for number in range(MANY)}:
        read_scenario(path, settings)
    assert Setup.of(read_scenario(path, random_run(0, 1).settings), "resilient").ticks >= 60


def test_a_run_without_injections(tmp_path: Path) -> None:
    """An undisturbed run has no problem and leaves no process."""
    run = SignalRun(number=1, settings=HOVER, injections=())
    result = execute(run, tmp_path, threading.Event())
    assert (result.exit_code, result.problems) == (0, {})
    assert processes_below(tmp_path) == {}


def test_an_exit_code_that_does_not_fit_is_found(tmp_path: Path) -> None:
    """A command that refuses its scenario ends with a code that no injection can cause."""
    result = execute(SignalRun(number=2, settings=REFUSED, injections=()), tmp_path, threading.Event())
    assert result.exit_code == 3
    assert result.problems == {"wrong exit code": "3, expected one of 0, 4, 6"}


def test_a_traceback_is_found(tmp_path: Path) -> None:
    """A traceback in the output of any process is named by its file and last line."""
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "agent1.log").write_text("Traceback (most recent call last):\n  ...\nValueError: no\n")
    result = execute(SignalRun(number=5, settings=REFUSED, injections=()), tmp_path, threading.Event())
    assert result.problems["traceback"] == "agent1.log: ValueError: no"


def test_an_orphan_is_found_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A remaining process of the run is named and killed; an unreadable log is named."""
    monkeypatch.setattr(inspection, "ORPHANS_S", 0.5)
    name = f"signals-3-{os.getpid()}"
    (tmp_path / name).mkdir()  # the command refuses an existing folder and starts nothing
    (tmp_path / name / "run.mcap").write_bytes(b"not a log")
    words = ["transport", "agent", "--id", "7", "--run", name]
    left = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", *words], cwd=tmp_path)
    try:
        result = execute(SignalRun(number=3, settings=HOVER, injections=()), tmp_path, threading.Event())
        assert result.problems["orphan"] == "agent7"
        assert left.wait(10.0) == -signal.SIGKILL
    finally:
        left.kill()
    assert "unreadable log" in result.problems
    assert result.problems["wrong exit code"].startswith("2, expected one of")


@pytest.mark.slow
def test_a_frozen_command_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command frozen for good is killed; then all its processes end, a frozen one included."""
    monkeypatch.setattr(signals, "_FROZEN_S", 1.0)
    long = ("maneuver.phase=[{name='hover',duration_s=30.0,displacement_m=[0,0,0]}]", "clock.speed=1.0")
    injections = tuple(
        Injection(target=target, kind="STOP", since="first tick", after_s=after_s)
        for target, after_s in (("agent2", 0.3), (COMMAND, 0.6))
    )
    result = execute(SignalRun(number=4, settings=long, injections=injections), tmp_path, threading.Event())
    assert (result.exit_code, result.problems) == (-signal.SIGKILL, {})


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S + 60.0)
def test_four_runs(tmp_path: Path) -> None:
    """The first four runs end, leave no process, and have fitting exit codes."""
    arguments = [
        sys.executable,
        "-m",
        "tests.campaigns.signals",
        "--seed",
        SEED,
        "--runs",
        "4",
        "--out",
        str(tmp_path / "runs"),
    ]
    result = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    last = result.stdout.splitlines()[-1]
    assert last.endswith("signals: 0 hangs, 0 orphans, 0 tracebacks, 0 unreadable logs, 0 wrong exit codes")
    assert "runs by exit code" in result.stdout
    assert not (tmp_path / "runs").exists()
