"""Compiled models of this test run go to a folder of their own: the user's cache is neither read nor filled."""

from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="session")
def cache_of_the_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Point the model cache at a temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PAYLOAD_TRANSPORT_CACHE", str(tmp_path_factory.mktemp("models")))
        yield
