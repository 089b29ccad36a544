"""The user's own constraints on the actual trajectory, in the summary and the report."""

import pytest

from tests.support import runs
from tests.support.logs import log_of
from tests.support.runs import completed
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise

CLIMB = (
    "maneuver.phase=[{name='climb',duration_s=2.0,displacement_m=[0,0,-1]},"
    "{name='hover',duration_s=1.0,displacement_m=[0,0,0]}]"
)

SHORT_CLIMB = "maneuver.phase=[{name='climb',duration_s=0.8,displacement_m=[0,0,-0.3]}]"


def test_the_largest_violation_is_that_of_the_plant() -> None:
    """A bound that the path exceeds by a metre is exceeded by about that; one far away holds."""
    own = "controller.constraint=[{expression='r0[2] >= -10.0', penalty=1e-6},{expression='r0[2] >= -99.0'}]"
    run = runs.ready("resilient", CLIMB, own)
    low, far = summarise(AnalysedRun.of(run, log_of(completed(run))))["own_constraints"]
    assert low["expression"] == "r0[2] >= -10.0"
    assert 0.8 < low["violation_max"] < 1.2
    assert low["at_s"] > 1.0
    assert far["violation_max"] == 0.0


@pytest.mark.parametrize("solver", ["daqp", "clarabel"])
def test_the_unit_of_an_expression_does_not_matter(solver: str) -> None:
    """A limit on a thrust of a climbing team is kept alike in N, 1e-8 N and 1e6 N, and no step fails.

    The thrust of hover is 22.07 N, the limit 22.1 N: the climb needs more.
    """
    exceeded = []
    for unit in (1.0, 1e-8, 1e6):
        own = f"controller.constraint=[{{expression='{unit} * thrust2 <= {22.1 * unit}'}}]"
        run = runs.ready("resilient", SHORT_CLIMB, own, f"controller.solver={solver}")
        summary = summarise(AnalysedRun.of(run, log_of(completed(run))))
        assert summary["solver"]["failures"] == 0
        exceeded.append(summary["own_constraints"][0]["violation_max"] / unit)
    # N. The solvers' tolerance is 1e-6 of the range of a thrust, some 22 N.
    assert exceeded == pytest.approx([exceeded[0]] * 3, abs=1e-4)
    assert exceeded[0] < 0.05  # without any limit it takes several N more


def test_without_own_constraints_there_are_none() -> None:
    """A scenario without any has an empty list."""
    run = runs.ready("resilient", runs.ticks(4))
    assert summarise(AnalysedRun.of(run, log_of(completed(run))))["own_constraints"] == []
