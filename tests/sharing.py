"""Two pytest workers share the tests: one runs those that start processes or open sockets, the other one the rest.

Tests of the first kind use both processors, ports, and names of runs that the whole machine sees, and wait for much of
their time: two of them at once would disturb each other. The rest compute in one process.
"""

import ast
from functools import cache
from pathlib import Path

import pytest
from xdist.scheduler import LoadFileScheduling

ROOT = Path(__file__).resolve().parent.parent

# Test modules that import one of these, directly or through helpers below tests/, are for the first worker.
SERIAL = frozenset(
    {"benchmarks.loop", "benchmarks.soak", "benchmarks.watched", "distributed", "selenium", "socket", "zenoh"}
)

# Begins before all others: its two minutes are mostly waiting, which leaves room for style and types beside the tests,
# and its deadlines are missed less often, not more often, when they are done.
FIRST = "tests/test_soak.py"


@cache
def imports(path: Path) -> frozenset[str]:
    """Return the dotted names of all imports of a file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {str(node.module), *[f"{node.module}.{alias.name}" for alias in node.names]}
    return frozenset(names)


def helpers(path: Path) -> set[Path]:
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


def file_of(nodeid: str) -> str:
    """Return the file of a test, relative to the project."""
    return nodeid.partition("::")[0]


@cache
def is_serial(file: str) -> bool:
    """Return whether the tests of a file, given relative to the project, start processes or open sockets."""
    return any(imports(path) & SERIAL for path in helpers(ROOT / file))


def in_order(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return the soak first, then the other tests with processes, then files with slow tests, then the rest.

    Long files last would leave one worker waiting for the other at the end.
    """
    slow = {file_of(item.nodeid) for item in items if item.get_closest_marker("slow")}

    def rank(item: pytest.Item) -> int:
        file = file_of(item.nodeid)
        return 0 if file == FIRST else 1 if is_serial(file) else 2 if file in slow else 3

    return sorted(items, key=rank)


class Sharing(LoadFileScheduling):  # type: ignore[misc]
    """Scheduler of pytest-xdist: tests with processes are one work unit, the first one; each other file is one."""

    def _split_scope(self, nodeid: str) -> str:
        file = file_of(nodeid)
        return "serial" if is_serial(file) else file
