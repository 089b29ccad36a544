"""The folders campaign: what it does is drawn from numbers, and a run survives what happens to its files."""

from pathlib import Path

import pytest

from tests.campaigns.folders import DAMAGES, can_mount, execute


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", ["folder removed", "disk full"])
def test_a_run_survives(name: str, tmp_path: Path) -> None:
    """It flies to its end, the log is whole in its second place, and no process is left."""
    if DAMAGES[name].on and not can_mount():
        pytest.skip("expected the right to mount in a namespace of its own")
    result = execute(0, name, tmp_path / "run")
    assert (result.exit_code, result.problems) == (0, ())


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", ["file size limit", "both places full"])
def test_a_run_without_any_place_says_so(name: str, tmp_path: Path) -> None:
    """It flies to its end unrecorded, and the exit code tells."""
    if name == "both places full" and not can_mount():
        pytest.skip("expected the right to mount in a namespace of its own")
    result = execute(0, name, tmp_path / "run")
    assert (result.exit_code, result.problems) == (10, ())
