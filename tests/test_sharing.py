"""The two workers of a test run: tests that start processes are found, and none of them is given to the second."""

import re
from pathlib import Path

import pytest

from tests import sharing

TESTS = Path(__file__).resolve().parent
FILES = sorted(path.relative_to(sharing.ROOT).as_posix() for path in TESTS.rglob("test_*.py"))
# A command of the project in a separate process.
STARTS = re.compile(r'"-m",\s*"(transport|benchmarks|deploy|tests)')


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("test_soak.py", True),  # by a module that it tests
        ("protocol/test_bus.py", True),  # by its own import
        ("transport/test_kills.py", True),  # by a helper
        ("transport/test_memory.py", False),
        ("model/test_compiled.py", False),  # processes without ports and deadlines
    ],
)
def test_imports_decide(file: str, *, expected: bool) -> None:
    """A test that imports sockets, directly or through a helper, is for the first worker."""
    assert f"tests/{file}" in FILES
    assert sharing.is_serial(f"tests/{file}") is expected


@pytest.mark.parametrize("file", [file for file in FILES if not sharing.is_serial(file)])
def test_the_second_worker_starts_no_runs(file: str) -> None:
    """No other test file starts a command of the project, neither itself nor by its helpers."""
    for path in sharing.helpers(sharing.ROOT / file) - {Path(__file__).resolve()}:
        assert not STARTS.search(path.read_text(encoding="utf-8")), path


def test_order(request: pytest.FixtureRequest) -> None:
    """The soak begins, the other tests with processes follow; no test is lost."""
    items = request.session.items
    files = [sharing.file_of(item.nodeid) for item in sharing.in_order(list(reversed(items)))]
    assert sorted(files) == sorted(sharing.file_of(item.nodeid) for item in items)
    serial = [sharing.is_serial(file) for file in files]
    assert serial == sorted(serial, reverse=True)
    if sharing.FIRST in files:
        assert files[0] == sharing.FIRST
