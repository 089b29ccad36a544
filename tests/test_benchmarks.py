"""Benchmarks without processes: equal solutions, all rows. No time is judged."""

from functools import lru_cache

import pytest

from benchmarks import estimates, solvers
from benchmarks.effort import QUICK
from benchmarks.runs import programs, setup
from benchmarks.solvers import SOLVERS, TIGHT, Solver
from mpc.qp import QP

ACTIVE_SETS = ("this project's", "quadprog")


@lru_cache
def asked() -> list[QP]:
    """Return programs of two runs, with few limits binding in one and many in the other."""
    return [qp for settings in ((), TIGHT) for qp in programs(setup("paper", QUICK.climb, *settings), QUICK.programs)]


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: solver.name)
def test_solvers_agree(solver: Solver) -> None:
    """Every installed solver solves all programs, within the tolerance of its kind from Clarabel."""
    if not solver.installed:
        pytest.skip(f"{solver.package} is not installed")
    outcome = solvers.compare([solver], asked(), 1)[solver.name]
    assert not outcome.unsolved
    assert max(outcome.from_clarabel) < solver.tolerance
    if solver.name in ACTIVE_SETS:
        assert max(outcome.from_daqp) < solvers.SAME
    assert min(times.median for times in outcome.times) > 0.0


def test_estimates_are_compared_with_the_truth(capsys: pytest.CaptureFixture[str]) -> None:
    """The error of the filters over a second of hover with delay is within the band of its covariance."""
    hover = "maneuver.phase=[{name='hover',duration_s=1.0,displacement_m=[0.0,0.0,0.0]}]"
    estimates.main(["--seeds", "1", "--set", hover, "--set", "links.delay_s=0.1"])
    _, _, row = capsys.readouterr().out.splitlines()
    assert "(not completed)" not in row
    assert "| 1 of 1 |" in row
