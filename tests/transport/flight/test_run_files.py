"""Folders of runs: a start that fails or is interrupted leaves none, and no link to one."""

import errno
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.runs import SHORT, setup
from transport.flight.run_files import RunError, new_run_folder, own_keys, run_header, started_ns
from transport.protocol.wire.errors_and_exit_codes import EXIT_USAGE

CLOCK_TICK_NS = 10**7  # of the times of processes


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


def test_the_secret_that_cannot_be_written_is_an_error_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is one line with the file and the reason, and leaves nothing."""
    scenario = setup(SHORT).scenario
    absent = tmp_path / "absent"
    with pytest.raises(RunError, match=rf"secret '{absent}/keys/.*' \(No such file") as caught:
        own_keys(scenario, absent).__enter__()
    assert caught.value.exit_code == EXIT_USAGE

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for name in ("touch", "write_text"):
        secret = own_keys(scenario, tmp_path)
        with monkeypatch.context() as patch:
            patch.setattr(Path, name, full)
            with pytest.raises(RunError, match="No space left"):
                secret.__enter__()
        assert list(tmp_path.iterdir()) == []


def test_an_error_of_the_run_is_not_one_of_its_secret(tmp_path: Path) -> None:
    """What fails while the secret exists passes as it is; the secret goes."""
    error = OSError(errno.ENOSPC, "of the run")
    with pytest.raises(OSError, match="of the run") as caught, own_keys(setup().scenario, tmp_path):
        raise error
    assert caught.value is error
    assert list(tmp_path.iterdir()) == []


def test_the_header_describes_run_and_machine() -> None:
    """It has the start of the command in ns, and processor, cores and system of the machine."""
    header = run_header(
        setup("seed=7"), "r1", 6, "the text", {"engine": "rods 1", "controller": "c"}
    )
    told = ("run_id", "scenario", "seed", "processes", "engine", "controller")
    assert [header[key] for key in told] == ["r1", "the text", "7", "6", "rods 1", "c"]
    assert header.keys() == {*told, "versions", "machine", "command_started_ns"}

    started_s = int(header["command_started_ns"]) / 1e9
    assert started_s == pytest.approx(started_ns() / 1e9, abs=1e-3)
    cores = len(os.sched_getaffinity(0))
    system = re.escape(f"{platform.system()} {platform.release()}")
    assert re.fullmatch(rf".+, {cores} cores?, {system}", header["machine"])


def test_the_start_of_a_process_is_told_to_its_clock_tick() -> None:
    """It lies between the call that starts a process and the first line that it executes."""
    code = (
        "import time; first_ns = time.time_ns();"
        "from transport.flight.run_files import started_ns; print(started_ns(), first_ns)"
    )
    called_ns = time.time_ns()
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    found_ns, first_ns = map(int, ran.stdout.split())
    assert called_ns - CLOCK_TICK_NS <= found_ns <= first_ns + CLOCK_TICK_NS
