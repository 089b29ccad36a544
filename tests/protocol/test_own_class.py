"""Classes of the user do not end the process that calls them without a word."""

import os
import threading
from pathlib import Path

import pytest

from transport.protocol.scenario.own_class import OwnClassError, errors_of, new_object, own_class

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
