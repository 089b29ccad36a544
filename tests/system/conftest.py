"""What tests with processes share."""

from collections.abc import Callable, Iterator

import pytest

from tests.support.commands import Forked, forked_commands


@pytest.fixture(scope="module")
def forked() -> Iterator[Callable[..., Forked]]:
    """Start commands by one fork server for all tests of a file."""
    with forked_commands() as start:
        yield start
