"""The notebooks of examples/ run in a kernel and give the outputs that are stored in them."""

import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "examples"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST_BYTES = 300_000

# Lines that depend on the host's speed.
WALL_CLOCK = re.compile(r"^ *(simulated|agent step|rest of tick)\b|runs done|compiling|^$")


@pytest.fixture(scope="module")
def program() -> ModuleType:
    """Return the program that executes the notebooks."""
    spec = importlib.util.spec_from_file_location("execute", FOLDER / "execute.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def texts(cells: list[Any]) -> list[list[str]]:
    """Return the printed lines of each cell, without those that depend on the host, and the number of its figures."""
    found = []
    for cell in cells:
        lines: list[str] = []
        for output in cell.get("outputs", ()):
            if output["output_type"] == "stream":
                lines += "".join(output["text"]).splitlines()
            elif output["output_type"] == "execute_result" and "image/png" not in output["data"]:
                lines += "".join(output["data"]["text/plain"]).splitlines()
            elif "image/png" in output.get("data", {}):
                lines.append("figure")
        found.append([line.rstrip() for line in lines if not WALL_CLOCK.search(line)])
    return found


@pytest.mark.slow
@pytest.mark.pages
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_gives_its_outputs(path: Path, program: ModuleType) -> None:
    """A new kernel gives the stored texts and figures, cell by cell.

    Nothing else is written beside the notebook.
    """
    before = sorted(FOLDER.iterdir())
    stored = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert texts(program.executed(path).cells) == texts(stored)
    assert [entry for entry in sorted(FOLDER.iterdir()) if entry.name != "__pycache__"] == [
        entry for entry in before if entry.name != "__pycache__"
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks_are_small_and_show_something(path: Path) -> None:
    """A stored notebook has outputs and figures, no error, and no local path; it loads fast."""
    text = path.read_text(encoding="utf-8")
    assert len(text) < LARGEST_BYTES
    assert '"image/png"' in text
    assert '"output_type": "error"' not in text
    assert "\\u001b" not in text
    assert re.search(r"\D/(home|tmp|root|work)/", text) is None
    code = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] for cell in code)
    assert len(NOTEBOOKS) == 4
