"""The user's own constraints on the actual trajectory, in the summary and the report."""

from tests.support import runs
from tests.support.logs import log_of
from tests.support.runs import completed
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.metrics import summarise

CLIMB = (
    "maneuver.phase=[{name='climb',duration_s=2.0,displacement_m=[0,0,-1]},"
    "{name='hover',duration_s=1.0,displacement_m=[0,0,0]}]"
)


def test_the_largest_violation_is_that_of_the_plant() -> None:
    """A bound that the path exceeds by a metre is exceeded by about that; one far away holds."""
    own = "controller.constraint=[{expression='r0[2] >= -10.0', penalty=1e-6},{expression='r0[2] >= -99.0'}]"
    run = runs.ready("resilient", CLIMB, own)
    low, far = summarise(AnalysedRun.of(run, log_of(completed(run))))["own_constraints"]
    assert low["expression"] == "r0[2] >= -10.0"
    assert 0.8 < low["violation_max"] < 1.2
    assert low["at_s"] > 1.0
    assert far["violation_max"] == 0.0


def test_without_own_constraints_there_are_none() -> None:
    """A scenario without any has an empty list."""
    run = runs.ready("resilient", runs.ticks(4))
    assert summarise(AnalysedRun.of(run, log_of(completed(run))))["own_constraints"] == []
