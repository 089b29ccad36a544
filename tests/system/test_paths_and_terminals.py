"""Paths that no file can have, text that is not ASCII, and output that cannot be written.

One line, the right code.
"""

import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.commands import (
    PATIENCE_S,
    SHORT,
    command,
    processes_of,
    settings,
    start,
    wait_for,
)
from tests.support.results import here

USAGE, SCENARIO, UNRECORDED = 2, 3, 10
LONG = "a" * 300


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("validate", f"{LONG}.toml"), USAGE),
        (("scenario", "new", "--uavs", "4", "--from", LONG), SCENARIO),
        (("run", "paper", "--set", r'network.keys="a\u0000b"'), SCENARIO),
        (("run", "paper", "--set", r'network.host="a\u0000b"'), SCENARIO),
        (("run", "paper", "--set", f"network.keys={LONG}", "--no-figures"), SCENARIO),
        (("run", "paper", "--set", f"network.host={LONG}"), SCENARIO),
        (("run", "paper", "--out", LONG), USAGE),
        (("run", "paper", "--out", os.fsdecode(b"\xff")), USAGE),
        (("record", "--out", LONG), USAGE),
        *((("log", *rest), USAGE) for rest in (("info", LONG), ("export", LONG, "--out", "t"))),
        *(
            ((name, LONG, *rest), USAGE)
            for name, *rest in (("plot",), ("view",), ("replay", "--agent", "1"))
        ),
        (("compare", LONG, "other"), USAGE),
        (("scenario", "new", "--uavs", "4", "--out", LONG), USAGE),
        (("deploy", "render", "--hosts", LONG, "--out", "r"), USAGE),
    ],
    ids=lambda value: (
        " ".join(value).replace(LONG, "LONG") if isinstance(value, tuple) else str(value)
    ),
)
def test_a_path_that_no_file_can_have(
    words: tuple[str, ...], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name over 255 bytes, a null character and bytes that are not UTF-8 are refused in one line."""
    monkeypatch.chdir(tmp_path)
    result = here(*words)
    assert result.exit_code == code
    lines = [
        line for line in result.stderr.splitlines() if not line.startswith("compiling the model")
    ]
    assert len(lines) == 1
    assert lines[0].startswith("transport: ")


def test_a_cache_that_cannot_be_written_is_told_in_a_line(tmp_path: Path) -> None:
    """Each of the two libraries would be compiled; the warning comes once, without lines of code."""
    no_folder = tmp_path / "file"
    no_folder.write_text("", encoding="utf-8")
    done = subprocess.run(
        command("validate", "resilient"),
        env={**os.environ, "PAYLOAD_TRANSPORT_CACHE": str(no_folder / "cache")},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    warned = [line for line in done.stderr.splitlines() if "plain ones are used" in line]
    assert len(warned) == 1
    assert warned[0].startswith(f"transport: warning: no compiled kernels: the cache {no_folder}")


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
@pytest.mark.parametrize("words", [("validate", "paper", "--format", "json"), ("--help",)])
def test_standard_output_on_a_full_disk(words: tuple[str, ...]) -> None:
    """Results that cannot be written are told in one line, with exit code 10."""
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            command(*words),
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
    assert done.returncode == UNRECORDED
    expected = "transport: standard output: cannot write the results (No space left on device)"
    assert done.stderr.splitlines()[-1] == expected
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
def test_log_and_standard_error_on_a_full_disk(tmp_path: Path) -> None:
    """A run whose log and messages cannot be written goes on to its end.

    Its exit code is 10, and the log opens.
    """

    def limited() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))

    with Path("/dev/full").open("wb") as full:
        words = command(
            "run", "resilient", *settings(SHORT), "--no-figures", "--out", tmp_path / "out"
        )
        done = subprocess.run(
            words,
            stdout=full,
            stderr=full,
            preexec_fn=limited,
            timeout=PATIENCE_S,
            check=False,
        )
    assert done.returncode == UNRECORDED
    assert here("log", "info", tmp_path / "out").exit_code == 0


NO_HOME = """
import os, pwd, sys

def unknown(uid):
    raise KeyError(uid)

os.environ.pop("HOME", None)
os.environ.pop("XDG_CACHE_HOME", None)
os.environ.pop("PAYLOAD_TRANSPORT_CACHE", None)
pwd.getpwuid = unknown
from transport.__main__ import main
main()
"""


def test_a_user_without_a_home(tmp_path: Path) -> None:
    """A user id without an entry and without HOME, as in a container, validates a scenario."""
    done = subprocess.run(
        [sys.executable, "-c", NO_HOME, "validate", "paper"],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / f"payload-transport-{os.getuid()}").is_dir()


@pytest.mark.slow
@pytest.mark.parametrize("removed", ["log", "folder"])
def test_a_log_removed_during_the_run(removed: str, tmp_path: Path) -> None:
    """A run whose log, or whole folder, is removed meanwhile is completed, and ends with code 10."""
    hover = "maneuver.phase=[{name='hover', duration_s=2.0, displacement_m=[0.0, 0.0, 0.0]}]"
    options = [*settings(hover, "clock.speed=1.0"), "--out", "run", "--no-figures"]
    run = start("run", "paper", *options, cwd=tmp_path)
    log = tmp_path / "run" / "run.mcap"
    assert wait_for(lambda: log.exists() and log.stat().st_size > 10_000)
    if removed == "log":
        log.unlink()
    else:
        shutil.rmtree(tmp_path / "run")
    _, errors = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == UNRECORDED, errors
    assert "cannot write the log (the file has been removed)" in errors
    assert "the run completed" in errors
    assert "Traceback" not in errors
    assert processes_of("run") == {}
