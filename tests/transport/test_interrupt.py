"""An interrupt ends the command `transport` with its exit code, wherever the command is at that moment."""

import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.support import runs
from transport.cli.main import app
from transport.flight import memory, signals
from transport.flight.run import Finished
from transport.flight.signals import raise_interrupts
from transport.protocol.network.parent import ending_signals, python
from transport.protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.protocol.wire.messages import Message

# Stands in for the module with the commands; ends as if the interrupt came while it is imported or
# while it works.
_PROGRAM = """
import sys, types
class Commands(types.ModuleType):
    def __getattr__(self, name):
        {code}
sys.modules["transport.cli.main"] = Commands("commands")
from transport.__main__ import main
main()
"""


@pytest.mark.parametrize(
    "code",
    [
        pytest.param("raise KeyboardInterrupt", id="in a module"),
        pytest.param("exec('raise KeyboardInterrupt')", id="in a text, as dataclasses run them"),
        pytest.param(f"return lambda **_: sys.exit({EXIT_INTERRUPTED})", id="in a command"),
    ],
)
def test_the_exit_code_is_that_of_the_table(code: str, tmp_path: Path) -> None:
    """Started like the command, as a module.

    Only then CPython would end by the interrupt it remembers.
    """
    (tmp_path / "program.py").write_text(_PROGRAM.format(code=code))
    path = {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path.cwd())])}
    result = subprocess.run(
        python("program"),
        env={**os.environ, **path},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert (result.returncode, result.stdout, result.stderr) == (EXIT_INTERRUPTED, "", "")


@pytest.mark.parametrize("moment", ["while the run ends", "while the report is made"])
def test_the_command_tells_what_is_kept(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupted run names its log and the command that reports it, in one line."""
    folder = tmp_path / "run"

    def simulate(*_: Any) -> Finished:
        folder.mkdir()
        (folder / "run.mcap").touch()
        if moment == "while the run ends":
            raise KeyboardInterrupt
        return Finished(folder, 0, "")

    def report(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("transport.cli.run.simulate", simulate)
    monkeypatch.setattr("transport.cli.plot.report", report)
    result = CliRunner().invoke(app, ["run", "paper", "--no-figures", "--out", str(folder)])
    assert result.exit_code == EXIT_INTERRUPTED
    (line,) = result.stderr.splitlines()
    assert line.startswith("transport: interrupted")
    assert line.endswith(f"; kept {folder}/run.mcap, report it with: transport plot {folder}")


def test_a_run_interrupted_before_its_log_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a log the command says that nothing is recorded."""

    def simulate(*_: Any) -> Finished:
        raise KeyboardInterrupt

    monkeypatch.setattr("transport.cli.run.simulate", simulate)
    result = CliRunner().invoke(
        app, ["run", "paper", "--no-figures", "--out", str(tmp_path / "run")]
    )
    assert (result.exit_code, result.stderr) == (
        EXIT_INTERRUPTED,
        "transport: interrupted; nothing is recorded\n",
    )


def test_a_suppressed_interrupt_ends_a_run_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled code that calls Python may suppress the exception of a signal.

    The run ends all the same.
    """
    monkeypatch.setattr(signals, "_raised", [])
    before = {number: signal.getsignal(number) for number in ending_signals()}
    recorded = 0

    def record(_: Message) -> None:
        nonlocal recorded
        recorded += 1
        if recorded == 3:
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)

    try:
        raise_interrupts()
        with pytest.raises(KeyboardInterrupt, match="SIGTERM"):
            memory.simulate(runs.setup(runs.SHORT), record)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert recorded < 100, "the run went on"


def test_signals_the_user_ignores_stay_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command in the background of a shell without job control, or started with nohup, ends by SIGTERM only."""
    monkeypatch.setattr(signals, "_raised", [])
    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
    }
    try:
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        raise_interrupts()
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP)] == [
            signal.SIG_IGN
        ] * 2
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
