"""Folders of runs that have not begun, and a current folder that has vanished."""

import signal
from pathlib import Path

import pytest

from tests.support.commands import PATIENCE_S, start, wait_for
from tests.support.results import here
from transport.protocol.wire.errors_and_exit_codes import (
    EXIT_INTERRUPTED,
    EXIT_SCENARIO,
    EXIT_USAGE,
)


@pytest.mark.slow
def test_a_run_interrupted_while_it_waits_leaves_no_folder(tmp_path: Path) -> None:
    """Before the first tick an interrupt leaves neither a run folder nor the link to it."""
    process = start("run", "paper", "--external", "agent1", cwd=tmp_path)
    runs = tmp_path / "runs"
    assert wait_for(lambda: any(runs.glob("*/live.json")))
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == EXIT_INTERRUPTED, errors
    assert output == ""
    assert errors.splitlines()[-1] == "transport: interrupted; nothing is recorded"
    assert [path.name for path in runs.iterdir()] == []


@pytest.mark.parametrize(
    "arguments",
    [("status",), ("plot",), ("validate", "paper", "--set", "agents.controller=mine:Hover")],
    ids=" ".join,
)
def test_commands_in_a_removed_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    """Without a current folder a command that needs one ends with one line, exit code 2 or 3."""
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    done = here(*arguments)
    assert done.exit_code in (EXIT_USAGE, EXIT_SCENARIO), done.stderr
    assert done.stderr.splitlines()[-1].startswith("transport: ")
