"""Classes of the user: which file they come from, and that they do not end their process without a word."""

import os
import re
import threading
from pathlib import Path

import pytest

from transport.protocol.scenario.own_calls import OwnClassError, errors_of, new_object
from transport.protocol.scenario.own_class import own_class

CONTROL = """
import mine_number

class Control:
    number = mine_number.NUMBER
"""
ENDS = """
import os

class Ends:
    def __init__(self):
        os._exit(0)

class Forks:
    def __init__(self):
        child = os.fork()
        if child == 0:
            os._exit(7)
        self.status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
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


def test_a_package_of_another_folder_takes_the_place_of_the_one_before(
    numbered: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The current folder says which one is meant, also of modules within a package."""
    assert own_class("mine_package.control:Control").number == 1
    package(numbered.parent / "second", 2)
    monkeypatch.chdir(numbered.parent / "second")
    assert own_class("mine_package.control:Control").number == 2


def test_a_changed_module_that_a_class_imports_is_imported_anew(numbered: Path) -> None:
    """The class of the next call runs the code that is there."""
    before = own_class("mine_package.control:Control")
    assert own_class("mine_package.control:Control") is before
    package(numbered, 22)
    assert own_class("mine_package.control:Control").number == 22


def test_installed_packages_are_imported_once(numbered: Path) -> None:
    """A class of an installed package stays, whatever has changed in the user's folder."""
    array = own_class("numpy:ndarray")
    own_class("mine_package.control:Control")
    package(numbered, 333)
    assert own_class("mine_package.control:Control").number == 333
    assert own_class("numpy:ndarray") is array


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


def test_an_exit_in_a_constructor_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`os._exit` in a constructor is refused as its exceptions are, with file and line."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_ends.py").write_text(ENDS, encoding="utf-8")
    expected = r"the constructor raised SystemExit: os\._exit\(0\) \(mine_ends\.py:6\)"
    with pytest.raises(OwnClassError, match=expected):
        new_object(own_class("mine_ends:Ends"), ())


def test_an_exit_at_import_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`os._exit` in the user's module is refused as well."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_gone.py").write_text("import os\nos._exit(0)\n", encoding="utf-8")
    with pytest.raises(OwnClassError, match=r"raised SystemExit: os\._exit\(0\)"):
        own_class("mine_gone:Gone")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="without fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # this process has threads
def test_children_and_other_calls_end_as_they_ask_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A forked child of a class ends with its own exit code, and the function is itself again afterwards."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine_forks.py").write_text(ENDS, encoding="utf-8")
    before = os._exit
    assert new_object(own_class("mine_forks:Forks"), ()).status == 7
    assert os._exit is before


def test_another_thread_keeps_its_exit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The exit of a process by another thread, such as one that watches its parent, is not held up."""
    statuses: list[int] = []
    monkeypatch.setattr(os, "_exit", statuses.append)
    with errors_of("step"):
        thread = threading.Thread(target=lambda: os._exit(4))
        thread.start()
        thread.join()
    assert statuses == [4]
