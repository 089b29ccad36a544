"""An interrupt ends the command `transport` with its exit code, wherever the command is at that moment."""

import os
import subprocess
from pathlib import Path

import pytest

from protocol.network.parent import python
from protocol.wire.exit_codes import EXIT_INTERRUPTED

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
