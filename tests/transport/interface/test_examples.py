"""The examples in the docstrings of the Python interface are what they say."""

import doctest
import re
from importlib import import_module
from pathlib import Path

import pytest

import transport

FOLDER = Path(transport.__file__).parent / "interface"
MODULES = sorted(
    path.stem for path in FOLDER.glob("*.py") if ">>> " in path.read_text(encoding="utf-8")
)
EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
CEILING_M = 10.9  # of the notebook
PUBLIC = ("fly", "load", "sweep", "Scenario", "Run", "RunSeries")


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name: str) -> None:
    """Each example of a module gives the output that stands below it."""
    result = doctest.testmod(import_module(f"transport.interface.{name}"))
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_have_examples(name: str) -> None:
    """Functions and classes that users call first show an example."""
    assert ">>> " in (getattr(transport, name).__doc__ or "")


def test_own_team_shows_what_it_says() -> None:
    """In the stored outputs the penalty on the payload's speed damps the swing, and the ceiling is kept."""
    text = (EXAMPLES / "own_team.ipynb").read_text(encoding="utf-8")
    rows = re.findall(r"(plain|penalty|too): highest ([\d.]+) m, swing at the end ([\d.]+) m", text)
    highest_m = {name: float(highest) for name, highest, _ in rows}
    swing_m = {name: float(swing) for name, _, swing in rows}
    assert swing_m["penalty"] < swing_m["plain"]
    assert highest_m["too"] <= CEILING_M < highest_m["penalty"]
