"""Payload swing at the end of a run: a synthetic pendulum, and the paper's maneuver."""

import math

import pytest

from tests.support import runs
from tests.support.log_messages import on_reference
from tests.support.logs import log_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.cost_and_tracking_metrics import swing_of
from transport.analysis.series import series_of
from transport.analysis.summary_assembly import summarise
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.wire.messages import PlantState

HOLD = "maneuver.phase=[{name='hover',duration_s=6.0,displacement_m=[0,0,0]}]"
TICKS = 120
OMEGA = math.sqrt(9.81 / 3.2)  # pendulum of the paper's rods, rad/s


def test_the_swing_is_that_of_the_end() -> None:
    """A swing of 0.3 m about an offset is measured in the last 4 s only.

    Without a tick there is none.
    """
    run = runs.setup(HOLD)

    def at(k: int) -> PlantState:
        def change(x: Array, u: Array) -> None:
            x[state.R0] += [5.0 if k < 40 else 0.0, 0.1 + 0.3 * math.cos(OMEGA * 0.05 * k), 0.0]

        return on_reference(run, k, change)

    # Two samples are 50 ms apart: 1 - cos(OMEGA 0.025) = 1e-3.
    found = swing_of(run, series_of(run, log_of([at(k) for k in range(TICKS)])))
    assert found == pytest.approx(0.4, rel=5e-3)
    assert swing_of(run, series_of(run, log_of([]))) is None


@pytest.mark.slow
def test_the_infinite_horizon_damps_the_papers_maneuver() -> None:
    """The swing of 0.55 m that a horizon of 1 s leaves (test_paper_levels.py) dies out with a cost-to-go behind it."""
    run = runs.ready("centralized_lq")
    assert (
        summarise(AnalysedRun.of(run, log_of(runs.recorded(run))))["payload_tracking"]["swing_m"]
        < 0.4
    )
