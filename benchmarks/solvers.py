"""Solvers side by side on the programs of real flights: how fast, and how far from each other's answers.

Each is given a program as the controller has it, dense, and anew: between two steps all matrices change, so that there
is nothing to prepare ahead. Putting it into the form a solver takes is part of what the solver costs.
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
from benchmarks.timing import Times, in_turns
from model.arrays import Array
from mpc.qp import QP
from mpc.solvers import solve, solve_clarabel

# Limits that bind at every step of the same climb: thrust a tenth above that of hover, and a tenth of its rate.
TIGHT = ("controller.limits.thrust_N=[0.0,25.0]", "controller.limits.thrust_rate_N_s=10.0")

# How far answers may be from Clarabel's, in units of half an actuator's range. The programs are flat in some
# directions: there Clarabel's own gap of 1e-11 is some 1e-6, and what others leave at 1e-8 a hundred times that. Active
# sets are exact, and agree among themselves to `SAME`.
EXACT, APPROXIMATE, SAME = 5e-5, 2e-3, 1e-9

_INFINITY = 1e30  # DAQP's own

TEXT = (
    "Programs of flights of `paper` and `centralized`, {sizes}. Processor time of one answer, ms, median (99th "
    "percentile): first under the scenario's limits, of which few bind, then under limits so tight that many do. "
    "Differences: the largest of a decision, in units of half an actuator's range; active sets are exact, so that "
    "theirs from Clarabel's answer is Clarabel's own. Each starts anew with every program; Clarabel stops at 1e-11, "
    "whoever else approaches the answer at 1e-8, OSQP with polishing."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Solver:
    """Somebody who answers programs.

    Attributes:
        name: As in the table.
        package: What has to be installed.
        answer: The decision, or None for a program it says it did not solve.
        agrees: How far its answers may be from Clarabel's.
    """

    name: str
    package: str
    answer: Callable[[QP], Array | None]
    agrees: float

    @property
    def installed(self) -> bool:
        """Whether it can be asked."""
        return importlib.util.find_spec(self.package) is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a solver made of some programs.

    Attributes:
        times: Of all answers.
        from_clarabel, from_daqp: Largest difference of a decision from their answers.
        unsolved: Programs it gave no answer to.
    """

    times: Times
    from_clarabel: float
    from_daqp: float
    unsolved: int


def compare(asked: Sequence[Solver], qps: Sequence[QP], repetitions: int) -> dict[str, Outcome]:
    """Ask all of them in turns, program by program, by name."""
    taken: dict[str, list[Array]] = {solver.name: [] for solver in asked}
    differences = {name: np.zeros(2) for name in taken}
    unsolved = dict.fromkeys(taken, 0)
    for qp in qps:
        references = np.array([solve_clarabel(qp).z, _daqp(qp)])
        for solver in asked:
            z = solver.answer(qp)
            if z is None:
                unsolved[solver.name] += 1
            else:
                largest = np.abs(z - references).max(axis=1)
                differences[solver.name] = np.maximum(differences[solver.name], largest)
        tasks = {solver.name: partial(solver.answer, qp) for solver in asked}
        for name, times in in_turns(tasks, repetitions).items():
            taken[name].append(times.ms)
    return {
        name: Outcome(
            times=Times(np.concatenate(ms)),
            from_clarabel=float(differences[name][0]),
            from_daqp=float(differences[name][1]),
            unsolved=unsolved[name],
        )
        for name, ms in taken.items()
    }


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Fly, collect, ask."""
    asked = [solver for solver in SOLVERS if solver.installed]
    rows: list[tuple[str, ...]] = []
    sizes = []
    for name, count in (("paper", effort.programs), ("centralized", effort.large_programs)):
        if count == 0:
            continue
        outcomes = []
        for settings in ((), TIGHT):
            qps = programs(setup(name, effort.climb, *settings), count)
            say(f"{name}{', tight limits' * bool(settings)}: {len(qps)} programs, {len(asked)} solvers")
            outcomes.append(compare(asked, qps, min(effort.repetitions, count)))
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


def _default(qp: QP) -> Array | None:
    found = solve(qp, "daqp")
    return found.z if found.status == "solved" else None


def _clarabel(qp: QP) -> Array | None:
    found = solve_clarabel(qp)
    return found.z if found.status == "solved" else None


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
    except ValueError:  # constraints that contradict each other, a matrix that is not positive definite
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
    """Bounds of decisions and rows."""
    return np.concatenate([qp.lower, qp.row_lower]), np.concatenate([qp.upper, qp.row_upper])


def _module(name: str) -> Any:
    """A package that need not be there."""
    return importlib.import_module(name)


SOLVERS = (
    Solver(name="this project's", package="daqp", answer=_default, agrees=EXACT),
    Solver(name="DAQP alone", package="daqp", answer=_daqp, agrees=EXACT),
    Solver(name="Clarabel", package="clarabel", answer=_clarabel, agrees=EXACT),
    Solver(name="quadprog", package="quadprog", answer=_quadprog, agrees=EXACT),
    Solver(name="OSQP", package="osqp", answer=_osqp, agrees=APPROXIMATE),
    Solver(name="PIQP", package="piqp", answer=_piqp, agrees=APPROXIMATE),
    Solver(name="ProxQP", package="proxsuite", answer=_proxqp, agrees=APPROXIMATE),
)
