"""Order of the tests of several workers: tests that start processes are in one folder, and begin."""

import ast
import re
from pathlib import Path

import pytest

from tests.support import workers

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("test_*.py"))
# Modules that start processes with ports and deadlines, or open sockets.
OUTSIDE = frozenset({"benchmarks.loop", "tests.support.soak", "distributed", "selenium", "socket", "zenoh"})
# A command of the project in a separate process.
STARTS = re.compile(r'"-m",\s*"(transport|benchmarks|deploy|tests)')


def imports(path: Path) -> set[str]:
    """Return the dotted names of all imports of a file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {str(node.module), *[f"{node.module}.{alias.name}" for alias in node.names]}
    return names


def reached(path: Path) -> set[Path]:
    """Return a test module and all files below tests/ that it imports, directly or through others."""
    found: set[Path] = set()
    waiting = [path]
    while waiting:
        at = waiting.pop()
        if at not in found:
            found.add(at)
            files = [ROOT.joinpath(*name.split(".")).with_suffix(".py") for name in imports(at)]
            waiting += [file for file in files if file.is_relative_to(ROOT / "tests") and file.exists()]
    return found


def test_tests_with_processes_are_in_their_folder() -> None:
    """A test file outside tests/system/ opens no socket and starts no command, neither itself nor by its helpers."""
    wrong = [
        f"{file} by {path}"
        for file in FILES
        if not workers.starts_processes(file)
        for path in reached(ROOT / file) - {Path(__file__).resolve()}
        if imports(path) & OUTSIDE or STARTS.search(path.read_text(encoding="utf-8"))
    ]
    assert wrong == []


def test_order(request: pytest.FixtureRequest) -> None:
    """The soak begins, the other tests with processes follow; no test is lost."""
    items = request.session.items
    files = [workers.file_of(item.nodeid) for item in workers.in_order(list(reversed(items)))]
    assert sorted(files) == sorted(workers.file_of(item.nodeid) for item in items)
    with_processes = [workers.starts_processes(file) for file in files]
    assert with_processes == sorted(with_processes, reverse=True)
    if workers.FIRST in files:
        assert files[0] == workers.FIRST
