"""A run survives what happens to its files: some runs of the folders campaign."""

import threading
from pathlib import Path

import pytest

from tests.campaigns.folders import DAMAGES, can_mount, execute


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", ["folder removed", "disk full", "file size limit"])
def test_a_run_without_a_place_for_its_log_says_so(name: str, tmp_path: Path) -> None:
    """The team flies to the end of the run, a line and exit code 10 tell, and no process is left."""
    if DAMAGES[name].on == "disk" and not can_mount():
        pytest.skip("expected the right to mount in a namespace of its own")
    number = [key for key, damage in DAMAGES.items() if damage.on != "disk" or can_mount()].index(name)
    result = execute(0, number, tmp_path, threading.Event())
    assert (result.label, result.outcome, result.problems) == (name, "exit 10", {})
