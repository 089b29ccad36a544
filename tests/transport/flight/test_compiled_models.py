"""Every kind of team that flies is compiled first."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from tests.support import runs
from transport.flight.progress import compile_models
from transport.model.kernels.casadi_functions import library
from transport.model.kernels.compiler import find_compiler

BY_RATES = ("controller.inputs=rates", "controller.rate_time_constant_s=[0.05,0.05,0.2]")
UAVS = 1  # compiled the fastest


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_controllers_and_plant_are_compiled_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All models of a run are on disk before it begins; a second one has nothing to do."""
    monkeypatch.setenv("PAYLOAD_TRANSPORT_CACHE", str(tmp_path))
    monkeypatch.delenv("PAYLOAD_TRANSPORT_NATIVE", raising=False)
    # Their plant has moments.
    scenario = runs.setup(*runs.SINGLE_UAV, *BY_RATES).scenario
    text = io.StringIO()
    for _ in range(2):
        compile_models(iter([scenario]), Console(file=text))
        assert library(UAVS, rates=False) is not None
        assert library(UAVS, rates=True) is not None
    assert len(text.getvalue().splitlines()) == 2
