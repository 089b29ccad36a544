"""The register of active runs: runs in any folder are found, and only this user's."""

import os
from pathlib import Path

import pytest

from transport.flight import active_runs, register_of_active_runs
from transport.flight.active_runs import LiveRun

HERE = LiveRun("hover", {"coordinator": "tcp/127.0.0.1:7447"}, os.getpid())


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of a register of this test, which does not exist yet."""
    monkeypatch.setenv(register_of_active_runs.PLACE, str(tmp_path / "register"))
    return tmp_path / "register"


def begun(folder: Path, at_s: float) -> Path:
    """Return a run folder whose run became active at a time."""
    folder.mkdir(parents=True)
    active_runs.write(folder, HERE)
    os.utime(folder / "live.json", (at_s, at_s))
    return folder


@pytest.mark.usefixtures("place")
def test_the_newest_run_of_any_folder_is_found(tmp_path: Path) -> None:
    """Runs below the parent come first, then the one that became active last, until it ends."""
    runs = tmp_path / "runs"
    older = begun(tmp_path / "a" / "older", 1e9)
    newer = begun(tmp_path / "b" / "newer", 2e9)
    assert active_runs.newest_folder(runs) == newer
    active_runs.remove(newer)
    assert active_runs.newest_folder(runs) == older
    below = begun(runs / "below", 0.5e9)
    assert active_runs.newest_folder(runs) == below
    active_runs.remove(below)
    active_runs.remove(older)
    assert active_runs.newest_folder(runs) is None
    assert register_of_active_runs.folders() == []


@pytest.mark.usefixtures("place")
def test_a_folder_that_has_gone_is_no_active_run(tmp_path: Path) -> None:
    """A run folder that was removed while its run was active is passed over."""
    folder = begun(tmp_path / "gone", 1e9)
    (folder / "live.json").unlink()
    folder.rmdir()
    assert register_of_active_runs.folders() == [folder]
    assert active_runs.newest_folder(tmp_path / "runs") is None


def test_a_register_that_others_can_change_is_not_used(tmp_path: Path, place: Path) -> None:
    """Neither one with rights for others nor a link to a folder is read or written."""
    place.mkdir(mode=0o700)
    elsewhere = begun(tmp_path / "run", 1e9)
    assert active_runs.newest_folder(tmp_path / "runs") == elsewhere

    place.chmod(0o755)
    assert active_runs.newest_folder(tmp_path / "runs") is None

    place.chmod(0o700)
    place.rename(tmp_path / "moved")
    place.symlink_to(tmp_path / "moved", target_is_directory=True)
    assert active_runs.newest_folder(tmp_path / "runs") is None
    register_of_active_runs.remove(elsewhere)
    assert len(list((tmp_path / "moved").iterdir())) == 1


def test_without_a_place_a_run_is_active_in_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A register that cannot be made changes nothing else: the run is found by its folder."""
    monkeypatch.setenv(register_of_active_runs.PLACE, "/dev/null/register")
    folder = begun(tmp_path / "run", 1e9)
    assert active_runs.read(folder) == HERE
    assert active_runs.newest_folder(tmp_path / "runs") is None
