"""One BLAS thread, as in every process of a run; and how several pytest workers share the tests."""

import pytest
import threadpoolctl

from tests import sharing

# Sums in one order, so that equal inputs give equal bits.
threadpoolctl.threadpool_limits(1)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the soak first, then the other tests that start processes, then the rest."""
    items.sort(key=lambda item: sharing.order(item.nodeid))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> sharing.Sharing:
    """Give all tests that start processes to one worker."""
    config.option.loadscopereorder = False  # work units in the order of their tests
    return sharing.Sharing(config, log)
