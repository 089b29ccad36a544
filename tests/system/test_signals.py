"""The signals campaign: runs are drawn from numbers, each kind of problem is found, and four runs succeed."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.campaigns import inspection
from tests.campaigns.inspection import processes_below
from tests.campaigns.signal_runs import Injection, SignalRun
from tests.campaigns.signals import execute_run

ROOT = Path(__file__).parents[2]
HOVER = ("maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]}]",)
REFUSED = ("controller.horizon=0",)
# Its first four runs signal a process that draws, the viewer, an agent and its successor, and have no long stop.
SEED = "665"
# Four runs, two at a time, on a slow machine: each may wait ten seconds until the network gives up a process.
PATIENCE_S = 240.0


def executed(tmp_path: Path, drawn: tuple[str, ...], *injections: Injection) -> tuple[int, dict[str, str]]:
    """Return exit code and problems of a run."""
    run = SignalRun(number=3, settings=drawn, injections=injections)
    return execute_run(run, tmp_path, threading.Event())[:2]


def test_a_run_without_injections(tmp_path: Path) -> None:
    """An undisturbed run has no problem and leaves no process."""
    assert executed(tmp_path, HOVER) == (0, {})
    assert processes_below(tmp_path) == {}


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
@pytest.mark.timeout(PATIENCE_S + 60.0)
def test_four_runs(tmp_path: Path) -> None:
    """The first four runs end, leave no process, and have fitting exit codes."""
    arguments = ["signals", "--seed", SEED, "--runs", "4", "--out", str(tmp_path / "runs")]
    command = [sys.executable, "-m", "tests.campaigns", *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.splitlines()[-1] == f"signals, seed {SEED}: 4 runs, 0 with problems"
    assert not (tmp_path / "runs").exists()
