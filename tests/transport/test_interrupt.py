"""An interrupt ends the command `transport` with its exit code, wherever the command is at that moment."""

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from protocol.network.parent import python
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from transport.cli.main import app
from transport.flight.run import Finished
from transport.flight.run_error import RunError

# Stands in for the module with the commands; ends as if the interrupt came while it is imported or while it works.
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
    """Started like the command, as a module: only then CPython would end by the interrupt it remembers."""
    (tmp_path / "program.py").write_text(_PROGRAM.format(code=code))
    path = {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path.cwd())])}
    result = subprocess.run(
        python("program"), env={**os.environ, **path}, capture_output=True, text=True, timeout=60.0, check=False
    )
    assert (result.returncode, result.stdout, result.stderr) == (EXIT_INTERRUPTED, "", "")


@pytest.mark.parametrize("moment", ["while the run ends", "while the report is made", "a second time"])
def test_the_command_tells_what_is_kept(moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupted run names its log and the command that reports it, in one line."""
    folder = tmp_path / "run"

    def simulate(*_: Any) -> Finished:
        folder.mkdir()
        (folder / "run.mcap").touch()
        if moment == "while the run ends":
            raise KeyboardInterrupt
        if moment == "a second time":
            raise RunError("interrupted (SIGINT)", EXIT_INTERRUPTED)
        return Finished(folder, 0, "")

    def report(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("transport.cli.run_scenario.simulate", simulate)
    monkeypatch.setattr("transport.cli.run_report.report", report)
    result = CliRunner().invoke(app, ["run", "paper", "--no-figures", "--out", str(folder)])
    assert result.exit_code == EXIT_INTERRUPTED
    (line,) = result.stderr.splitlines()
    assert line.startswith("transport: interrupted")
    assert line.endswith(f"; kept {folder}/run.mcap, report it with: transport plot {folder}")


def test_a_run_interrupted_before_its_log_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a log the command says that nothing is recorded."""

    def simulate(*_: Any) -> Finished:
        raise KeyboardInterrupt

    monkeypatch.setattr("transport.cli.run_scenario.simulate", simulate)
    result = CliRunner().invoke(app, ["run", "paper", "--no-figures", "--out", str(tmp_path / "run")])
    assert (result.exit_code, result.stderr) == (EXIT_INTERRUPTED, "transport: interrupted; nothing is recorded\n")
