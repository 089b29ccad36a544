"""Benchmarks without processes: equal solutions, all rows. No time is judged."""

from dataclasses import replace
from functools import lru_cache

import pytest

from benchmarks import estimates, parts, solvers, step
from benchmarks.effort import QUICK
from benchmarks.runs import programs, setup
from benchmarks.solvers import SOLVERS, TIGHT, Solver
from mpc.qp import QP
from tests.support.tables import first_cells, numbers, silent

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
    assert outcome.unsolved == 0
    assert outcome.from_clarabel < solver.tolerance
    if solver.name in ACTIVE_SETS:
        assert outcome.from_daqp < solvers.SAME
    assert outcome.times.median > 0.0


@pytest.mark.slow
def test_steps_have_their_rows() -> None:
    """The table has every team at every horizon, and the scenarios with four UAVs."""
    (table,) = step.measure(QUICK, silent)
    teams = [("`resilient`", str(uavs), str(horizon)) for uavs in QUICK.teams for horizon in QUICK.horizons]
    others = [(f"`{name}`", "4", "20") for name in ("paper", "centralized", step.PLAIN)]
    assert [tuple(row[:3]) for row in table.rows] == [*teams, *others]
    assert min(value for stage in (*step.SHOWN, "step") for value in numbers(table, stage)) > 0.0


@pytest.mark.slow
def test_solvers_have_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that is not installed is listed as such; all others have numbers."""
    missing = Solver(name="missing", package="no_such_solver", solve=lambda _: None, tolerance=0.0)
    monkeypatch.setattr(solvers, "SOLVERS", (*SOLVERS[:2], missing))
    (table,) = solvers.measure(replace(QUICK, programs=2), silent)
    assert [row[1] for row in table.rows] == [*(solver.name for solver in SOLVERS[:2]), "missing"]
    assert table.rows[-1][2] == "not installed"
    assert all(row[2] != "not installed" for row in table.rows[:-1])


@pytest.mark.slow
def test_parts_have_their_rows() -> None:
    """The table has the plant of every team, and encoding and decoding of a plan."""
    (table,) = parts.measure(QUICK, silent)
    plants = [f"plant, one period, {uavs} UAVs" for uavs in QUICK.teams]
    assert first_cells(table) == [*plants, "plan to bytes", "bytes to plan", "bytes to plan, all checks"]
    assert min(numbers(table, "median")) > 0.0


def test_estimates_are_compared_with_the_truth(capsys: pytest.CaptureFixture[str]) -> None:
    """The error of the filters over a second of hover with delay is within the band of its covariance."""
    hover = "maneuver.phase=[{name='hover',duration_s=1.0,displacement_m=[0.0,0.0,0.0]}]"
    assert estimates.main(["--seeds", "1", "--set", hover, "--set", "links.delay_s=0.1"]) == 0
    row, summary = capsys.readouterr().out.splitlines()
    assert row.startswith("seed 0 completed: payload ")
    assert summary == "1 of 1 seeds have their mean NEES within the band of an instant"
