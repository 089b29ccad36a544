"""One BLAS thread, as in every process of a run; and the soak, which takes minutes and little else, beside others."""

from collections.abc import Iterator

import pytest
import threadpoolctl

from tests.beside import SOAK, Beside

# Sums in one order, so that equal inputs give equal bits.
threadpoolctl.threadpool_limits(1)

_SOAK = Beside(SOAK)
# The first of the tests that start no processes of their own.
_ALONGSIDE = "tests/model/"


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Begin with the soak when tests begin that leave a processor free, if it is asked for at all."""
    if item.nodeid.startswith(_ALONGSIDE) and any("test_soak.py::test_nothing" in i.nodeid for i in item.session.items):
        _SOAK.begin()


@pytest.fixture
def soaked() -> Iterator[Beside]:
    """The soak, under way."""
    _SOAK.begin()
    yield _SOAK
    _SOAK.end()


def pytest_unconfigure() -> None:
    """Leave nothing behind."""
    _SOAK.end()
