"""A run survives what happens to its files: some runs of the folders campaign."""

import threading
from pathlib import Path

import pytest

from tests.campaigns.folders import DAMAGES, can_mount, execute


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("name", "outcome"), [("folder removed", "exit 0"), ("disk full", "exit 0"), ("file size limit", "exit 10")]
)
def test_a_run_survives(name: str, outcome: str, tmp_path: Path) -> None:
    """It is simulated to its end, its log is where the command says, the exit code tells, and no process is left."""
    if DAMAGES[name].on == "disk" and not can_mount():
        pytest.skip("expected the right to mount in a namespace of its own")
    number = [key for key, damage in DAMAGES.items() if can_mount() or damage.on not in ("disk", "full")].index(name)
    result = execute(0, number, tmp_path, threading.Event())
    assert (result.label, result.outcome, result.problems) == (name, outcome, {})
