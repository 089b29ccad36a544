"""Solvers compared on the programs of simulated runs: time, and differences of the solutions.

Each solver is given a dense program as the controller forms it and starts anew: between two steps
all matrices change. The time includes the conversion to the solver's form.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module

import numpy as np
from scipy import sparse

from benchmarks.runs import CLIMB, programs, setup, spread, times_ms
from docs.tables import table
from transport.model.arrays import Array
from transport.mpc.program.qp_solvers import solve, solve_clarabel
from transport.mpc.program.quadratic_program import QP

# Limits that bind at every step of the same climb: thrust a tenth above that of hover, and a tenth
# of its rate.
TIGHT = ("controller.limits.thrust_N=[0.0,25.0]", "controller.limits.thrust_rate_N_s=10.0")

TEXT = (
    "Programs of runs of `paper` and `centralized`, {sizes}. Processor time of one solution, ms, median (99th "
    "percentile): with the limits of the scenario, few of which are active, and with limits so tight that many are "
    "active. Difference: the largest of a decision, in units of half an actuator's range; active-set methods are "
    "exact, so their difference from Clarabel is the error of Clarabel. Each solver has a cold start with every "
    "program; Clarabel stops at 1e-11, OSQP at 1e-8 with polishing."
)
COLUMNS = ("programs of", "solver", "few active limits", "many active", "from Clarabel")


def measure() -> str:
    """Compare the solvers on programs of short runs, and return the table."""
    rows, sizes = [], []
    for name, count in (("paper", 30), ("centralized", 5)):
        several = [programs(setup(name, CLIMB, *settings), count) for settings in ((), TIGHT)]
        sizes.append(f"{len(several[0][0].g)} variables and {len(several[0][0].A)} rows")
        both = [compare(qps) for qps in several]
        for solver in SOLVERS:
            times, apart = zip(*(found[solver] for found in both), strict=True)
            rows.append([f"`{name}`", solver, *map(spread, times), f"{max(apart):.0e}"])
    return f"{TEXT.format(sizes=' and '.join(sizes))}\n\n{table(COLUMNS, rows)}"


def compare(qps: Sequence[QP], repetitions: int = 5) -> dict[str, tuple[list[float], float]]:
    """Return times, ms, and largest difference from Clarabel's decisions by solver, program by program in turns."""
    found: dict[str, tuple[list[float], float]] = {name: ([], 0.0) for name in SOLVERS}
    for qp in qps:
        reference = np.asarray(solve_clarabel(qp).z)
        for name, solver in SOLVERS.items():
            ms, apart = found[name]
            difference = float(np.abs(solver(qp) - reference).max())
            found[name] = (
                [*ms, *times_ms([partial(solver, qp)], repetitions)],
                max(apart, difference),
            )
    return found


def _daqp(qp: QP) -> Array:
    lower, upper = _all_bounds(qp)
    z, *_ = import_module("daqp").solve(
        np.ascontiguousarray(qp.H),
        qp.g,
        np.ascontiguousarray(qp.A),
        np.minimum(upper, 1e30),  # its own infinity
        np.maximum(lower, -1e30),
        np.where(lower == upper, 5, 0).astype(np.int32),
        primal_tol=1e-9,
        dual_tol=1e-9,
    )
    return np.asarray(z)


def _osqp(qp: QP) -> Array:
    lower, upper = _all_bounds(qp)
    solver = import_module("osqp").OSQP()
    P, A = (
        sparse.triu(sparse.csc_matrix(qp.H), format="csc"),
        sparse.csc_matrix(np.vstack([np.eye(len(qp.g)), qp.A])),
    )
    solver.setup(
        P,
        qp.g,
        A,
        lower,
        upper,
        verbose=False,
        eps_abs=1e-8,
        eps_rel=1e-8,
        max_iter=100000,
        polishing=True,
    )
    return np.asarray(solver.solve(raise_error=True).x)


def _all_bounds(qp: QP) -> tuple[Array, Array]:
    """Return the bounds of decisions and rows."""
    return np.concatenate([qp.lower, qp.row_lower]), np.concatenate([qp.upper, qp.row_upper])


SOLVERS: Mapping[str, Callable[[QP], Array]] = {
    "this project's": lambda qp: np.asarray(solve(qp, "daqp").z),
    "DAQP alone": _daqp,
    "Clarabel": lambda qp: np.asarray(solve_clarabel(qp).z),
    "OSQP": _osqp,
}
