"""Classes of the user: which file they come from, and the place of their errors."""

import re
from pathlib import Path

import pytest

from transport.protocol.scenario.user_class.user_errors import OwnClassError
from transport.protocol.scenario.user_class.user_import import own_class, version_of

CONTROL = """
import mine_number

class Control:
    number = mine_number.NUMBER
"""


def package(folder: Path, number: int) -> None:
    """Write a package with a class that has a number, which a module beside it gives."""
    (folder / "mine_package").mkdir(parents=True, exist_ok=True)
    (folder / "mine_package" / "__init__.py").touch()
    (folder / "mine_package" / "control.py").write_text(CONTROL, encoding="utf-8")
    (folder / "mine_number.py").write_text(f"NUMBER = {number}\n", encoding="utf-8")


@pytest.fixture
def numbered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder, the current one, with the package of number 1."""
    package(tmp_path / "first", 1)
    monkeypatch.chdir(tmp_path / "first")
    return tmp_path / "first"


def test_a_package_of_another_folder_is_refused(
    numbered: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module is imported once: the one of another folder would silently take the place of the one here."""
    assert own_class("mine_package.control:Control").number == 1
    package(numbered.parent / "second", 2)
    monkeypatch.chdir(numbered.parent / "second")
    with pytest.raises(
        OwnClassError, match=r"has the name of the imported package .*restart Python"
    ):
        own_class("mine_package.control:Control")


def test_the_version_is_that_of_the_code_that_runs(numbered: Path) -> None:
    """A file that changes after its import changes neither the class nor its version."""
    before = own_class("mine_package.control:Control")
    version = version_of(before)
    with (numbered / "mine_package" / "control.py").open("a", encoding="utf-8") as file:
        file.write("# changed\n")
    assert own_class("mine_package.control:Control") is before
    assert version_of(before) == version


@pytest.mark.parametrize(
    ("code", "place"),
    [("json.loads('bad')", "mine_place.py:3"), ("import missing_module", "mine_place.py:3")],
)
def test_an_error_has_the_line_of_the_users_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, place: str
) -> None:
    """Also where the exception rises in Python's own modules."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_place.py").write_text(f"import json\n\n{code}\n", encoding="utf-8")
    with pytest.raises(OwnClassError, match=rf"\({re.escape(place)}\)$"):
        own_class("mine_place:Place")
