"""Runs whose processes get signals at random: some runs of the campaign, and what it finds."""

import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest

from tests.campaigns import early_signals
from tests.campaigns.harness import execute_all
from tests.campaigns.signals import execute, execute_run

# Its first run gets SEGV.
SEED, RUNS = 10, 1
EARLY = 4


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_signals_leave_order(tmp_path: Path) -> None:
    """Each run ends, leaves no process and no traceback, its log opens and its exit code fits."""
    found = list(execute_all(partial(execute), SEED, range(RUNS), tmp_path / "runs", jobs=2))
    assert [result for result in found if result.problems] == []
    assert len(found) == RUNS


@pytest.mark.slow
def test_early_signals_end_commands(tmp_path: Path) -> None:
    """Commands interrupted within their first second end, without a traceback, a process or a folder."""
    execute_early = partial(early_signals.execute)
    results = list(execute_all(execute_early, SEED, range(EARLY), tmp_path / "early", jobs=1))
    assert [result for result in results if result.problems] == []
    assert len(results) == EARLY


@pytest.mark.slow
def test_an_orphan_is_found_and_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that is left, a traceback, a log that does not open and a wrong exit code are told."""
    monkeypatch.setattr("tests.campaigns.signals._ORPHANS_S", 0.5)
    (tmp_path / "run").mkdir()  # the command refuses an existing folder and starts nothing
    (tmp_path / "run" / "run.mcap").write_bytes(b"not a log")
    (tmp_path / "run" / "agent1.log").write_text(
        "Traceback (most recent call last):\n  ...\nValueError: no\n"
    )
    words = ["transport", "agent", "--id", "7", "--run", "run"]
    with subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(600)", *words], cwd=tmp_path
    ) as left:
        code, problems = execute_run([], [], tmp_path, threading.Event())
        left.wait(10.0)
    assert code == 2
    assert problems["orphan"] == "agent7"
    assert problems["traceback"] == "agent1.log: ValueError: no"
    assert {"unreadable log", "wrong exit code"} <= problems.keys()
