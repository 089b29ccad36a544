"""Benchmarks without processes: equal solutions of all solvers. No time is judged."""

from importlib.util import find_spec

import pytest

from benchmarks import solvers
from benchmarks.runs import CLIMB, programs, setup

# Largest differences from Clarabel's solutions, in units of half an actuator's range. The programs
# are flat in some directions: there Clarabel's gap of 1e-11 amounts to some 1e-6, and OSQP's 1e-8
# to a hundred times that.
EXACT, APPROXIMATE = 5e-5, 2e-3


@pytest.mark.slow
def test_solvers_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every installed solver solves programs with few and with many active limits."""
    missing = {"OSQP"} if find_spec("osqp") is None else set()
    monkeypatch.setattr(
        solvers, "SOLVERS", {n: solve for n, solve in solvers.SOLVERS.items() if n not in missing}
    )
    qps = [
        qp
        for settings in ((), solvers.TIGHT)
        for qp in programs(setup("paper", CLIMB, *settings), 4)
    ]
    for name, (ms, apart) in solvers.compare(qps, 1).items():
        assert apart < (APPROXIMATE if name == "OSQP" else EXACT), name
        assert min(ms) > 0.0
