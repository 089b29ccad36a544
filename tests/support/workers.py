"""Order of the tests for several pytest workers, each of which takes the next file: the long ones begin.

Tests that start processes or open sockets spend much of their time waiting, so several at once use the processors.
"""

import pytest

# Folder of the test files of the first kind.
SYSTEM = "tests/system/"

# Runs before all other tests: it mostly waits for two minutes, which leaves processor time for style and type checks.
FIRST = "tests/system/test_soak.py"


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
