"""Scheduling of the pytest workers: at most two tests at a time start processes or open sockets, the others compute.

Tests of the first kind spend much of their time waiting: two of them at once use the time of the other's waits, more
would make each other slow.
"""

from pathlib import Path

import pytest
from xdist.scheduler import LoadFileScheduling

# Folder of the test files of the first kind.
SYSTEM = "tests/system/"

# Runs before all other tests: it mostly waits for two minutes, which leaves processor time for style and type checks.
FIRST = "tests/system/test_soak.py"

_ROOT = Path(__file__).resolve().parent.parent.parent
_FILES = sorted(path.relative_to(_ROOT).as_posix() for path in (_ROOT / SYSTEM).glob("test_*.py"))


def file_of(nodeid: str) -> str:
    """Return the file of a test, relative to the project."""
    return nodeid.partition("::")[0]


def starts_processes(file: str) -> bool:
    """Return whether the tests of a file, given relative to the project, start processes or open sockets."""
    return file.startswith(SYSTEM)


def in_order(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return the soak first, then the other tests with processes, then files with slow tests, then the rest.

    A long file at the end would leave one worker idle.
    """
    slow = {file_of(item.nodeid) for item in items if item.get_closest_marker("slow")}

    def rank(item: pytest.Item) -> int:
        file = file_of(item.nodeid)
        return 0 if file == FIRST else 1 if starts_processes(file) else 2 if file in slow else 3

    return sorted(items, key=rank)


class Sharing(LoadFileScheduling):  # type: ignore[misc]
    """Scheduler of pytest-xdist: tests with processes are two work units, the first ones; each other file is one."""

    def _split_scope(self, nodeid: str) -> str:
        file = file_of(nodeid)
        # The soak mostly waits: beside the other tests with processes it costs no time.
        return file if file == FIRST or not starts_processes(file) else f"processes {_FILES.index(file) % 2}"
