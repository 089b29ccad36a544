"""The file of an active run: what was written is read; any other content is refused in one line, never an exception."""

import os
import subprocess
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.flight import live
from transport.flight.live import LiveError, LiveRun

HERE = LiveRun("hover", {"coordinator": "tcp/127.0.0.1:7447", "agent1": "tcp/127.0.0.1:7448"}, os.getpid())


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """A run is active from `write` to `remove`."""
    folder = tmp_path / "run"
    folder.mkdir()
    live.write(folder, HERE)
    assert live.read(folder) == HERE
    assert live.newest_folder(tmp_path) == folder
    live.remove(folder)
    live.remove(folder)
    assert live.read(folder) is None
    assert live.newest_folder(tmp_path) is None
    assert list(folder.iterdir()) == []


def test_a_folder_that_is_gone(tmp_path: Path) -> None:
    """Marking a folder that was removed raises nothing: the run goes on."""
    live.write(tmp_path / "gone", HERE)
    live.remove(tmp_path / "gone")


def test_the_file_of_a_killed_run_is_ignored(tmp_path: Path) -> None:
    """A run whose process is gone is not active."""
    ended = subprocess.Popen(["true"])
    ended.wait()
    live.write(tmp_path, LiveRun(HERE.run, HERE.endpoints, ended.pid))
    assert live.read(tmp_path) is None


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("run", 5, "run: expected text, got 5"),
        ("run", "a/**", "expected the name of a run"),
        ("endpoints", {}, "expected endpoints by process, with that of coordinator"),
        ("endpoints", ["x"], "endpoints: "),
        ("endpoints", {"coordinator": 1}, "endpoints.coordinator: expected text, got 1"),
        ("pid", 0, "pid: expected a number > 0, got 0"),
        ("pid", True, "pid: expected an integer, got True"),
        ("pid", 2**40, f"pid: expected a number < {2**31}, got {2**40}"),
        ("keys", None, "keys: expected text, got None"),
        ("is_client", "no", "is_client: expected true or false, got 'no'"),
        ("run", "x" * 500, "run: "),
    ],
)
def test_other_values_are_refused(field: str, value: Any, expected: str, tmp_path: Path) -> None:
    """One line names file, field, expected, got."""
    path = tmp_path / "live.json"
    path.write_bytes(orjson.dumps({**asdict(HERE), field: value}))
    with pytest.raises(LiveError) as refused:
        live.read(tmp_path)
    assert str(refused.value).startswith(f"{path}: {field}")
    assert expected in str(refused.value)


@settings(max_examples=50, deadline=None)
@given(st.one_of(st.binary(max_size=200), st.recursive(st.none() | st.integers(-9, 9) | st.text(max_size=5), st.lists)))
def test_any_content(content: Any) -> None:
    """Other content is refused, whatever it is, in one line of bounded length."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "live.json").write_bytes(content if isinstance(content, bytes) else orjson.dumps(content))
        with pytest.raises(LiveError) as refused:
            live.read(folder)
        assert len(str(refused.value).splitlines()) == 1
        assert len(str(refused.value)) < 300
