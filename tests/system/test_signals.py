"""The signals campaign: runs are drawn from numbers, each kind of problem is found, and four runs succeed."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest

from tests.campaigns import inspection, signals
from tests.campaigns.inspection import COMMAND, TOOL, name_of, names_below, processes_below
from tests.campaigns.signal_runs import KINDS, RESTART, RESUMED_S, TARGETS, Injection, SignalRun, random_run
from tests.campaigns.signals import execute_run, waits_for_user
from tests.support.commands import command as command_line
from tests.support.commands import command_of, settings, wait_for

ROOT = Path(__file__).parents[2]
MANY = 1500
HOVER = ("maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]",)
REFUSED = ("controller.horizon=0",)
# Its first four runs signal a process that draws, the viewer, an agent and its successor, and have no long stop.
SEED = "665"
# Four runs, two at a time, on a slow machine: each may wait ten seconds until the network gives up a process.
PATIENCE_S = 240.0


def test_every_process_gets_every_signal() -> None:
    """Many runs send every signal to every process, freeze for a time and for good, and affect one or two processes."""
    runs = [random_run(0, number) for number in range(MANY)]
    injections = [injection for run in runs for injection in run.injections]
    assert {(injection.target, injection.kind) for injection in injections} == {(n, k) for n in TARGETS for k in KINDS}
    assert {injection.since for injection in injections} == {"start", "first tick", "report"}
    stops = Counter(injection.resumed_s for injection in injections if injection.kind == "STOP")
    assert set(stops) == set(RESUMED_S)
    assert min(stops.values()) > 10
    assert all(injection.resumed_s is None for injection in injections if injection.kind != "STOP")
    assert {len(run.injections) for run in runs} == {1, 2}


@pytest.mark.slow
def test_every_process_of_a_run_is_a_target(tmp_path: Path) -> None:
    """A run with figures, a viewer and a restart starts a process of each name, and none that the campaign omits."""
    options = [*settings(*HOVER, RESTART, "clock.on_agent_loss=continue"), "--out", "run", "--view", "--port", "0"]
    seen, output = dict[str, list[str]](), tmp_path / "output.txt"
    with output.open("wb") as file:
        command = subprocess.Popen(
            command_line("run", "resilient", *options),
            cwd=tmp_path,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=file,
            start_new_session=True,
        )
    try:

        def is_over() -> bool:
            names = names_below(tmp_path)
            for pid in (command.pid, *(child.pid for child in psutil.Process(command.pid).children(recursive=True))):
                words = command_of(str(pid))
                if words:  # it has not ended
                    seen.setdefault(names.get(pid) or name_of(words), words)
            return waits_for_user(output) or command.poll() is not None

        assert wait_for(is_over)
        command.send_signal(signal.SIGTERM)
        assert command.wait(PATIENCE_S) == 0, output.read_text()
    finally:
        command.kill()
        command.wait()
    assert seen.keys() - {TOOL} == set(TARGETS), seen


def executed(tmp_path: Path, drawn: tuple[str, ...], *injections: Injection) -> tuple[int, dict[str, str]]:
    """Return exit code and problems of a run."""
    run = SignalRun(number=3, settings=drawn, injections=injections)
    return execute_run(run, tmp_path, threading.Event())[:2]


def test_a_run_without_injections(tmp_path: Path) -> None:
    """An undisturbed run has no problem and leaves no process."""
    assert executed(tmp_path, HOVER) == (0, {})
    assert processes_below(tmp_path) == {}


def test_a_wait_ends_beside_a_zombie(tmp_path: Path) -> None:
    """A process that its parent does not reap, as a stopped one, does not stop the time for the others."""
    ends_s = time.monotonic() + PATIENCE_S
    program = "import os, time; time.sleep(0.5 if os.fork() == 0 else 600.0)"
    with subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path) as parent:
        has_ended = inspection.wait_given(lambda: time.monotonic() > ends_s, tmp_path, 2.0)
        parent.kill()
    assert not has_ended


def test_wrong_exit_codes_and_tracebacks_are_found(tmp_path: Path) -> None:
    """A code that no injection can cause is a problem, as is a traceback in the output of any process."""
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "agent1.log").write_text("Traceback (most recent call last):\n  ...\nValueError: no\n")
    assert executed(tmp_path, REFUSED) == (
        3,
        {"wrong exit code": "3, expected one of 0, 4, 6", "traceback": "agent1.log: ValueError: no"},
    )


def test_an_orphan_is_found_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A remaining process of the run is named and killed; an unreadable log is named."""
    monkeypatch.setattr(inspection, "ORPHANS_S", 0.5)
    name = f"signals-3-{os.getpid()}"
    (tmp_path / name).mkdir()  # the command refuses an existing folder and starts nothing
    (tmp_path / name / "run.mcap").write_bytes(b"not a log")
    words = ["transport", "agent", "--id", "7", "--run", name]
    left = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", *words], cwd=tmp_path)
    try:
        problems = executed(tmp_path, HOVER)[1]
        assert problems["orphan"] == "agent7"
        assert left.wait(10.0) == -signal.SIGKILL
    finally:
        left.kill()
    assert "unreadable log" in problems
    assert problems["wrong exit code"].startswith("2, expected one of")


@pytest.mark.slow
def test_a_frozen_command_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command frozen for good is killed; then all its processes end, a frozen one included."""
    monkeypatch.setattr(signals, "_FROZEN_S", 1.0)
    long = ("maneuver.phase=[{name='hover',duration_s=30.0,displacement_m=[0,0,0]}]", "clock.speed=1.0")
    injections = tuple(
        Injection(target=target, kind="STOP", since="first tick", after_s=after_s)
        for target, after_s in (("agent2", 0.3), (COMMAND, 0.6))
    )
    assert executed(tmp_path, long, *injections) == (-signal.SIGKILL, {})


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S + 60.0)
def test_four_runs(tmp_path: Path) -> None:
    """The first four runs end, leave no process, and have fitting exit codes."""
    arguments = ["signals", "--seed", SEED, "--runs", "4", "--out", str(tmp_path / "runs")]
    command = [sys.executable, "-m", "tests.campaigns", *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.splitlines()[-1] == f"signals, seed {SEED}: 4 runs, 0 with problems"
    assert not (tmp_path / "runs").exists()
