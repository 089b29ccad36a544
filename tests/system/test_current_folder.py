"""The user's own files in the current folder disturb neither imports nor runs, whatever their names."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.commands import PATIENCE_S, SHORT, settings

TRAP = 'raise RuntimeError("imported from the current folder")\n'
FOLDERS = ("model", "mpc", "agent", "plant", "protocol", "coordinator", "deploy", "scenarios")

HOVER = "[{'name': 'hover', 'duration_s': 0.2, 'displacement_m': [0, 0, 0]}]"
CONTROLLER = """
class Hover:
    def start(self, run):
        self.run = run

    def step(self, measurement, messages):
        return self.run.u_hover[:4]

    def stop(self):
        pass
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with files named like the folders of the project."""
    for name in FOLDERS:
        (tmp_path / f"{name}.py").write_text(TRAP, encoding="utf-8")
    return tmp_path


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder that is on its path, as with `python -c` and in notebooks."""
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False
    )


@pytest.mark.slow
def test_a_run_does_not_import_from_the_current_folder(folder: Path) -> None:
    """The installed command completes a run, with every child process started in that folder."""
    words = ["run", "paper", *settings(SHORT), "--out", "out", "--no-figures"]
    done = python(folder, str(Path(sys.executable).with_name("transport")), *words)
    assert done.returncode == 0, done.stderr
    assert (folder / "out" / "summary.json").exists()


def test_an_import_does_not_import_from_the_current_folder(folder: Path) -> None:
    """With the current folder on the path, the whole interface is imported from the project."""
    program = "import transport; print([getattr(transport, name) for name in transport.__all__])"
    done = python(folder, "-c", program)
    assert done.returncode == 0, done.stderr


def test_an_own_class_may_lie_in_a_file_of_any_name(folder: Path) -> None:
    """A controller in a file named like a folder of the project, or like a module of Python, flies."""
    names = ("agent", "test")
    for name in names:
        (folder / f"{name}.py").write_text(CONTROLLER, encoding="utf-8")
    program = (
        "import transport\n"
        f"for name in {names}:\n"
        f"    own = dict(controller=name + ':Hover', phases={HOVER})\n"
        "    run = transport.fly('resilient', **own, progress=False)\n"
        "    print(run.summary['solver']['failures'])"
    )
    done = python(folder, "-c", program)
    assert (done.returncode, done.stdout) == (0, "0\n0\n"), done.stderr


def test_a_file_with_the_name_of_an_imported_package_is_refused(tmp_path: Path) -> None:
    """The refusal names the file and the package: it must not replace the package for others."""
    (tmp_path / "numpy.py").write_text(CONTROLLER, encoding="utf-8")
    words = ["validate", "resilient", "--set", "agents.controller=numpy:Hover"]
    done = python(tmp_path, str(Path(sys.executable).with_name("transport")), *words)
    assert done.returncode == 3
    assert f"{tmp_path / 'numpy.py'} has the name of the imported package" in done.stderr
    assert "rename it" in done.stderr


@pytest.mark.slow
def test_a_run_in_odd_surroundings(tmp_path: Path) -> None:
    """A deleted current folder, the POSIX locale, a path beyond ASCII and a reader that leaves: it completes."""
    gone, out = tmp_path / "gone", tmp_path / "ünï 😀"
    gone.mkdir()
    # One agent: without a current folder each process is a program of its own, with its own imports.
    words = [
        "run",
        "paper",
        *settings(SHORT, "agents.owned=[[1,2,3,4]]"),
        "--out",
        str(out),
        "--no-figures",
    ]
    program = f"import os, sys; os.rmdir({str(gone)!r}); os.execv(sys.executable, sys.argv[1:])"
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-c", program, sys.executable, "-P", "-m", "transport", *words],
        cwd=gone,
        env={**os.environ, "LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        stdout=writing,
        stderr=subprocess.PIPE,
        timeout=2 * PATIENCE_S,
        check=False,
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, b"")
    assert (out / "summary.json").exists()
