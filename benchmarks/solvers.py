"""Solvers compared on the programs of simulated flights: time, and differences of the solutions.

Each solver is given a dense program as the controller forms it and starts anew: between two steps all matrices change.
The time includes the conversion to the solver's form.
"""

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import sparse

from benchmarks.effort import Effort
from benchmarks.flights import programs, setup
from benchmarks.page import Table
from benchmarks.timing import Times, in_turns, joined
from model.arrays import Array
from mpc.qp import QP, Solution
from mpc.solvers import solve, solve_clarabel

# Limits that bind at every step of the same climb: thrust a tenth above that of hover, and a tenth of its rate.
TIGHT = ("controller.limits.thrust_N=[0.0,25.0]", "controller.limits.thrust_rate_N_s=10.0")

# Largest differences from Clarabel's solutions, in units of half an actuator's range. The programs are flat in some
# directions: there Clarabel's gap of 1e-11 amounts to some 1e-6, and the 1e-8 of others to a hundred times that. Active
# sets are exact, and agree among themselves to `SAME`.
EXACT, APPROXIMATE, SAME = 5e-5, 2e-3, 1e-9

_INFINITY = 1e30  # DAQP's own

TEXT = (
    "Programs of runs of `paper` and `centralized`, {sizes}. Processor time of one solution, ms, median (99th "
    "percentile): under the scenario's limits, of which few bind, and under limits so tight that many bind. "
    "Differences: the largest of a decision, in units of half an actuator's range; active sets are exact, so that "
    "their difference from Clarabel is Clarabel's error. Each solver starts anew with every program; Clarabel stops at "
    "1e-11, the other iterative solvers at 1e-8, OSQP with polishing."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Solver:
    """A solver of the table.

    Attributes:
        name: As in the table.
        package: Package that has to be installed.
        solve: Returns the decision, or None for a program reported as not solved.
        tolerance: Largest difference of its decisions from Clarabel's.
    """

    name: str
    package: str
    solve: Callable[[QP], Array | None]
    tolerance: float

    @property
    def installed(self) -> bool:
        """Return whether the package is installed."""
        return importlib.util.find_spec(self.package) is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Results of a solver on some programs.

    Attributes:
        times: Times of all calls.
        from_clarabel, from_daqp: Largest difference of a decision from theirs.
        unsolved: Number of programs not solved.
    """

    times: Times
    from_clarabel: float
    from_daqp: float
    unsolved: int


def compare(compared: Sequence[Solver], qps: Sequence[QP], repetitions: int) -> dict[str, Outcome]:
    """Call all solvers in turns, program by program; return the outcomes by name."""
    taken: dict[str, list[Times]] = {solver.name: [] for solver in compared}
    differences = {name: np.zeros(2) for name in taken}
    unsolved = dict.fromkeys(taken, 0)
    for qp in qps:
        references = np.array([solve_clarabel(qp).z, _daqp(qp)])
        for solver in compared:
            z = solver.solve(qp)
            if z is None:
                unsolved[solver.name] += 1
            else:
                largest = np.abs(z - references).max(axis=1)
                differences[solver.name] = np.maximum(differences[solver.name], largest)
        tasks = {solver.name: partial(solver.solve, qp) for solver in compared}
        for name, times in in_turns(tasks, repetitions).items():
            taken[name].append(times)
    return {
        name: Outcome(
            times=joined(times),
            from_clarabel=float(differences[name][0]),
            from_daqp=float(differences[name][1]),
            unsolved=unsolved[name],
        )
        for name, times in taken.items()
    }


def measure(effort: Effort, log: Callable[[str], None]) -> list[Table]:
    """Compare all installed solvers on programs of short runs."""
    compared = [solver for solver in SOLVERS if solver.installed]
    rows: list[tuple[str, ...]] = []
    sizes = []
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
            if not solver.installed:
                rows.append((f"`{name}`", solver.name, "not installed", "", "", "", ""))
                continue
            usual, tight = (outcome[solver.name] for outcome in outcomes)
            differences = (max(usual.from_clarabel, tight.from_clarabel), max(usual.from_daqp, tight.from_daqp))
            cells = (str(usual.times), str(tight.times), *(f"{value:.0e}" for value in differences))
            rows.append((f"`{name}`", solver.name, *cells, str(usual.unsolved + tight.unsolved)))
    columns = ("programs of", "solver", "few limits bind", "many bind", "from Clarabel", "from DAQP", "unsolved")
    return [Table(text=TEXT.format(sizes=" and ".join(sizes)), columns=columns, rows=rows)]


def _decision(solution: Solution) -> Array | None:
    return solution.z if solution.status == "solved" else None


def _daqp(qp: QP) -> Array | None:
    lower, upper = _all_bounds(qp)
    z, _, flag, _ = _module("daqp").solve(
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
        z: Array = _module("quadprog").solve_qp(qp.H, -qp.g, C.T, b)[0]
    except ValueError:  # infeasible constraints, or a matrix that is not positive definite
        return None
    return z


def _osqp(qp: QP) -> Array | None:
    lower, upper = _all_bounds(qp)
    solver = _module("osqp").OSQP()
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
    piqp = _module("piqp")
    solver = piqp.DenseSolver()
    solver.settings.verbose = False
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-8
    solver.setup(qp.H, qp.g, None, None, qp.A, qp.row_lower, qp.row_upper, qp.lower, qp.upper)
    return np.array(solver.result.x) if solver.solve() == piqp.PIQP_SOLVED else None


def _proxqp(qp: QP) -> Array | None:
    proxqp = _module("proxsuite").proxqp
    solver = proxqp.dense.QP(len(qp.g), 0, len(qp.A), True)
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-8, 0.0
    solver.init(qp.H, qp.g, None, None, qp.A, qp.row_lower, qp.row_upper, qp.lower, qp.upper)
    solver.solve()
    found = solver.results
    return np.array(found.x) if found.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED else None


def _all_bounds(qp: QP) -> tuple[Array, Array]:
    """Return the bounds of decisions and rows."""
    return np.concatenate([qp.lower, qp.row_lower]), np.concatenate([qp.upper, qp.row_upper])


def _module(name: str) -> Any:
    """Return an optional package."""
    return importlib.import_module(name)


SOLVERS = (
    Solver(name="this project's", package="daqp", solve=lambda qp: _decision(solve(qp, "daqp")), tolerance=EXACT),
    Solver(name="DAQP alone", package="daqp", solve=_daqp, tolerance=EXACT),
    Solver(name="Clarabel", package="clarabel", solve=lambda qp: _decision(solve_clarabel(qp)), tolerance=EXACT),
    Solver(name="quadprog", package="quadprog", solve=_quadprog, tolerance=EXACT),
    Solver(name="OSQP", package="osqp", solve=_osqp, tolerance=APPROXIMATE),
    Solver(name="PIQP", package="piqp", solve=_piqp, tolerance=APPROXIMATE),
    Solver(name="ProxQP", package="proxsuite", solve=_proxqp, tolerance=APPROXIMATE),
)
