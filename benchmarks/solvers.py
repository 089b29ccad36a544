"""Solvers compared on the programs of simulated runs: time, and differences of the solutions.

Each solver is given a dense program as the controller forms it and starts anew: between two steps all matrices change.
The time includes the conversion to the solver's form.
"""

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from scipy import sparse

from benchmarks.effort import Effort
from benchmarks.page import section
from benchmarks.runs import programs, setup
from benchmarks.timing import Times, in_turns, joined
from model.arrays import Array
from mpc.qp import QP, Solution, solve, solve_clarabel

# Limits that bind at every step of the same climb: thrust a tenth above that of hover, and a tenth of its rate.
TIGHT = ("controller.limits.thrust_N=[0.0,25.0]", "controller.limits.thrust_rate_N_s=10.0")

# Largest differences from Clarabel's solutions, in units of half an actuator's range. The programs are flat in some
# directions: there Clarabel's gap of 1e-11 amounts to some 1e-6, and the 1e-8 of others to a hundred times that. Active
# sets are exact, and agree among themselves to `SAME`.
EXACT, APPROXIMATE, SAME = 5e-5, 2e-3, 1e-9

_INFINITY = 1e30  # DAQP's own

TEXT = (
    "Programs of runs of `paper` and `centralized`, {sizes}. Processor time of one solution, ms, median (99th "
    "percentile): with the limits of the scenario, few of which are active, and with limits so tight that many are "
    "active. Differences: the largest of a decision, in units of half an actuator's range; active-set methods are "
    "exact, so their difference from Clarabel is the error of Clarabel. Each solver has a cold start with every "
    "program; Clarabel stops at 1e-11, the other iterative solvers at 1e-8, OSQP with polishing."
)


class Solver(NamedTuple):
    """A solver of the table."""

    name: str  # as in the table
    package: str  # that has to be installed
    solve: Callable[[QP], Array | None]  # returns the decision, or None for a program reported as not solved
    tolerance: float = APPROXIMATE  # largest difference of its decisions from Clarabel's

    @property
    def installed(self) -> bool:
        """Return whether the package is installed."""
        return find_spec(self.package) is not None


class Outcome(NamedTuple):
    """Results of a solver: times, differences of its decisions from others', which of the programs are not solved."""

    times: list[Times]
    from_clarabel: list[float]
    from_daqp: list[float]
    unsolved: list[QP]


def compare(compared: Sequence[Solver], qps: Sequence[QP], repetitions: int) -> dict[str, Outcome]:
    """Call all solvers in turns, program by program; return the outcomes by name."""
    outcomes = {solver.name: Outcome([], [], [], []) for solver in compared}
    for qp in qps:
        clarabel, daqp = np.asarray(solve_clarabel(qp).z), np.asarray(_daqp(qp))
        tasks = {solver.name: partial(solver.solve, qp) for solver in compared}
        for name, times in in_turns(tasks, repetitions).items():
            outcome, z = outcomes[name], tasks[name]()
            outcome.times.append(times)
            if z is None:
                outcome.unsolved.append(qp)
                continue
            outcome.from_clarabel.append(float(np.abs(z - clarabel).max()))
            outcome.from_daqp.append(float(np.abs(z - daqp).max()))
    return outcomes


def measure(effort: Effort, log: Callable[[str], None]) -> list[str]:
    """Compare all installed solvers on programs of short runs."""
    compared = [solver for solver in SOLVERS if solver.installed]
    rows, sizes = [], []
    for name, count in (("paper", effort.programs), ("centralized", effort.large_programs)):
        if count == 0:
            continue
        outcomes = []
        for settings in ((), TIGHT):
            qps = programs(setup(name, effort.climb, *settings), count)
            log(f"{name}{', tight limits' * bool(settings)}: {len(qps)} programs, {len(compared)} solvers")
            outcomes.append(compare(compared, qps, min(effort.repetitions, count)))
        sizes.append(f"{len(qps[0].g)} variables and {len(qps[0].A)} rows")
        for solver in SOLVERS:
            cells = ["not installed", "", "", "", ""]
            if solver.installed:
                both = [outcome[solver.name] for outcome in outcomes]
                cells = [str(joined(one.times)) for one in both]
                for other in ("from_clarabel", "from_daqp"):
                    differences = [value for one in both for value in getattr(one, other)]
                    cells.append(f"{max(differences, default=0.0):.0e}")
                cells.append(str(sum(len(one.unsolved) for one in both)))
            rows.append([f"`{name}`", solver.name, *cells])
    columns = ("programs of", "solver", "few active limits", "many active", "from Clarabel", "from DAQP", "unsolved")
    return [section(TEXT.format(sizes=" and ".join(sizes)), columns, rows)]


def _decision(solution: Solution) -> Array | None:
    return solution.z if solution.status == "solved" else None


def _daqp(qp: QP) -> Array | None:
    lower, upper = _all_bounds(qp)
    z, _, flag, _ = import_module("daqp").solve(
        np.ascontiguousarray(qp.H),
        qp.g,
        np.ascontiguousarray(qp.A),
        np.minimum(upper, _INFINITY),
        np.maximum(lower, -_INFINITY),
        np.where(lower == upper, 5, 0).astype(np.int32),
        primal_tol=1e-9,
        dual_tol=1e-9,
    )
    return np.asarray(z) if flag > 0 else None


def _quadprog(qp: QP) -> Array | None:
    lower, upper = _all_bounds(qp)
    rows = np.concatenate([np.eye(len(qp.g)), qp.A])
    below, above = np.isfinite(lower), np.isfinite(upper)
    C, b = np.concatenate([rows[below], -rows[above]]), np.concatenate([lower[below], -upper[above]])
    try:
        z: Array = import_module("quadprog").solve_qp(qp.H, -qp.g, C.T, b)[0]
    except ValueError:  # infeasible constraints, or a matrix that is not positive definite
        return None
    return z


def _osqp(qp: QP) -> Array | None:
    lower, upper = _all_bounds(qp)
    solver = import_module("osqp").OSQP()
    solver.setup(
        P=sparse.triu(sparse.csc_matrix(qp.H), format="csc"),
        q=qp.g,
        A=sparse.csc_matrix(np.concatenate([np.eye(len(qp.g)), qp.A])),
        l=lower,
        u=upper,
        verbose=False,
        eps_abs=1e-8,
        eps_rel=1e-8,
        max_iter=100000,
        polishing=True,
    )
    found = solver.solve(raise_error=False)
    return np.asarray(found.x) if found.info.status == "solved" else None


def _piqp(qp: QP) -> Array | None:
    piqp = import_module("piqp")
    solver = piqp.DenseSolver()
    solver.settings.verbose = False
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-8
    solver.setup(qp.H, qp.g, None, None, qp.A, qp.row_lower, qp.row_upper, qp.lower, qp.upper)
    return np.array(solver.result.x) if solver.solve() == piqp.PIQP_SOLVED else None


def _proxqp(qp: QP) -> Array | None:
    proxqp = import_module("proxsuite").proxqp
    solver = proxqp.dense.QP(len(qp.g), 0, len(qp.A), True)
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-8, 0.0
    solver.init(qp.H, qp.g, None, None, qp.A, qp.row_lower, qp.row_upper, qp.lower, qp.upper)
    solver.solve()
    found = solver.results
    return np.array(found.x) if found.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED else None


def _all_bounds(qp: QP) -> tuple[Array, Array]:
    """Return the bounds of decisions and rows."""
    return np.concatenate([qp.lower, qp.row_lower]), np.concatenate([qp.upper, qp.row_upper])


SOLVERS = (
    Solver("this project's", "daqp", lambda qp: _decision(solve(qp, "daqp")), EXACT),
    Solver("DAQP alone", "daqp", _daqp, EXACT),
    Solver("Clarabel", "clarabel", lambda qp: _decision(solve_clarabel(qp)), EXACT),
    Solver("quadprog", "quadprog", _quadprog, EXACT),
    Solver("OSQP", "osqp", _osqp),
    Solver("PIQP", "piqp", _piqp),
    Solver("ProxQP", "proxsuite", _proxqp),
)
