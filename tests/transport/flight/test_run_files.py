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
from transport.flight.run_files import (
    RunError,
    checked,
    machine,
    new_run_folder,
    own_keys,
    run_header,
    started_ns,
    versions,
)
from transport.log.run_folder import point_latest
from transport.model.kernels import native
from transport.protocol.wire.errors_and_exit_codes import EXIT_SCENARIO, EXIT_USAGE

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


def test_the_link_to_a_later_run_stays(tmp_path: Path) -> None:
    """A start that fails leaves `latest` alone if another run has begun meanwhile."""
    folder = tmp_path / "runs"
    run_with_log(folder / "older", 1e9)
    with pytest.raises(KeyboardInterrupt), new_run_folder(folder / "fails", setup(SHORT)):  # noqa: PT012
        (folder / "later").mkdir()
        point_latest(folder / "later")
        raise KeyboardInterrupt
    assert (folder / "latest").readlink() == Path("later")


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


@pytest.mark.parametrize(
    "settings",
    [
        ("network.secret=false",),
        ("network.keys=keys",),
        ("network.router=tcp/192.0.2.1:7447", "network.insecure=true"),
    ],
)
def test_a_run_with_other_keys_or_none_has_no_secret(
    settings: tuple[str, ...], tmp_path: Path
) -> None:
    """Its folder stays empty."""
    with own_keys(setup(*settings).scenario, tmp_path) as keys:
        assert keys is None
        assert list(tmp_path.iterdir()) == []


def test_only_the_owner_can_read_the_secret(tmp_path: Path) -> None:
    """It is another one for each run, and goes with it."""
    secrets = set()
    mask = os.umask(0)
    try:
        for _ in range(2):
            with own_keys(setup().scenario, tmp_path) as keys:
                assert keys is not None
                (file,) = keys.iterdir()
                assert [path.stat().st_mode & 0o777 for path in (keys, file)] == [0o700, 0o600]
                secrets.add(file.read_text(encoding="utf-8"))
            assert list(tmp_path.iterdir()) == []
    finally:
        os.umask(mask)
    assert len(secrets) == 2
    assert all(re.fullmatch(r"run:[0-9a-f]{48}\n", secret) for secret in secrets)


@pytest.mark.parametrize("mode", [0o640, 0o604])
def test_a_secret_that_others_could_read_is_refused(
    mode: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a folder that keeps no permissions; the remedies are named."""
    monkeypatch.setattr(
        Path, "touch", lambda path, **_: os.close(os.open(path, os.O_CREAT, mode=mode))
    )
    mask = os.umask(0)
    try:
        with pytest.raises(
            RunError, match="expected a file that only its owner can read"
        ) as caught:
            own_keys(setup().scenario, tmp_path).__enter__()
    finally:
        os.umask(mask)
    assert caught.value.exit_code == EXIT_SCENARIO
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("external", "controller", "engine"),
    [
        ((), "mpc", "rods"),
        (("agent1", "agent2"), "mpc", "rods"),
        (("agent1", "agent2", "agent3", "agent4"), "external", "rods"),
        (("plant",), "mpc", "external"),
    ],
)
def test_classes_of_processes_from_elsewhere_are_external(
    external: tuple[str, ...], controller: str, engine: str
) -> None:
    """The controller only if all agents are."""
    found = checked(setup(), external)
    assert found["controller"] == controller
    assert found["engine"].startswith(engine)


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


@pytest.mark.parametrize(("cores", "told"), [({3}, "1 core"), ({1, 3}, "2 cores")])
def test_versions_and_cores_are_told(
    cores: set[int], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of kernels too, and the cores that this process may use."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: cores)
    assert f", {told}, {platform.system()}" in machine()
    assert versions().startswith(f"python {platform.python_version()}, payload-transport ")
    assert versions().endswith(f", kernels {native.description()}")


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
