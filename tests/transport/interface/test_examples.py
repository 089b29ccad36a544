"""The examples in the docstrings of the Python interface are what they say."""

import doctest
from importlib import import_module
from pathlib import Path

import pytest

import transport

FOLDER = Path(transport.__file__).parent / "interface"
MODULES = sorted(
    path.stem for path in FOLDER.glob("*.py") if ">>> " in path.read_text(encoding="utf-8")
)
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
