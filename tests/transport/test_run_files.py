"""Folders of runs: a start that fails or is interrupted leaves none, and no link to one."""

import os
from pathlib import Path

import pytest

from tests.support.runs import SHORT, setup
from transport.flight.run_files import RunError, new_run_folder


def run_with_log(folder: Path, at_s: float) -> Path:
    """Return a kept run folder whose log was written at a time."""
    with new_run_folder(folder, setup(SHORT)) as made:
        made.is_kept = True
    log = folder / "run.mcap"
    log.touch()
    os.utime(log, (at_s, at_s))
    return folder


def test_a_kept_folder_stays(tmp_path: Path) -> None:
    """It has the scenario, and the link to the most recent run leads to it."""
    with new_run_folder(tmp_path / "runs" / "a", setup(SHORT)) as made:
        made.is_kept = True
    scenario = tmp_path / "runs" / "latest" / "scenario.toml"
    assert scenario.read_text(encoding="utf-8") == made.scenario_toml


def failing_start(folder: Path, error: BaseException) -> None:
    """Raise an error in a run folder that has some content."""
    with new_run_folder(folder, setup(SHORT)) as made:
        (made.path / "logs").mkdir()
        raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RunError("refused", 4), OSError()])
def test_a_start_that_fails_leaves_no_folder(tmp_path: Path, error: BaseException) -> None:
    """Whatever ends the start, the folder goes, with all in it."""
    with pytest.raises(type(error)):
        failing_start(tmp_path / "a", error)
    assert list(tmp_path.iterdir()) == []


def test_the_link_returns_to_the_run_before(tmp_path: Path) -> None:
    """`latest` leads to the newest run that is left; without one there is no link."""
    runs = tmp_path / "runs"
    latest = runs / "latest"
    with pytest.raises(KeyboardInterrupt):
        failing_start(runs / "first", KeyboardInterrupt())
    assert not latest.is_symlink()

    run_with_log(runs / "older", 1e9)
    run_with_log(runs / "newer", 2e9)
    with pytest.raises(KeyboardInterrupt):
        failing_start(runs / "last", KeyboardInterrupt())
    assert latest.readlink() == Path("newer")


def test_an_existing_folder_is_left_alone(tmp_path: Path) -> None:
    """The refusal of a folder that exists removes nothing from it."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine").touch()
    with pytest.raises(RunError, match="does not exist yet"):
        failing_start(tmp_path / "a", KeyboardInterrupt())
    assert (tmp_path / "a" / "mine").exists()
