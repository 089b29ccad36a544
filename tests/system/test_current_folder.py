"""The user's own files in the current folder: they neither break a run nor hide a package without a message."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.commands import PATIENCE_S, SHORT, settings

TRAP = 'raise RuntimeError("imported from the current folder")\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a file named like one of our packages."""
    (tmp_path / "model.py").write_text(TRAP, encoding="utf-8")
    return tmp_path


def imported(folder: Path) -> subprocess.CompletedProcess[str]:
    """Import the project with a folder on the path, as `python -c` and notebooks do."""
    command = [sys.executable, "-c", "import transport"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.mark.slow
def test_a_run_does_not_import_from_the_current_folder(folder: Path) -> None:
    """The installed command completes a run, with every child process started in that folder."""
    words = ["run", "paper", *settings(SHORT), "--out", "out", "--no-figures"]
    command = [str(Path(sys.executable).with_name("transport")), *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S * 2, check=False)
    assert done.returncode == 0, done.stderr
    assert (folder / "out" / "summary.json").exists()


def test_an_import_names_the_file_that_hides_a_package(folder: Path) -> None:
    """With the current folder on the path, importing the project names the file and the package that it hides."""
    done = imported(folder)
    (file,) = folder.rglob("*.py")
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ImportError: payload-transport: {file} hides its package ")
    assert "imported from the current folder" not in done.stderr
